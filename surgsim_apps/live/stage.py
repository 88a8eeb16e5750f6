"""Contents of the page's picture: camera, light, ground, organ and stiffness map, instrument, handles, force arrows."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.palpation import Indenter
from surgsim_env.rendering import (
    Camera,
    field_colours,
    geom_colour,
    is_support,
    lesion_ball,
    mesh_rows,
    organ_surface,
    scene_cameras,
)
from surgsim_env.scene import Anatomy

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

# Presses shallower than this share of the scene's press depth are ignored: they hardly depend on deeper tissue.
DEPTH_SHARE = 0.35
# Standard deviation of a touch's Gaussian weight, in contact radii sqrt(R d), and its cut-off in deviations.
WIDTH, REACH = 0.55, 2.0
# Least sum of weights of a felt node.
WEIGHT_LEAST = 0.5
ORGAN_COLOUR, LESION_COLOUR = (158, 58, 50), (250, 214, 120)
# Contrast of the first and the last colour, relative to the lower quartile of the map; colours from soft to stiff.
CONTRASTS = (0.75, 2.25)
COLOURS = (
    (45, 67, 148),
    (42, 120, 173),
    (49, 168, 160),
    (116, 198, 118),
    (205, 216, 85),
    (248, 184, 62),
    (240, 117, 48),
    (205, 46, 46),
)
# Kinds of paint, beside the names of fields.
STIFFNESS_MAP, NOTHING = "map", ""
# Offset of the paint above the surface [m].
PAINT_ABOVE = 0.0004
NO_FACES = np.zeros((0, 3), dtype=np.int32)


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
        """Turn the greatest costs of a software renderer off or on: shadows, reflections, a glossy ground."""
        self._scene.configure_default_lights(enabled=True, cast_shadow=not on)
        self._scene.configure_environment_map(None if on else "warehouse", environment_intensity=0.6)
        self._scene.add_light_ambient("/ambient", intensity=AMBIENT if on else 0.0)
        self._ground.material = "toon3" if on else "standard"


class FeltMap:
    """Ratio of the measured force to Hertz's for the scene's healthy tissue, at each surface node.

    With Hertz's force h(d) of a ball on a half space, touches of force f at depths d give a node the contrast
    sum(w f h) / sum(w h^2) (weighted least squares), so that deep touches count most, as in `palpation.touches`.

    Fields:
        nodes: indices of the surface nodes                                      (n_surface,)
        contrast: the ratio; 0 without touches                                   (n_surface,)
        felt: mask of nodes with enough weight of touches                        (n_surface,)
        version: increases with each change
    """

    def __init__(self, anatomy: Anatomy) -> None:
        """Begin without touches."""
        scene = anatomy.scene
        self.nodes: IntArray = anatomy.mesh.boundary_nodes
        self._tree = KDTree(anatomy.mesh.points[self.nodes])
        self._indenter = Indenter(scene.instrument.tip_radius, scene.material)
        self._depth_least = DEPTH_SHARE * scene.palpation.press_depth
        contact = (scene.instrument.tip_radius * scene.palpation.press_depth) ** 0.5
        # Not finer than the mesh.
        self._width = max(WIDTH * contact, 0.6 * anatomy.palpable_cell)
        self._radius = scene.instrument.tip_radius
        self.version = 0
        self.clear()

    def clear(self) -> None:
        """Delete all touches."""
        self._product, self._square, self._weight = np.zeros((3, len(self.nodes)))
        self.version += 1

    def feel(self, tip: FloatArray, depth: float, force: float) -> None:
        """Add a touch: the tip's centre [m], (3,), its depth below the surface at rest [m], the force's size [N]."""
        if depth < self._depth_least or force <= 0.0:
            return
        # Distance of the tip's centre from the surface at rest, on either side.
        away = abs(self._radius - depth)
        near = self._tree.query_ball_point(tip, away + REACH * self._width)
        if not near:
            return
        across = np.linalg.norm(self._tree.data[near] - tip, axis=1)
        across = np.sqrt(np.maximum(across**2 - away**2, 0.0))
        weight = np.exp(-0.5 * (across / self._width) ** 2)
        healthy = self._indenter.force(depth)
        self._product[near] += weight * force * healthy
        self._square[near] += weight * healthy**2
        self._weight[near] = np.minimum(self._weight[near] + weight, 1e6)
        self.version += 1

    @property
    def felt(self) -> np.ndarray:
        """Mask of felt nodes, (n_surface,)."""
        return self._weight >= WEIGHT_LEAST

    @property
    def contrast(self) -> FloatArray:
        """Force over Hertz's, 0 without touches, (n_surface,)."""
        return np.divide(self._product, self._square, out=np.zeros_like(self._product), where=self._square > 0.0)


