"""The part of an organ's surface that an instrument can press: points on it, normals, rasters and random places."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray, IntArray, TetMesh
from msdm_core.triangles import nearest_triangle
from surgsim_env.scenes import Palpation

# A raster of more points is a spacing in the wrong unit.
SITES_MOST = 100_000


@dataclass(frozen=True, eq=False)
class PalpableFace:
    """Surface triangles that face the instrument.

    Fields:
        points, normals: surface nodes' positions [m] and unit outward normals                      (n_node, 3)
        triangles: of the palpable face, outward                                                    (n_face, 3)
        rim: edges of the face's border                                                             (n_rim, 2)
        approach: unit vector along which the instrument comes                                      (3,)
        thickness: organ below each triangle along its inward normal [m]                            (n_face,)
        margin: distance that raster sites keep from the rim [m]
        thickness_smallest: points with less organ below them are left out [m]
    """

    points: FloatArray
    normals: FloatArray
    triangles: IntArray
    rim: IntArray
    approach: FloatArray
    thickness: FloatArray
    margin: float
    thickness_smallest: float

    def project(self, point: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The face's point nearest to a point [m] and the unit outward normal there, each (3,)."""
        return self._at(*nearest_triangle(self.points[self.triangles], np.asarray(point, dtype=np.float64)))

    def _at(self, face: int, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        nodes = self.triangles[face]
        normal = weights @ self.normals[nodes]
        return weights @ self.points[nodes], normal / np.linalg.norm(normal)

    def rim_distance(self, point: FloatArray) -> float:
        """Distance from a point to the face's border [m]."""
        start, end = self.points[self.rim[:, 0]], self.points[self.rim[:, 1]]
        span = end - start
        along = np.clip(((point - start) * span).sum(axis=1) / (span**2).sum(axis=1), 0.0, 1.0)
        return float(np.sqrt((((start + along[:, None] * span) - point) ** 2).sum(axis=1).min()))

    def random_point(self, rng: np.random.Generator, rim_distance: float) -> tuple[FloatArray, FloatArray]:
        """A point drawn evenly over the face, thick enough and rim_distance [m] from its border, and its normal there.

        Raises:
            ValueError: no such point in 1000 draws.
        """
        corners = self.points[self.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        cumulative = np.cumsum(area)
        for _ in range(1000):
            face = int(np.searchsorted(cumulative, rng.random() * cumulative[-1]))
            u, v = rng.random(2)
            root = math.sqrt(u)
            weights = np.array([1.0 - root, root * (1.0 - v), root * v])
            if self.thickness[face] < self.thickness_smallest:
                continue
            point, normal = self._at(face, weights)
            if self.rim_distance(point) >= rim_distance:
                return point, normal
        raise ValueError(
            f"no point of the palpable face is {rim_distance * 1000:.3g} mm from its border: "
            "widen palpation.face_angle_deg"
        )

    @cached_property
    def _plane(self) -> tuple[FloatArray, FloatArray]:
        """The triangles' corners across the approach (n_face, 3, 2) and against it (n_face, 3) [m]."""
        across, along = tangent_axes(self.approach)
        corners = self.points[self.triangles]
        return np.stack([corners @ across, corners @ along], axis=2), corners @ -self.approach

    def drop(self, u: float, v: float) -> tuple[FloatArray, FloatArray] | None:
        """The uppermost point of the face over a point of the plane of `tangent_axes` [m], and its normal, each (3,).

        None beyond the face.
        """
        hit = _drop(*self._plane, u, v)
        return None if hit is None else self._at(*hit)

    def site(self, u: float, v: float, *, slack: float = 0.0) -> tuple[FloatArray, FloatArray] | None:
        """`drop`, but None also nearer to the border than the face's margin less a slack [m], or over thin organ."""
        hit = _drop(*self._plane, u, v)
        if hit is None or self.thickness[hit[0]] < self.thickness_smallest:
            return None
        point, normal = self._at(*hit)
        return (point, normal) if self.rim_distance(point) >= self.margin - slack else None

    def raster(self, spacing: float) -> tuple[FloatArray, FloatArray]:
        """Points on a square grid seen along the approach, dropped onto the face, and their normals, each (n_site, 3).

        Points nearer to the border than the face's margin, or where the organ is too thin, are left out.
        """
        plane = self._plane[0]
        lower, upper = plane.min(axis=(0, 1)), plane.max(axis=(0, 1))
        points, normals = [], []
        for u, v in _grid(lower, upper, spacing):
            site = self.site(u, v)
            if site is not None:
                points.append(site[0])
                normals.append(site[1])
        return np.array(points).reshape(-1, 3), np.array(normals).reshape(-1, 3)


def find_palpable_face(mesh: TetMesh, approach: ArrayLike, palpation: Palpation) -> PalpableFace:
    """The surface triangles whose inward normal is within the scene's angle of the approach direction.

    Raises:
        ValueError: no triangle faces the instrument.
    """
    direction = np.asarray(approach, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    triangles = mesh.boundary_triangles
    corners = mesh.points[triangles]
    area_vector = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = area_vector / np.linalg.norm(area_vector, axis=1)[:, None]
    chosen = -unit @ direction >= math.cos(math.radians(palpation.face_angle_deg))
    if not chosen.any():
        raise ValueError("no part of the organ's surface faces the approach direction: turn instrument.approach")
    face = triangles[chosen]
    normals = np.zeros_like(mesh.points)
    for corner in range(3):
        np.add.at(normals, face[:, corner], area_vector[chosen])
    length = np.linalg.norm(normals, axis=1)
    normals[length > 0.0] /= length[length > 0.0, None]
    thickness = np.full(len(face), np.inf)
    if palpation.thickness_smallest > 0.0:
        thickness = _thickness(corners[chosen].mean(axis=1), -unit[chosen], corners)
    return PalpableFace(
        points=mesh.points,
        normals=normals,
        triangles=face,
        rim=_rim(face),
        approach=direction,
        thickness=thickness,
        margin=palpation.face_margin,
        thickness_smallest=palpation.thickness_smallest,
    )


def tangent_axes(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors across a direction, the first as near to world x (else y) as can be."""
    start = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = start - (start @ direction) * direction
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first) * (-1.0)


def _rim(face: IntArray) -> IntArray:
    edges = np.sort(np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def _grid(lower: FloatArray, upper: FloatArray, spacing: float) -> FloatArray:
    """Points of a square grid centred in a rectangle, row by row (boustrophedon), shape (n, 2)."""
    wanted = float(np.prod((upper - lower) / spacing + 1.0))
    if not wanted <= SITES_MOST:
        raise ValueError(
            f"site spacing {spacing * 1000:g} mm gives {wanted:.3g} raster points; at most {SITES_MOST} are allowed: "
            "use a larger spacing"
        )
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
    """The uppermost triangle over a point of the projection plane, with the barycentric weights there."""
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


def _thickness(origins: FloatArray, directions: FloatArray, corners: FloatArray) -> FloatArray:
    """Length of the chord inside the organ from each origin along each direction [m] (Moeller & Trumbore 1997)."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    result = np.full(len(origins), np.inf)
    for index, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(direction, edge2)
        determinant = (edge1 * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = origin - corners[:, 0]
            u = (offset * p).sum(axis=1) / determinant
            q = np.cross(offset, edge1)
            v = (q @ direction) / determinant
            distance = (edge2 * q).sum(axis=1) / determinant
            hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 1e-6)
        if hit.any():
            result[index] = distance[hit].min()
    return result
