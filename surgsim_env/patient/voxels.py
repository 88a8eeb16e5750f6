"""The voxels inside a surface, and measures of an organ taken from its voxels."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.errors import MeshError
from msdm_core.mesh.surface import line_hits
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh

VOXELS_MOST = 150_000_000
# Shift of the grid [voxels], so that no line runs through a vertex or along an edge of an aligned surface.
SHIFT = 1e-6 * np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])


def voxels_inside(
    vertices: FloatArray, triangles: NDArray[np.int64], step: float, *, vote: bool = False
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Voxels whose centres lie inside (n_x, n_y, n_z), and the grid index of the first (3,); centres are index * step.

    Args:
        vertices: [m], shape (n_vertex, 3).
        triangles: shape (n_triangle, 3).
        step: edge of the voxels [m].
        vote: for surfaces with holes or self-intersections: majority of the lines along x, y and z through a voxel,
            counting those that leave the body as often as they enter it. Otherwise lines along x alone decide.
    """
    first = np.floor(vertices.min(axis=0) / step).astype(np.int64) - 1
    shape = np.ceil(vertices.max(axis=0) / step).astype(np.int64) + 2 - first
    if np.prod(shape.astype(np.float64)) > VOXELS_MOST:
        raise MeshError(
            f"the surface's box has {np.prod(shape.astype(np.float64)):.3g} voxels of {step:.3g} m; at most "
            f"{VOXELS_MOST:.3g} are made: use larger cells"
        )
    places = vertices / step - first + SHIFT
    if not vote:
        winding, _ = _winding(places, triangles, 0, shape)
        return winding % 2 == 1, first
    inside, voters = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        winding, closed = _winding(places, triangles, axis, shape)
        inside += (winding != 0) & closed
        voters += closed
    return 2 * inside > voters, first


def _winding(
    places: FloatArray, triangles: NDArray[np.int64], axis: int, shape: NDArray[np.int64]
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Entries minus exits of lines along an axis up to each voxel; whether each line ends outside (broadcastable)."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    a, b, c = (places[corner] for corner in triangles.T)
    leaving = np.cross(b - a, c - a)[:, axis] > 0
    crossed = np.zeros((shape[axis], shape[u], shape[v]), dtype=np.int16)
    for chosen, change in ((leaving, -1), (~leaving, 1)):
        if not chosen.any():
            continue
        # line_hits traces the lines at even coordinates only.
        row, column, at = line_hits(2.0 * places[:, u], 2.0 * places[:, v], places[:, axis], triangles[chosen], 0)
        np.add.at(crossed, (np.ceil(at).astype(np.int64), row // 2, column // 2), change)
    winding = np.cumsum(crossed, axis=0, dtype=np.int16)
    closed = np.broadcast_to(winding[-1:] == 0, winding.shape)
    # (axis, u, v) is a cyclic permutation of (x, y, z).
    back = [(0 - axis) % 3, (1 - axis) % 3, (2 - axis) % 3]
    return winding.transpose(back), closed.transpose(back)


class OrganVoxels:
    """The voxels of edge `step` [m] inside an organ's boundary."""

    def __init__(self, mesh: TetMesh, step: float) -> None:
        """Voxelise the inside of a mesh's boundary."""
        self.step = step
        self._inside, self._first = voxels_inside(mesh.points, mesh.boundary_triangles.astype(np.int64), step)
        self._centres = (np.argwhere(self._inside) + self._first) * step
        self._tree = KDTree(self._centres)

    def contains(self, places: FloatArray) -> NDArray[np.bool_]:
        """Whether points (..., 3) [m] lie in the organ (...,)."""
        index = np.rint(places / self.step).astype(np.int64) - self._first
        there = np.logical_and(index >= 0, index < self._inside.shape).all(axis=-1)
        x, y, z = np.moveaxis(np.where(np.expand_dims(there, -1), index, 0), -1, 0)
        return np.logical_and(there, self._inside[x, y, z])

    def near(self, place: FloatArray, radius: float) -> FloatArray:
        """Vectors from a point (3,) [m] to the organ's voxels within a radius [m] (n, 3)."""
        return self._centres[self._tree.query_ball_point(place, radius)] - place

    def filled_share(self, places: FloatArray, radius: float) -> FloatArray:
        """Share of a ball of a radius [m] around each point (n, 3) that the organ fills (n,)."""
        count = self._tree.query_ball_point(places, radius, return_length=True)
        return np.asarray(count) * self.step**3 / (4.0 / 3.0 * np.pi * radius**3)

    def columns(
        self, origin: FloatArray, frame: FloatArray, x: FloatArray, depth: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Bottom and top of the organ along the z lines of a frame, from its edge inward.

        Args:
            origin: on the organ's edge [m], (3,).
            frame: columns are the axes x, y (outward) and z (3, 3).
            x: positions along the edge [m], (n_x,).
            depth: distances inward from the edge, against y [m], rising, (n_depth,).
            height: positions along z that are sampled [m], evenly spaced, (n_height,).

        Returns:
            Two arrays of heights (n_x, n_depth) [m], NaN where a line misses the organ. If a line meets several pieces,
            the one nearest to the middle of the previous piece is taken.
        """
        places = (
            origin
            + x[:, None, None, None] * frame[:, 0]
            - depth[:, None, None] * frame[:, 1]
            + height[:, None] * frame[:, 2]
        )
        inside = self.contains(places)
        bottom = np.full(inside.shape[:2], np.nan)
        top, half = bottom.copy(), 0.5 * float(height[1] - height[0])
        for row in range(len(x)):
            middle = 0.0
            for place in range(len(depth)):
                edges = np.flatnonzero(np.diff(inside[row, place].astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
                if not len(edges):
                    continue
                low, high = height[edges[:, 0]], height[edges[:, 1] - 1]
                nearest = int(np.argmin(np.maximum(np.maximum(low - middle, middle - high), 0.0)))
                bottom[row, place], top[row, place] = low[nearest] - half, high[nearest] + half
                middle = 0.5 * float(low[nearest] + high[nearest])
        return bottom, top