class OrganView:
    """Nodes of a viser scene for an organ, its paint, and its lesions.

    Fields:
        paints: STIFFNESS_MAP, NOTHING or the name of a field
    """

    def __init__(self, scene: Any, anatomy: Anatomy) -> None:
        """Add the organ at rest."""
        self._scene, self._mesh, self._points = scene, anatomy.mesh, anatomy.mesh.points
        self._surface = organ_surface(anatomy)
        self._shown = anatomy.mesh.points
        vertices, _ = self._surface.follow(self._shown)
        faces = self._surface.faces.astype(np.uint32)
        self._organ = scene.add_mesh_simple("/organ", _scaled(vertices), faces, color=ORGAN_COLOUR, opacity=None)
        self._paint = [_Paint(scene, f"/felt/{level}", colour) for level, colour in enumerate(COLOURS)]
        self._painted, self._fresh = -1, 1
        self.paints = STIFFNESS_MAP
        self._lesions: list[tuple[Any, Any]] = []

    def follow(self, node_position: FloatArray) -> None:
        """Move the surface to the node positions [m], (n_node, 3)."""
        if self._fresh == 0 and np.abs(node_position - self._shown).max() < STILL:
            return
        self._fresh, self._shown = 0, node_position
        vertices, normals = self._surface.follow(node_position)
        self._organ.vertices = _scaled(vertices)
        if self.paints:
            above = _scaled(vertices + PAINT_ABOVE * normals)
            for paint in self._paint:
                paint.follow(above)
        for ball, node in self._lesions:
            node.position = ball.centre_now(self._points, node_position) * SCALE

    def paint(self, felt: FeltMap) -> None:
        """Update the colours of the stiffness map; the softest part is blue."""
        if self.paints != STIFFNESS_MAP or felt.version == self._painted:
            return
        self._painted = felt.version
        value = np.full(len(self._points), np.nan)
        known = felt.felt
        value[felt.nodes[known]] = felt.contrast[known]
        vertex = self._surface.interpolate(np.nan_to_num(value))
        vertex[self._surface.interpolate(np.isnan(value).astype(np.float64)) > 1e-9] = np.nan
        face = vertex[self._surface.faces].mean(axis=1)
        self._cover(colour_levels(face))

    def paint_field(self, shares: FloatArray) -> None:
        """Update the colours of a field from the places of the nodes on its scale, 0 to 1, (n_node,)."""
        face = self._surface.interpolate(shares)[self._surface.faces].mean(axis=1)
        self._cover(np.minimum((face * len(COLOURS)).astype(np.int64), len(COLOURS) - 1))

    def show_paint(self, kind: str) -> None:
        """Show STIFFNESS_MAP, NOTHING or a field by its name, which `paint` or `paint_field` then colour."""
        self.paints, self._painted = kind, -1
        for paint, colour in zip(self._paint, paint_colours(kind), strict=True):
            paint.colour = colour
            paint.cover(NO_FACES)
            paint.follow(np.zeros((0, 3), dtype=np.float32))

    def _cover(self, level: np.ndarray) -> None:
        """Paint each triangle in the colour of its level, from 0; -1 for none, (n_face,)."""
        self._fresh = 1
        for index, paint in enumerate(self._paint):
            paint.cover(self._surface.faces[level == index])

    def show_lesions(self, lesions: Sequence[Lesion]) -> None:
        """Show lesions inside a translucent organ; an empty list makes it opaque."""
        for _, node in self._lesions:
            node.remove()
        self._lesions = []
        self._organ.opacity = 0.45 if lesions else None
        for index, lesion in enumerate(lesions):
            ball = lesion_ball(self._mesh, lesion)
            node = self._scene.add_icosphere(
                f"/lesion/{index}",
                radius=float(ball.half_axes.max()) * SCALE,
                color=LESION_COLOUR,
                position=ball.centre * SCALE,
            )
            self._lesions.append((ball, node))
        self._fresh = 1


