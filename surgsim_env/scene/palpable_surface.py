"""Palpable part of an organ's surface: points, normals, rasters, random places, influence of the cell size."""

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import cos, matmul, norm
from msdm_core.kernels.ray_kernels import nearest_hits
from msdm_core.material.regions import Material
from msdm_core.mesh.geodesic import NearestTriangle
from msdm_core.mesh.surface import node_normals
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh, protect_arrays, read_only
from surgsim_env.scene.model import PalpationSettings

# Rounding error of heights of the face [m].
OPEN_GAP = 1e-6

# Radius of the probe's shaft along the approach [m], and the share of the tip's radius to be free of other tissue
# around its centre on a site.
SHAFT_RADIUS, TIP_FREE = 0.004, 0.8

# Mean time under load of the tissue at the readings of a press at 0.04 m/s and a hold of 0.1 s [s].
LOAD_TIME = 0.15

# Largest distance of a ray's hit on its own starting triangle [m].
HIT_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class PalpableFace:
    """Surface triangles facing the instrument.

    Fields:
        points, normals: surface nodes' positions [m] and unit outward normals                      (n_node, 3)
        triangles: of the palpable face, outward                                                    (n_face, 3)
        rim: edges of the face's border                                                             (n_rim, 2)
        approach: unit vector of the instrument's approach                                           (3,)
        thickness: organ below each triangle along its inward normal [m]                            (n_face,)
        margin: least distance of raster sites from the rim [m]
        thickness_smallest: least thickness of the organ below a site [m]
        solid: nodes, middles of edges and of triangles of the organ's whole surface [m]             (n_solid, 3)
        tip_radius: of the pressing tip [m]
    """

    points: FloatArray
    normals: FloatArray
    triangles: IntArray
    rim: IntArray
    approach: FloatArray
    thickness: FloatArray
    margin: float
    thickness_smallest: float
    solid: FloatArray
    tip_radius: float

    def __post_init__(self) -> None:
        protect_arrays(self)

    def project(self, point: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Point of the face nearest to a point [m] and the unit outward normal there, each (3,)."""
        return self._at(*self._nearest(np.asarray(point, dtype=np.float64)))

    def below(self, point: ArrayLike) -> tuple[FloatArray, FloatArray, float]:
        """As `project`, with the thickness of the organ below the point of the face [m]."""
        face, weights = self._nearest(np.asarray(point, dtype=np.float64))
        return *self._at(face, weights), float(self.thickness[face])

    @cached_property
    def _nearest(self) -> NearestTriangle:
        return NearestTriangle(self.points[self.triangles])

    def _at(self, face: int, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        nodes = self.triangles[face]
        normal = matmul(weights, self.normals[nodes])
        return matmul(weights, self.points[nodes]), normal / norm(normal)

    def carried(self, point: ArrayLike, other: "PalpableFace") -> FloatArray:
        """Point [m] (3,) of this face mapped to the face of another member of its family, with the same triangles."""
        face, weights = self._nearest(np.asarray(point, dtype=np.float64))
        return matmul(weights, other.points[other.triangles[face]])

    def rim_distance(self, point: FloatArray) -> float:
        """Distance from a point to the face's border [m]."""
        start, span, squared = self._rim_segments
        along = np.clip(((point - start) * span).sum(axis=1) / squared, 0.0, 1.0)
        return float(np.sqrt(np.square((start + along[:, None] * span) - point).sum(axis=1).min()))

    @cached_property
    def _rim_segments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Start and span of the border's edges (n_rim, 3) [m], and their squared lengths (n_rim,) [m^2]."""
        start, end = self.points[self.rim[:, 0]], self.points[self.rim[:, 1]]
        span = end - start
        return start, span, (span * span).sum(axis=1)

    @cached_property
    def _cumulative_area(self) -> FloatArray:
        """Twice the cumulative area of the triangles [m^2], shape (n_face,)."""
        corners = self.points[self.triangles]
        area = norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        return read_only(np.cumsum(area))

    def random_point(self, rng: np.random.Generator, rim_distance: float) -> tuple[FloatArray, FloatArray]:
        """Draw a point and its normal, uniformly over the open, thick face at least `rim_distance` [m] from its border.

        Raises:
            ValueError: no such point in 1000 draws.
        """
        for _ in range(1000):
            face, weights = self._random_place(rng)
            if self.thickness[face] < self.thickness_smallest:
                continue
            point, normal = self._at(face, weights)
            if self.rim_distance(point) >= rim_distance and self.is_open(point) and self.is_clear(point, normal):
                return point, normal
        raise ValueError(
            f"no point of the palpable face is {rim_distance * 1000:.3g} mm from its border: "
            "widen palpation.face_angle_deg"
        )

    def random_points(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Draw points uniformly over the face [m], normals, each (count, 3), and thickness below [m] (count,)."""
        places = [self._random_place(rng) for _ in range(count)]
        points, normals = zip(*(self._at(*place) for place in places), strict=True)
        return np.array(points), np.array(normals), self.thickness[[face for face, _ in places]]

    def _random_place(self, rng: np.random.Generator) -> tuple[int, FloatArray]:
        """Draw a triangle and barycentric weights (3,) in it, uniformly over the face."""
        cumulative = self._cumulative_area
        face = int(np.searchsorted(cumulative, rng.random() * cumulative[-1]))
        u, v = rng.random(2)
        root = math.sqrt(u)
        return face, np.array([1.0 - root, root * (1.0 - v), root * v])

    @cached_property
    def _plane(self) -> tuple[FloatArray, FloatArray]:
        """Corners of the triangles projected along the approach (n_face, 3, 2), and their heights (n_face, 3) [m]."""
        across, along = tangent_axes(self.approach)
        corners = self.points[self.triangles]
        return np.stack([matmul(corners, across), matmul(corners, along)], axis=2), matmul(corners, -self.approach)

    def drop(self, u: float, v: float) -> tuple[FloatArray, FloatArray] | None:
        """Uppermost point of the face over a point of the plane of `tangent_axes` [m], and its normal, each (3,).

        None outside the face.
        """
        hit = _drop(*self._plane, u, v)
        return None if hit is None else self._at(*hit)

    def is_open(self, point: FloatArray) -> bool:
        """True if no part of the face is above its point [m] (3,): a straight tool reaches it."""
        u, v = (float(matmul(point, axis)) for axis in tangent_axes(self.approach))
        top = self.drop(u, v)
        return top is None or float(matmul(top[0] - point, -self.approach)) <= OPEN_GAP

    def site(self, u: float, v: float, *, slack: float = 0.0) -> tuple[FloatArray, FloatArray] | None:
        """Pressable point of the face over a point of the plane, as in `drop`, or None.

        A point is not pressable over a thin organ, nearer to the border than the margin less a slack [m], or with other
        tissue in the way.
        """
        hit = _drop(*self._plane, u, v)
        if hit is None or self.thickness[hit[0]] < self.thickness_smallest:
            return None
        point, normal = self._at(*hit)
        if self.rim_distance(point) < self.margin - slack - ROUNDING or not self.is_clear(point, normal):
            return None
        return point, normal

    def is_clear(self, point: FloatArray, normal: FloatArray) -> bool:
        """True if a tip on the face at a point [m] (3,), and its shaft, touch no other part of the organ."""
        away = self.solid - (point + self.tip_radius * normal)
        along, square = matmul(away, -self.approach), (away * away).sum(axis=1)
        in_shaft = (along > 0.0) & (square - (along * along) < (SHAFT_RADIUS * SHAFT_RADIUS))
        return not (in_shaft | (square < np.square(TIP_FREE * self.tip_radius))).any()

    def raster(self, spacing: float) -> tuple[FloatArray, FloatArray]:
        """Points of a square grid projected along the approach onto the face, and their normals, each (n_site, 3).

        Points without a `site` are left out.
        """
        plane = self._plane[0]
        lower, upper = plane.min(axis=(0, 1)), plane.max(axis=(0, 1))
        sites = [site for u, v in _grid(lower, upper, spacing) if (site := self.site(u, v)) is not None]
        points, normals = np.moveaxis(np.array(sites).reshape(-1, 2, 3), 1, 0)
        return np.ascontiguousarray(points), np.ascontiguousarray(normals)


def find_palpable_face(
    mesh: TetMesh, approach: ArrayLike, palpation: PalpationSettings, tip_radius: float
) -> PalpableFace:
    """Surface triangles with an inward normal within the scene's angle of the approach.

    Args:
        mesh: of the organ.
        approach: direction of the tool (3,).
        palpation: the scene's.
        tip_radius: of the tool [m].

    Raises:
        ValueError: no triangle faces the instrument.
    """
    direction = np.asarray(approach, dtype=np.float64)
    direction = direction / norm(direction)
    triangles = mesh.boundary_triangles
    unit = _unit_normals(mesh.points[triangles])
    facing = matmul(-unit, direction) >= float(cos(math.radians(palpation.face_angle_deg)))
    if not facing.any():
        raise ValueError("no part of the organ's surface faces the approach direction: turn instrument.approach")
    return _face_of(mesh, facing, direction, palpation, tip_radius)


def moved_face(face: PalpableFace, mesh: TetMesh, palpation: PalpationSettings) -> PalpableFace:
    """Palpable face of the same triangles on a moved mesh (`TetMesh.moved`)."""
    triangles = set(map(tuple, face.triangles.tolist()))
    chosen = np.array([tuple(nodes) in triangles for nodes in mesh.boundary_triangles.tolist()], dtype=np.bool_)
    return _face_of(mesh, chosen, face.approach, palpation, face.tip_radius)


def _face_of(
    mesh: TetMesh,
    chosen: NDArray[np.bool_],
    direction: FloatArray,
    palpation: PalpationSettings,
    tip_radius: float,
) -> PalpableFace:
    """Palpable face of the chosen boundary triangles (n_triangle,), against a unit approach (3,)."""
    triangles = mesh.boundary_triangles
    corners = mesh.points[triangles]
    unit = _unit_normals(corners)
    face = triangles[chosen]
    normals = node_normals(mesh.points, face)
    sides = np.sort(np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(sides, axis=0, return_counts=True)
    thickness = np.full(len(face), np.inf)
    if palpation.thickness_smallest > 0.0:
        # Length of the chord inside the organ from the middle of each triangle.
        nearest_hits(corners[chosen].mean(axis=1), -unit[chosen], corners, HIT_LEAST, thickness)
    return PalpableFace(
        points=mesh.points,
        normals=normals,
        triangles=face,
        rim=edges[counts == 1],
        approach=direction,
        thickness=thickness,
        margin=palpation.face_margin,
        thickness_smallest=palpation.thickness_smallest,
        solid=np.concatenate([mesh.points[mesh.boundary_nodes], *_middles(corners)]),
        tip_radius=tip_radius,
    )


def _unit_normals(corners: FloatArray) -> FloatArray:
    """Unit normals of triangles with given corners (n, 3, 3), shape (n, 3)."""
    area_vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return area_vector / norm(area_vector, axis=1)[:, None]


def _middles(corners: FloatArray) -> list[FloatArray]:
    """Middles of the edges and of triangles with given corners (n, 3, 3) [m], four arrays (n, 3)."""
    edges = [0.5 * (corners[:, side] + corners[:, side - 1]) for side in range(3)]
    return [*edges, corners.mean(axis=1)]


def tangent_axes(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors normal to a direction, the first as near to world x (else y) as possible."""
    start = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = start - matmul(start, direction) * direction
    first /= norm(first)
    return first, np.cross(direction, first) * (-1.0)


def _grid(lower: FloatArray, upper: FloatArray, spacing: float) -> FloatArray:
    """Points of a square grid centred in a rectangle, row by row (boustrophedon), shape (n, 2)."""
    axes = []
    for low, high in zip(lower, upper, strict=True):
        count = int((high - low) / spacing)
        axes.append(0.5 * (low + high) + (np.arange(count + 1) - 0.5 * count) * spacing)
    rows = []
    for row, v in enumerate(axes[1]):
        us = axes[0] if row % 2 == 0 else axes[0][::-1]
        rows.append(np.column_stack([us, np.full(len(us), v)]))
    return np.concatenate(rows)


def _drop(plane: FloatArray, height: FloatArray, u: float, v: float) -> tuple[int, FloatArray] | None:
    """Uppermost triangle over a point of the projection plane, with the barycentric weights there."""
    a, b, c = plane[:, 0], plane[:, 1], plane[:, 2]
    determinant = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    wb = ((u - a[:, 0]) * (c[:, 1] - a[:, 1]) - (v - a[:, 1]) * (c[:, 0] - a[:, 0])) / determinant
    wc = ((b[:, 0] - a[:, 0]) * (v - a[:, 1]) - (b[:, 1] - a[:, 1]) * (u - a[:, 0])) / determinant
    wa = 1.0 - wb - wc
    inside = np.flatnonzero((wa >= -1e-9) & (wb >= -1e-9) & (wc >= -1e-9))
    if inside.size == 0:
        return None
    weights = np.column_stack([wa, wb, wc])[inside]
    best = int(np.argmax((weights * height[inside]).sum(axis=1)))
    return int(inside[best]), weights[best]


# Distance [m] by which rounding may put a site at the margin nearer to the border.
ROUNDING = 1e-9
# Largest cell over contact radius; on coarser cells the force varies more between sites than over a deep lesion.
SHARE_LARGEST = 1.0
# Relative bias of a press at cell = contact radius: on blocks, and on filled surfaces.
MESH_BIAS = (0.05, 0.09)


def contact_radius(tip_radius: float, press_depth: float) -> float:
    """Contact radius of a pressed ball, sqrt(tip radius x press depth) (Hertz) [m]."""
    return math.sqrt(tip_radius * press_depth)


def mesh_bias(cell: float, tip_radius: float, press_depth: float) -> tuple[float, float]:
    """Estimate of the force that the mesh adds to a press, over that of infinitely small cells: least and most.

    MESH_BIAS (h / a)^2 with cells h at the surface and the contact radius a. Presses of balls into linear tissue:
    blocks are at the least, filled surfaces at the most; single places scatter by a third of the estimate around it.
    Stiffening tissue is touched over a wider patch, and its presses have about half the bias.
    """
    share = cell / contact_radius(tip_radius, press_depth)
    least, most = (factor * share * share for factor in MESH_BIAS)
    return least, most


def share_text(cell: float, tip_radius: float, press_depth: float) -> str:
    """Cell over contact radius in words, with `mesh_bias` and the consequence above SHARE_LARGEST."""
    share = cell / contact_radius(tip_radius, press_depth)
    least, most = mesh_bias(cell, tip_radius, press_depth)
    text = (
        f"{share:.2f} (cell {cell * 1e3:.3g} mm, tip {tip_radius * 1e3:.3g} mm, pressed {press_depth * 1e3:.3g} mm; "
        f"the mesh adds about {least:.0%} to {most:.0%} to the force)"
    )
    return f"{text}: above {SHARE_LARGEST:g}, the mesh itself is felt" if share > SHARE_LARGEST else text


def press_modulus(material: Material) -> float:
    """Young's modulus that a press feels [Pa]: E (1 + sum_i g_i exp(-t / tau_i)) at t = LOAD_TIME."""
    arms = material.relaxation
    return material.youngs_modulus * (1.0 if arms is None else float(arms.remaining(LOAD_TIME)))


def hertz_force(material: Material, tip_radius: float, press_depth: float) -> float:
    """Force of a ball on a half space of `press_modulus`, F = 4/3 E / (1 - nu^2) R^0.5 d^1.5 (Hertz 1881) [N]."""
    stiffness = press_modulus(material) / (1.0 - material.poisson_ratio * material.poisson_ratio)
    return 4.0 / 3.0 * stiffness * math.sqrt(tip_radius) * press_depth * math.sqrt(press_depth)


def hidden_share(force: float, slope: float, tip_radius: float, press_depth: float, contact_stiffness: float) -> float:
    """Share of a contrast's excess over 1 that compliant contact hides, 3 max(F', 1.5 F / d) / (2 pi k_p R d).

    Contact yields by p0 / k_p below the middle of the tip, with p0 = 3 F / (2 pi R d) (Hertz 1881); a force with the
    slope F' = dF/dd over the lesion falls by F' p0 / k_p. The force of a press elsewhere falls in proportion to itself,
    so a contrast C loses this share of C - 1. Linear tissue has F' = 1.5 F / d, stiffening tissue more; an organ that
    yields as a whole has less, but no less under the tip. Finite elements lose 1.0 to 1.4 of this share (`surgsim
    validate`, rows "hidden by contact"), whole organs over their stiffest lesion 1.3 to 1.8 (`liver`, spleen, kidney,
    `phantom`), `phantom_small` 0.7.

    Args:
        force: F, of the press over the lesion [N].
        slope: its dF/dd [N/m].
        tip_radius: R [m].
        press_depth: d [m].
        contact_stiffness: k_p [N/m^3].
    """
    steepest = max(slope, 1.5 * force / press_depth)
    return 1.5 * steepest / (math.pi * contact_stiffness * tip_radius * press_depth)


def warn_of_coarse_cells(owner: str, cell: float, tip_radius: float, press_depth: float) -> None:
    """Warn if the cells are so coarse that the mesh itself would be felt."""
    radius = contact_radius(tip_radius, press_depth)
    if cell > SHARE_LARGEST * radius:
        warnings.warn(
            f"{owner}: cell / contact radius is {share_text(cell, tip_radius, press_depth)}; use cells of at most "
            f"{radius * 1e3:.3g} mm, a larger tip or a deeper press",
            stacklevel=2,
        )
