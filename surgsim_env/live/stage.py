"""What surrounds the organ on the page: camera, light, ground, the instrument, handles of the hands, force arrows."""

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.cameras import Camera, scene_cameras
from surgsim_env.rendering.instrument_geoms import geom_colour
from surgsim_env.scene.anatomy import Anatomy

# The page's scene is in decimetres: viser's cameras and handles are made for scenes of some metres.
SCALE = 10.0
# Smaller changes are not sent [m].
STILL = 2e-6

_KIND = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")): name for name in ("SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
}

HAND_COLOURS = ((255, 146, 43), (77, 171, 247))
GROUND_COLOUR, FORCE_COLOUR, BRAND_COLOUR = (28, 58, 66), (255, 224, 102), (232, 89, 12)
# Distance of the ground below the organ [m], and its half size in sizes of the organ.
GROUND_GAP, GROUND_REACH = 0.002, 4.0
# Distance of the page's camera in distances of the overview camera, and its sideways shift in half picture heights.
FARTHER, ASIDE = 1.5, 0.42
# Ambient intensity in plain light.
AMBIENT = 0.9
# In the page's decimetres; HANDLE_SHARE limits the handle to a share of the organ.
HANDLE_SIZE, HANDLE_SHARE, BALL_RADIUS = 0.35, 0.45, 0.03
SHAFT_RADIUS, HEAD_RADIUS, HEAD_LENGTH = 0.012, 0.035, 0.07
# Length of a force arrow per newton: share of the organ's size, at most [m/N]; no arrow below the last value [N].
FORCE_SHARE, FORCE_LENGTH, FORCE_LEAST = 0.4, 0.06, 0.005


def page_camera(anatomy: Anatomy) -> Camera:
    """The page's initial camera: as the overview, farther away, with the organ left of the panel."""
    near = scene_cameras(anatomy, aspect=1.2)["overview"]
    distance = FARTHER * float(np.linalg.norm(near.position - near.target))
    aside = ASIDE * distance * math.tan(math.radians(0.5 * near.fov)) * near.rotation[:, 0]
    target = near.target + aside
    return Camera.looking(target + distance * near.rotation[:, 2], target, near.up, near.fov)


class Surroundings:
    """Camera, light and ground.

    Fields:
        directions: unit vectors right, away from the viewer, and out of the organ, as rows (3, 3)
    """

    def __init__(self, viser: Any, anatomy: Anatomy) -> None:
        """Add them to a viser server."""
        camera = page_camera(anatomy)
        viser.scene.set_up_direction(camera.up)
        first = viser.initial_camera
        first.position, first.look_at, first.up = camera.position * SCALE, camera.target * SCALE, camera.up
        first.fov, first.near = math.radians(camera.fov), 0.05
        viser.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False, brand_color=BRAND_COLOUR)
        viser.scene.world_axes.visible = False
        right, ahead = camera.rotation[:, 0], -camera.rotation[:, 2]
        level = ahead - (ahead @ camera.up) * camera.up
        self.directions = np.stack([right, level / np.linalg.norm(level), -anatomy.face.approach])
        self._scene = viser.scene
        self._ground = _add_ground(viser.scene, anatomy.mesh.points, camera.up, right)
        self.show_plain(False)

    def show_plain(self, on: bool) -> None:
        """Turn off what costs a software renderer most: shadows, reflections, a glossy ground."""
        self._scene.configure_default_lights(enabled=True, cast_shadow=not on)
        self._scene.configure_environment_map(None if on else "warehouse", environment_intensity=0.6)
        self._scene.add_light_ambient("/ambient", intensity=AMBIENT if on else 0.0)
        self._ground.material = "toon3" if on else "standard"


