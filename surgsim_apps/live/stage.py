"""Contents of the page's picture: camera, light, ground, organ and stiffness map, instrument, handles, force arrows."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from msdm_core.material import Lesion
from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.palpation import Indenter
from surgsim_env.rendering import (
    Camera,
    clip_triangles,
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
FAT_COLOUR, FORCE_COLOUR, BRAND_COLOUR = (74, 46, 40), (255, 224, 102), (232, 89, 12)
# Distance of the cavity's floor below the organ [m], its radius in sizes of the organ, its height over its radius, and
# its mesh.
GROUND_GAP, CAVITY_REACH, CAVITY_RISE, RINGS, SPOKES = 0.002, 2.5, 1.0, 40, 96
# Distance of the page's camera in distances of the overview camera, and its sideways shift in half picture heights.
FARTHER, FARTHER_UPRIGHT, ASIDE = 1.5, 2.3, 0.42
# Ambient intensity in plain light.
AMBIENT = 0.9
# In the page's decimetres; HANDLE_SHARE limits the handle to a share of the organ.
HANDLE_SIZE, HANDLE_SHARE, BALL_RADIUS = 0.35, 0.45, 0.03
SHAFT_RADIUS, HEAD_RADIUS, HEAD_LENGTH = 0.012, 0.035, 0.07
# Thickness of an aim's ring over its radius.
RING_SHARE, AIM_COLOUR = 0.06, (255, 255, 255)
# Length of a force arrow per newton: share of the organ's size, at most [m/N]; no arrow below the last value [N].
FORCE_SHARE, FORCE_LENGTH, FORCE_LEAST = 0.4, 0.06, 0.005

# Presses shallower than this share of the scene's press depth are ignored: they hardly depend on deeper tissue.
DEPTH_SHARE = 0.35
# Standard deviation of a touch's Gaussian weight, in contact radii sqrt(R d), and its cut-off in deviations.
WIDTH, REACH = 0.55, 3.0
# Least sum of weights of a felt node.
WEIGHT_TINY, WEIGHT_LEAST, WEIGHT_MOST = 1e-3, 0.5, 1e6
ORGAN_COLOUR, VESSEL_COLOUR, LESION_COLOUR = (158, 58, 50), (126, 38, 44), (250, 214, 120)
# Contrast of the first and the last colour, relative to the lower quartile of the map; number of colours.
CONTRASTS = (0.75, 2.25)
LEVELS = 16
TINY = 1e-9
# Kinds of paint, beside the names of fields.
STIFFNESS_MAP, NOTHING = "map", ""
# Offsets of the paint and of the vessels above the surface [m].
PAINT_ABOVE, VESSELS_ABOVE = 0.0004, 0.0002
# Vessels: number of waves of a field, mean wave length of their way and of their width in sizes of the organ, and mean
# half width over the deviation of the first.
VESSEL_WAVES, VESSEL_LENGTHS, VESSEL_WIDTH = 24, (0.25, 0.4), 0.05


def page_camera(anatomy: Anatomy, *, upright: bool = False) -> Camera:
    """The page's initial camera: as the overview, farther away, with the organ left of the panel.

    In an `upright` window, where the panel is folded, the organ is in the middle.
    """
    near = scene_cameras(anatomy, aspect=1.2)["overview"]
    distance = (FARTHER_UPRIGHT if upright else FARTHER) * float(np.linalg.norm(near.position - near.target))
    aside = (0.0 if upright else ASIDE) * distance * math.tan(math.radians(0.5 * near.fov)) * near.rotation[:, 0]
    target = near.target + aside
    return Camera.looking(target + distance * near.rotation[:, 2], target, near.up, near.fov)


def place(client: Any, camera: Camera) -> None:
    """Give the view of a tab to a camera."""
    with client.atomic():
        client.camera.position, client.camera.look_at = camera.position * SCALE, camera.target * SCALE
        client.camera.up_direction, client.camera.fov = camera.up, math.radians(camera.fov)


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
        self._cavity = _add_cavity(viser.scene, anatomy.mesh.points, camera.up, right)
        self.show_plain(False)

    def show_plain(self, on: bool) -> None:
        """Turn the greatest costs of a software renderer off or on: shadows, reflections, the cavity."""
        self._scene.configure_default_lights(enabled=True, cast_shadow=not on)
        self._scene.configure_environment_map(None if on else "warehouse", environment_intensity=0.6)
        self._scene.add_light_ambient("/ambient", intensity=AMBIENT if on else 0.0)
        self._cavity.visible = not on


class FeltMap:
    """Ratio of the measured force to Hertz's for the scene's healthy tissue, at each surface node.

    With Hertz's force h(d) of a ball on a half space, touches of force f at depths d give a node the contrast
    sum(w f h) / sum(w h^2) (weighted least squares), so that deep touches count most, as in `palpation.touches`.

    Fields:
        nodes: indices of the surface nodes                                      (n_surface,)
        contrast: the ratio; 0 without touches                                   (n_surface,)
        weight: of the touches, up to WEIGHT_MOST; a node is felt from WEIGHT_LEAST (n_surface,)
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
        self._product, self._square, self.weight = np.zeros((3, len(self.nodes)))
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
        self.weight[near] = np.minimum(self.weight[near] + weight, WEIGHT_MOST)
        self.version += 1

    @property
    def felt(self) -> np.ndarray:
        """Mask of felt nodes, (n_surface,)."""
        return self.weight >= WEIGHT_LEAST

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
        vertices, _ = self._rest = self._surface.follow(self._shown)
        faces = self._surface.faces.astype(np.uint32)
        self._organ = scene.add_mesh_simple("/organ", _scaled(vertices), faces, color=ORGAN_COLOUR, opacity=None)
        self._vessels = _Paint(scene, "/vessels", VESSEL_COLOUR)
        if anatomy.scene.mesh.block is None:
            self._vessels.cover(*_vessels(vertices, self._surface.faces))
        self._paint = [_Paint(scene, f"/felt/{level}", colour) for level, colour in enumerate(_level_colours())]
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
        self._vessels.follow((vertices + VESSELS_ABOVE * normals) * SCALE)
        if self.paints:
            above = (vertices + PAINT_ABOVE * normals) * SCALE
            for paint in self._paint:
                paint.follow(above)
        for ball, node in self._lesions:
            node.position = ball.centre_now(self._points, node_position) * SCALE

    def on_drag(self, moved: Callable[..., None]) -> None:
        """Call `moved` with the phase of a drag, the eye and the pointer [m], and True while shift is held."""
        _listen(self._organ, moved)

    def hit(self, eye: FloatArray, pointer: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Place [m] and outward normal of the surface at rest, seen from an eye behind a pointer [m]; None beside it.

        Intersection of a ray with triangles: Moeller & Trumbore 1997.
        """
        vertices, normals = self._rest
        faces, way = self._surface.faces, (pointer - eye) / np.linalg.norm(pointer - eye)
        corner, first, second = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
        first, second, from_corner = first - corner, second - corner, eye - corner
        across = np.cross(way, second)
        scale = (first * across).sum(axis=1)
        # The front alone: a ray against the outward normal has a positive determinant.
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (from_corner * across).sum(axis=1) / scale
            turned = np.cross(from_corner, first)
            v = turned @ way / scale
            distance = (second * turned).sum(axis=1) / scale
            met = (scale > 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        if not met.any():
            return None
        face = int(np.flatnonzero(met)[np.argmin(distance[met])])
        outward = np.array([1.0 - u[face] - v[face], u[face], v[face]]) @ normals[faces[face]]
        return eye + distance[face] * way, outward / np.linalg.norm(outward)

    def paint(self, felt: FeltMap) -> None:
        """Update the colours of the stiffness map; the softest part is blue."""
        if self.paints != STIFFNESS_MAP or felt.version == self._painted:
            return
        self._painted = felt.version
        shares, unfelt = np.zeros((2, len(self._points)))
        shares[felt.nodes] = contrast_shares(felt)
        # Weights are Gaussian: their logarithm is smooth.
        unfelt[felt.nodes] = -np.log(np.maximum(felt.weight, WEIGHT_TINY) / WEIGHT_LEAST)
        mix, faces = clip_triangles(self._surface.faces, self._surface.interpolate(unfelt))
        self._cover(mix @ self._surface.interpolate(shares), faces, mix)

    def paint_field(self, shares: FloatArray) -> None:
        """Update the colours of a field from the places of the nodes on its scale, 0 to 1, (n_node,)."""
        self._cover(np.minimum(self._surface.interpolate(shares), 1.0 - 2.0 * TINY), self._surface.faces)

    def show_paint(self, kind: str) -> None:
        """Show STIFFNESS_MAP, NOTHING or a field by its name, which `paint` or `paint_field` then colour."""
        self.paints, self._painted = kind, -1
        for paint in self._paint:
            paint.cover(csr_array((0, 0)), np.zeros((0, 3), dtype=np.int32))
            paint.follow(np.zeros((0, 3)))

    def _cover(self, shares: FloatArray, faces: IntArray, mix: csr_array | None = None) -> None:
        """Paint triangles by the places of their vertices on the scale, 0 to below 1, (n,); `mix` of the surface's."""
        self._fresh = 1
        least, most = shares[faces].min(axis=1), shares[faces].max(axis=1)
        for level, paint in enumerate(self._paint):
            # The part between two isolines; a triangle on the lower one belongs to it.
            low, high = level / LEVELS - TINY, (level + 1) / LEVELS - TINY
            above, part = clip_triangles(faces[(most >= low) & (least < high)], low - shares)
            below, part = clip_triangles(part, above @ shares - high)
            paint.cover(below @ above if mix is None else below @ above @ mix, part)

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
    """A band of the surface in one colour."""

    def __init__(self, scene: Any, name: str, colour: tuple[int, int, int]) -> None:
        self._scene, self._name, self._colour = scene, name, colour
        self._node: Any = None
        self._mix, self._faces = csr_array((0, 0)), np.zeros((0, 3), dtype=np.uint32)
        self._fresh = False

    def cover(self, mix: csr_array, faces: IntArray) -> None:
        self._mix, self._faces, self._fresh = mix, faces.astype(np.uint32), True

    def follow(self, vertices: FloatArray) -> None:
        covers = bool(len(self._faces))
        moved = (self._mix @ vertices).astype(np.float32) if covers else np.zeros((0, 3), dtype=np.float32)
        if self._node is None:
            if covers:
                self._node = self._scene.add_mesh_simple(
                    self._name, moved, self._faces, color=self._colour, cast_shadow=False
                )
        elif covers or self._fresh:
            self._node.visible = covers
            if covers:
                self._node.vertices = moved
                if self._fresh:
                    self._node.faces = self._faces
        self._fresh = False


def _vessels(vertices: FloatArray, faces: IntArray) -> tuple[csr_array, IntArray]:
    """Strips of a surface's triangles about the zeros of a random field, as wide as another one.

    Returns:
        Mix of the surface's vertices for each new one, and the new triangles.
    """
    rng, size = np.random.default_rng(0), float(np.ptp(vertices, axis=0).max())

    def field(length: float) -> FloatArray:
        waves = rng.normal(size=(3, VESSEL_WAVES)) * 2.0 * math.pi / (length * size)
        phases = rng.uniform(0.0, 2.0 * math.pi, VESSEL_WAVES)
        return math.sqrt(2.0 / VESSEL_WAVES) * np.cos(vertices @ waves + phases).sum(axis=1)

    way, width = (field(length) for length in VESSEL_LENGTHS)
    width = VESSEL_WIDTH * (0.3 + width)
    above, part = clip_triangles(faces, -width - way)
    below, part = clip_triangles(part, above @ (way - width))
    return below @ above, part


def _level_colours() -> list[tuple[int, int, int]]:
    return [tuple(row) for row in field_colours(LEVELS).tolist()]


def contrast_shares(felt: FeltMap) -> FloatArray:
    """Place of each surface node on the map's scale, 0 to below 1, relative to the lower quartile of what was felt."""
    low, high = CONTRASTS
    reference = np.quantile(felt.contrast[felt.felt], 0.25) if felt.felt.any() else 1.0
    return np.clip((felt.contrast / max(reference, 1e-12) - low) / (high - low), 0.0, 1.0 - 2.0 * TINY)


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

    def on_drag(self, moved: Callable[..., None]) -> None:
        """Call `moved` as `OrganView.on_drag` does, with the arm before."""
        for node, arm in zip(self.nodes, self.arms, strict=True):
            if arm is not None:
                _listen(node, partial(moved, arm))


def _listen(node: Any, moved: Callable[..., None]) -> None:
    async def call(event: Any) -> None:
        eye, pointer = (np.asarray(at, np.float64) / SCALE for at in (event.client.camera.position, event.end_position))
        moved(event.phase, eye, pointer, event.modifier == "shift")

    for modifier in (None, "shift"):
        node.on_drag("left", modifier=modifier)(call)


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
        points = np.concatenate([self._shaft * [1.0, 1.0, length], self._head + np.array([0.0, 0.0, length])])
        self._node.vertices = (points @ _turn_to(force / size) + tip * SCALE).astype(np.float32)


class Aim:
    """A ring on the surface under a tip, and a line from the ring to the tip: where a press would touch."""

    def __init__(self, scene: Any, arm: int, radius: float) -> None:
        """Add it for a tip's ball of a radius [m], without extent."""
        import trimesh

        ring = trimesh.creation.torus(radius * SCALE, RING_SHARE * radius * SCALE, 32, 8)
        line = trimesh.creation.cylinder(radius=0.5 * RING_SHARE * radius * SCALE, height=1.0, sections=8)
        line.apply_translation([0.0, 0.0, 0.5])
        self._radius, self._ring, self._line = radius, np.array(ring.vertices), np.array(line.vertices)
        faces = np.concatenate([ring.faces, line.faces + len(ring.vertices)]).astype(np.uint32)
        hidden = np.zeros((len(self._ring) + len(self._line), 3), dtype=np.float32)
        self._node = scene.add_mesh_simple(f"/aim/{arm}", hidden, faces, color=AIM_COLOUR, cast_shadow=False)
        self._shown = np.full(3, np.inf)

    def follow(self, tip: FloatArray, place: FloatArray, outward: FloatArray) -> None:
        """Draw it at a place of the surface [m] with its normal, under a tip [m], each (3,)."""
        if np.abs(tip - self._shown).max() < STILL:
            return
        self._shown = tip
        gap = max(0.0, float((tip - place) @ outward) - self._radius) * SCALE
        points = np.concatenate([self._ring, self._line * [1.0, 1.0, gap]]) @ _turn_to(outward)
        self._node.vertices = (points + (place + RING_SHARE * self._radius * outward) * SCALE).astype(np.float32)


def _turn_to(way: FloatArray) -> FloatArray:
    """Rotation of row vectors that turns the z axis to a unit vector, (3, 3)."""
    across = np.cross(way, [1.0, 0.0, 0.0] if abs(way[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(way, across), way])


def _add_cavity(scene: Any, points: FloatArray, up: FloatArray, right: FloatArray) -> Any:
    """A bowl of fat around the organ, with folds."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    low = float((points @ up).min()) - GROUND_GAP
    reach = CAVITY_REACH * float(np.ptp(points, axis=0).max())
    radius, angle = np.meshgrid(np.linspace(0.0, 1.0, RINGS), np.linspace(0.0, 2.0 * math.pi, SPOKES + 1)[:-1])
    waves = ((3, 4.0), (5, -9.0), (8, 14.0), (13, 23.0))
    fold = sum(np.sin(count * angle + turn * radius + count) / count for count, turn in waves)
    # Flat under the organ.
    height = CAVITY_RISE * np.maximum(0.0, radius - 0.25) ** 2 * (1.0 + 0.4 * fold)
    across, along = radius * np.cos(angle), radius * np.sin(angle)
    axes = np.stack([right, np.cross(up, right), up])
    vertices = (
        reach * np.stack([across, along, height], axis=2).reshape(-1, 3) @ axes + middle + up * (low - middle @ up)
    )
    ring, spoke = np.meshgrid(np.arange(RINGS - 1), np.arange(SPOKES))
    here, there = RINGS * spoke + ring, RINGS * ((spoke + 1) % SPOKES) + ring
    faces = np.stack([here, here + 1, there + 1, here, there + 1, there], axis=2).reshape(-1, 3)
    return scene.add_mesh_simple(
        "/cavity",
        (vertices * SCALE).astype(np.float32),
        faces.astype(np.uint32),
        color=FAT_COLOUR,
        side="double",
        cast_shadow=False,
    )
