"""An organ as voxels: what of a ball around a place it fills, and how thick it is along lines."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray, TetMesh
from surgsim_env.patient.surface_voxels import voxels_inside


class OrganVoxels:
    """The voxels inside an organ's boundary, of an edge `step` [m]."""

    def __init__(self, mesh: TetMesh, step: float) -> None:
        """Fill the boundary of a mesh."""
        self.step = step
        self._inside, self._first = voxels_inside(mesh.points, mesh.boundary_triangles.astype(np.int64), step)
        self._centres = (np.argwhere(self._inside) + self._first) * step
        self._tree = KDTree(self._centres)

    def contains(self, places: FloatArray) -> NDArray[np.bool_]:
        """Whether places [m] (..., 3) lie in the organ, (...,)."""
        index = np.rint(places / self.step).astype(np.int64) - self._first
        there = np.logical_and(index >= 0, index < self._inside.shape).all(axis=-1)
        x, y, z = np.moveaxis(np.where(np.expand_dims(there, -1), index, 0), -1, 0)
        return np.logical_and(there, self._inside[x, y, z])

    def near(self, place: FloatArray, radius: float) -> FloatArray:
        """From a place to the voxels of the organ within a radius [m], shape (n, 3)."""
        return self._centres[self._tree.query_ball_point(place, radius)] - place

    def filled_share(self, places: FloatArray, radius: float) -> FloatArray:
        """Which share of a ball of a radius [m] around each place (n, 3) the organ fills, (n,)."""
        count = self._tree.query_ball_point(places, radius, return_length=True)
        return np.asarray(count) * self.step**3 / (4.0 / 3.0 * np.pi * radius**3)

    def columns(
        self, origin: FloatArray, frame: FloatArray, x: FloatArray, depth: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Bottom and top of the organ along lines of a frame, followed inward from its origin.

        Args:
            origin: on the organ's edge [m], (3,).
            frame: columns are the axes x, y (outward) and z (3, 3).
            x: places along the edge [m], (n_x,).
            depth: how far inside the edge, against y [m], rising, (n_depth,).
            height: places along z that are tried [m], rising evenly, (n_height,).

        Returns:
            Two arrays of heights [m] (n_x, n_depth), NaN where a line meets no organ. Of several pieces along a line
            the one counts that is nearest to the middle of the piece before.
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
