"""The organ on the page: its deforming surface, the stiffness map painted on it, and its lesions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from msdm_core.material.regions import Lesion
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.live.stage import SCALE, STILL
from surgsim_env.palpation.touches import Indenter
from surgsim_env.rendering.surface import TRIANGLES_MOST, drawn_surface
from surgsim_env.rendering.tissue import lesion_ball
from surgsim_env.scene.anatomy import Anatomy

# Presses shallower than this share of the scene's press depth are ignored: they hardly depend on deeper tissue.
DEPTH_SHARE = 0.35
# Standard deviation of a touch's Gaussian weight, in contact radii sqrt(R d), and its cut-off in deviations.
WIDTH, REACH = 0.55, 2.0
# Least sum of weights at which a node counts as felt.
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
# Most triangles in plain mode, unless the simulation's surface has more.
PLAIN_TRIANGLES_MOST = 5_000
# Offset of the paint above the surface [m].
PAINT_ABOVE = 0.0004
NO_FACES = np.zeros((0, 3), dtype=np.int32)


class FeltMap:
    """Ratio of the measured force to Hertz's for the scene's healthy tissue, at each surface node.

    With Hertz's force h(d) of a ball on a half space, touches of force f at depths d give a node the contrast
    sum(w f h) / sum(w h^2) (weighted least squares), so that deep touches count most, as in `palpation.touches`.

    Fields:
        nodes: indices of the surface nodes                                      (n_surface,)
        contrast: the ratio; 0 without touches                                   (n_surface,)
        felt: whether the weights of the touches suffice                         (n_surface,)
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
        """Whether a node counts as felt, (n_surface,)."""
        return self._weight >= WEIGHT_LEAST

    @property
    def contrast(self) -> FloatArray:
        """Force over Hertz's, 0 without touches, (n_surface,)."""
        return np.divide(self._product, self._square, out=np.zeros_like(self._product), where=self._square > 0.0)


class OrganView:
    """Nodes of a viser scene for an organ, its paint, and its lesions.

    Fields:
        paints: whether the stiffness map is shown
        plain: whether to draw fewer triangles, from the next picture on
    """

    def __init__(self, scene: Any, anatomy: Anatomy) -> None:
        """Add the organ at rest."""
        self._scene, self._mesh, self._points = scene, anatomy.mesh, anatomy.mesh.points
        self._surfaces = {
            plain: drawn_surface(anatomy.mesh.points, anatomy.mesh.boundary_triangles, most)
            for plain, most in ((False, TRIANGLES_MOST), (True, PLAIN_TRIANGLES_MOST))
        }
        self.plain = self._drawn_plain = False
        self._opacity: float | None = None
        self._shown = anatomy.mesh.points
        self._add_organ()
        self._paint = [_Paint(scene, f"/felt/{level}", colour) for level, colour in enumerate(COLOURS)]
        self._painted, self._fresh = -1, 1
        self.paints = True
        self._lesions: list[tuple[Any, Any]] = []

    def follow(self, node_position: FloatArray) -> None:
        """Move the surface to the node positions [m], (n_node, 3)."""
        self._choose_surface()
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

    def _choose_surface(self) -> None:
        """Switch between the fine and the plain surface, if `plain` changed."""
        if self.plain == self._drawn_plain:
            return
        self._drawn_plain = self.plain
        self._add_organ()
        for paint in self._paint:
            paint.cover(NO_FACES)
        self._painted, self._fresh = -1, 1

    def _add_organ(self) -> None:
        self._surface = self._surfaces[self._drawn_plain]
        vertices, _ = self._surface.follow(self._shown)
        faces = self._surface.faces.astype(np.uint32)
        self._organ = self._scene.add_mesh_simple(
            "/organ", _scaled(vertices), faces, color=ORGAN_COLOUR, opacity=self._opacity
        )

    def paint(self, felt: FeltMap) -> None:
        """Update the colours of the stiffness map; the softest part is blue."""
        self._choose_surface()
        if not self.paints or felt.version == self._painted:
            return
        self._painted, self._fresh = felt.version, 1
        value = np.full(len(self._points), np.nan)
        known = felt.felt
        value[felt.nodes[known]] = felt.contrast[known]
        corner = value[self._surface.corner_node]
        vertex = self._surface.weights @ np.nan_to_num(corner)
        vertex[self._surface.weights @ np.isnan(corner).astype(np.float64) > 1e-9] = np.nan
        face = vertex[self._surface.faces].mean(axis=1)
        level = colour_levels(face)
        for index, paint in enumerate(self._paint):
            paint.cover(self._surface.faces[level == index])

    def show_paint(self, on: bool) -> None:
        """Show or hide the stiffness map."""
        self.paints, self._painted, self._fresh = on, -1, 1
        if not on:
            for paint in self._paint:
                paint.cover(NO_FACES)
                paint.follow(np.zeros((0, 3), dtype=np.float32))

    def show_lesions(self, lesions: Sequence[Lesion]) -> None:
        """Show lesions inside a translucent organ; an empty list makes it opaque."""
        for _, node in self._lesions:
            node.remove()
        self._lesions = []
        self._opacity = 0.45 if lesions else None
        self._organ.opacity = self._opacity
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
        self._scene, self._name, self._colour = scene, name, colour
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
                    self._name, vertices[self._used], self._local, color=self._colour, cast_shadow=False
                )
                self._local = None
            return
        if self._local is not None:
            self._node.visible = bool(len(self._used))
        if not len(self._used):
            return
        self._node.vertices = vertices[self._used]
        if self._local is not None:
            self._node.faces, self._local = self._local, None


def colour_levels(contrast: FloatArray) -> np.ndarray:
    """Index into COLOURS of each contrast, relative to the lower quartile of all; -1 where it is NaN."""
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