class InstrumentView:
    """Nodes of a viser scene for geoms of an instrument's model."""

    def __init__(self, scene: Any, model: mujoco.MjModel, geoms: list[int], arm_count: int) -> None:
        """Add a node for each geom.

        Args:
            scene: viser's.
            model: the instrument's.
            geoms: which of its geoms are drawn.
            arm_count: 1, or 2: then the names of the second arm's bodies begin with "right_".
        """
        self.nodes, self.arms = [], []
        self._shown: NDArray[np.float32] | None = None
        for place, geom in enumerate(geoms):
            node = _add(scene, f"/instrument/{place}", model, geom)
            self.nodes.append(node)
            body = model.body(int(model.geom_bodyid[geom])).name
            fixed = int(model.geom_bodyid[geom]) == 0
            self.arms.append(None if fixed else int(arm_count > 1 and body.startswith("right_")))

    def follow(self, position: NDArray[np.float32], rotation: NDArray[np.float32]) -> None:
        """Move the nodes to positions [m], (n_geom, 3), and rotation matrices, (n_geom, 9)."""
        quaternion, moved = np.zeros(4), self._moved(position, rotation)
        for node, place, turn, has_moved in zip(self.nodes, position, rotation, moved, strict=True):
            if not has_moved:
                continue
            mujoco.mju_mat2Quat(quaternion, turn.astype(np.float64))
            node.position, node.wxyz = place * SCALE, quaternion.copy()

    def _moved(self, position: NDArray[np.float32], rotation: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which geoms have moved since they were last sent, (n_geom,)."""
        now = np.concatenate([position, rotation], axis=1)
        moved = np.ones(len(now), dtype=bool) if self._shown is None else np.abs(now - self._shown).max(axis=1) > STILL
        self._shown = now if self._shown is None else np.where(moved[:, None], now, self._shown)
        return moved

    def on_drag(self, moved: Callable[[int, str, FloatArray], None]) -> list[str]:
        """Call `moved` with an arm, the phase of a drag and the pointer's position [m]; returns the nodes' names."""
        names = []
        for node, arm in zip(self.nodes, self.arms, strict=True):
            if arm is None:
                continue
            node.on_drag("left")(_caller(moved, arm))
            names.append(node.name)
        return names


def _caller(moved: Callable[[int, str, FloatArray], None], arm: int) -> Callable[[Any], Any]:
    async def call(event: Any) -> None:
        moved(arm, event.phase, np.asarray(event.end_position, dtype=np.float64) / SCALE)

    return call


def _add(scene: Any, name: str, model: mujoco.MjModel, geom: int) -> Any:
    import trimesh

    kind, size = _KIND[int(model.geom_type[geom])], model.geom_size[geom] * SCALE
    red, green, blue, _ = (round(255 * float(part)) for part in geom_colour(model, geom))
    colour = (red, green, blue)
    if kind == "SPHERE":
        return scene.add_icosphere(name, radius=float(size[0]), color=colour, subdivisions=3)
    if kind == "BOX":
        return scene.add_box(name, dimensions=tuple((2.0 * size).tolist()), color=colour)
    if kind == "CYLINDER":
        return scene.add_cylinder(
            name, radius=float(size[0]), height=float(2.0 * size[1]), color=colour, radial_segments=24
        )
    if kind == "CAPSULE":
        made = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[20, 20])
        made.apply_translation(-made.bounds.mean(axis=0))
        vertices, faces = made.vertices, made.faces
    else:
        mesh = int(model.geom_dataid[geom])
        vertices = _rows(model.mesh_vert, model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]) * SCALE
        faces = _rows(model.mesh_face, model.mesh_faceadr[mesh], model.mesh_facenum[mesh])
    return scene.add_mesh_simple(name, np.asarray(vertices, np.float32), np.asarray(faces, np.uint32), color=colour)


def _rows(array: NDArray[Any], first: Any, count: Any) -> NDArray[Any]:
    return array[int(first) : int(first) + int(count)]


def add_handle(
    scene: Any,
    arm: int,
    place: FloatArray,
    size: float,
    directions: FloatArray,
    pulled: Callable[[int, str, FloatArray], None],
) -> Any:
    """Add the arrows that drag a hand out of the organ, into it, and across it.

    Args:
        scene: viser's.
        arm: index of the hand.
        place: initial position [m], (3,).
        size: of the organ [m].
        directions: see `Surroundings`.
        pulled: called with the arm, the phase of the drag and the position [m], (3,).
    """
    out = directions[2]
    across = np.cross(directions[1], out)
    across /= np.linalg.norm(across)
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, np.column_stack([across, np.cross(out, across), out]).ravel())
    name = f"/hand/{arm}"
    handle = scene.add_transform_controls(
        name,
        scale=min(HANDLE_SIZE, HANDLE_SHARE * size * SCALE),
        disable_rotations=True,
        disable_sliders=True,
        depth_test=False,
        opacity=0.75,
        wxyz=turn,
        position=place * SCALE,
    )
    scene.add_icosphere(f"{name}/ball", radius=BALL_RADIUS, color=HAND_COLOURS[arm], cast_shadow=False)

    @handle.on_update
    async def _(event: Any) -> None:
        pulled(arm, event.phase, np.asarray(handle.position, dtype=np.float64) / SCALE)

    return handle


class ForceArrow:
    """The tissue's force on a tip, as an arrow. A plain mesh, whose shader the browser has compiled already."""

    def __init__(self, scene: Any, arm: int, size: float) -> None:
        """Add it, with zero length, to a scene with an organ of `size` [m]."""
        import trimesh

        shaft = trimesh.creation.cylinder(radius=SHAFT_RADIUS, height=1.0, sections=12)
        shaft.apply_translation([0.0, 0.0, 0.5])
        head = trimesh.creation.cone(radius=HEAD_RADIUS, height=HEAD_LENGTH, sections=16)
        self._shaft, self._head = np.array(shaft.vertices), np.array(head.vertices)
        faces = np.concatenate([shaft.faces, head.faces + len(shaft.vertices)]).astype(np.uint32)
        hidden = np.zeros((len(self._shaft) + len(self._head), 3), dtype=np.float32)
        self._node = scene.add_mesh_simple(
            f"/force/{arm}", hidden, faces, color=FORCE_COLOUR, flat_shading=False, cast_shadow=False
        )
        self._hidden, self._shows = hidden, False
        self._length = min(FORCE_SHARE * size, FORCE_LENGTH)

    def follow(self, tip: FloatArray, force: FloatArray) -> None:
        """Draw it from a tip [m], (3,), along a force [N], (3,)."""
        size = float(np.linalg.norm(force))
        shows = size > FORCE_LEAST
        if not shows:
            if self._shows:
                self._node.vertices, self._shows = self._hidden, False
            return
        self._shows = True
        length = self._length * size * SCALE
        up = force / size
        across = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        turn = np.stack([across, np.cross(up, across), up])
        points = np.concatenate([self._shaft * [1.0, 1.0, length], self._head + np.array([0.0, 0.0, length])])
        self._node.vertices = (points @ turn + tip * SCALE).astype(np.float32)


def _add_ground(scene: Any, points: FloatArray, up: FloatArray, right: FloatArray) -> Any:
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    low = float((points @ up).min()) - GROUND_GAP
    ground = middle + up * (low - middle @ up)
    half = GROUND_REACH * float(np.ptp(points, axis=0).max())
    along = np.cross(up, right)
    corners = [ground + half * (x * right + y * along) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return scene.add_mesh_simple(
        "/ground",
        (np.array(corners) * SCALE).astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
        color=GROUND_COLOUR,
        cast_shadow=False,
    )