class _Paint:
    """The part of the surface in one colour."""

    def __init__(self, scene: Any, name: str, colour: tuple[int, int, int]) -> None:
        self._scene, self._name, self.colour = scene, name, colour
        self._used = np.zeros(0, dtype=np.int64)
        self._node: Any = None
        self._local = None

    def cover(self, faces: np.ndarray) -> None:
        self._used, local = np.unique(faces, return_inverse=True)
        self._local: np.ndarray | None = local.reshape(-1, 3).astype(np.uint32)

    def follow(self, vertices: np.ndarray) -> None:
        if self._node is None:
            if len(self._used):
                self._node = self._scene.add_mesh_simple(
                    self._name, vertices[self._used], self._local, color=self.colour, cast_shadow=False
                )
                self._local = None
            return
        if self._local is not None:
            self._node.visible, self._node.color = bool(len(self._used)), self.colour
        if not len(self._used):
            return
        self._node.vertices = vertices[self._used]
        if self._local is not None:
            self._node.faces, self._local = self._local, None


def paint_colours(kind: str) -> Sequence[tuple[int, int, int]]:
    """Colours of a kind of paint, from low to high."""
    return COLOURS if kind in (STIFFNESS_MAP, NOTHING) else [tuple(row) for row in field_colours(len(COLOURS)).tolist()]


def colour_levels(contrast: FloatArray) -> np.ndarray:
    """Index into COLOURS of each contrast, relative to the lower quartile of all; -1 for NaN."""
    level = np.full(len(contrast), -1)
    known = np.isfinite(contrast)
    if known.any():
        low, high = CONTRASTS
        reference = np.quantile(contrast[known], 0.25)
        share = (contrast[known] / max(reference, 1e-12) - low) / (high - low)
        level[known] = np.clip((share * len(COLOURS)).astype(np.int64), 0, len(COLOURS) - 1)
    return level


def _scaled(vertices: FloatArray) -> np.ndarray:
    return (vertices * SCALE).astype(np.float32)


class InstrumentView:
    """Nodes of a viser scene for geoms of an instrument's model."""

    def __init__(self, scene: Any, model: mujoco.MjModel, geoms: list[int], arm_count: int) -> None:
        """Add a node for each geom.

        Args:
            scene: viser's.
            model: the instrument's.
            geoms: those to be drawn.
            arm_count: 1, or 2: then the names of the second arm's bodies begin with "right_".
        """
        self.nodes, self.arms = [], []
        self._shown: NDArray[np.float32] | None = None
        for place, geom in enumerate(geoms):
            node = _add(scene, f"/instrument/{place}", model, geom)
            self.nodes.append(node)
            body = model.body(int(model.geom_bodyid[geom])).name
            fixed = int(model.geom_bodyid[geom]) == 0 or is_support(model, geom)
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
        """Mask of geoms with a motion since they were last sent, (n_geom,)."""
        now = np.concatenate([position, rotation], axis=1)
        moved = np.ones(len(now), dtype=bool) if self._shown is None else np.abs(now - self._shown).max(axis=1) > STILL
        self._shown = now if self._shown is None else np.where(moved[:, None], now, self._shown)
        return moved

    def on_drag(self, moved: Callable[[int, str, FloatArray], None]) -> None:
        """Call `moved` with an arm, the phase of a drag and the pointer's position [m]."""
        for node, arm in zip(self.nodes, self.arms, strict=True):
            if arm is not None:
                node.on_drag("left")(_caller(moved, arm))


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
        capsule = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[20, 20])
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        vertices, faces = capsule.vertices, capsule.faces
    else:
        mesh = int(model.geom_dataid[geom])
        vertices, faces = mesh_rows(model, mesh, "vert") * SCALE, mesh_rows(model, mesh, "face")
    return scene.add_mesh_simple(name, np.asarray(vertices, np.float32), np.asarray(faces, np.uint32), color=colour)


def add_handle(
    scene: Any,
    arm: int,
    place: FloatArray,
    size: float,
    directions: FloatArray,
    pulled: Callable[[int, str, FloatArray], None],
) -> Any:
    """Add arrows for dragging a hand out of the organ, into it, and across it.

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
    """The tissue's force on a tip, as an arrow; a plain mesh, since its shader is compiled already."""

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
        if size <= FORCE_LEAST:
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
