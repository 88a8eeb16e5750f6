"""The chart of a palpable face: a rectangle in the plane across the approach, with a fixed grid of sites on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray
from surgsim_env.palpable_face import PalpableFace, tangent_axes

# Fewest and most sites on a side of the grid; an odd number has one in the middle.
SITES_FEWEST, SITES_MOST = 13, 25


@dataclass(frozen=True, eq=False)
class Chart:
    """A rectangle that holds the places where a face may be pressed, seen along the approach.

    Fields:
        across, along: unit vectors of the plane, the chart's first and second axis                       (3,)
        lower, upper: corners of the rectangle on these axes [m]                                          (2,)
        side_count: sites on each side of its grid, the outermost on the rectangle's border
    """

    across: FloatArray
    along: FloatArray
    lower: FloatArray
    upper: FloatArray
    side_count: int

    @property
    def extent(self) -> FloatArray:
        """Lengths of its sides [m] (2,)."""
        return self.upper - self.lower

    def place(self, point: ArrayLike) -> FloatArray:
        """Where a point (..., 3) [m] is on the chart, -1 to 1 along each axis within it, shape (..., 2)."""
        values = np.asarray(point, dtype=np.float64)
        plane = np.stack([values @ self.across, values @ self.along], axis=-1)
        return 2.0 * (plane - self.lower) / self.extent - 1.0

    def plane_point(self, place: ArrayLike) -> FloatArray:
        """The point of the plane [m] (..., 2) at a place (..., 2) of the chart: `place` the other way round."""
        return self.lower + 0.5 * (np.asarray(place, dtype=np.float64) + 1.0) * self.extent

    def site(self, place: ArrayLike) -> int | None:
        """Number of the grid's site nearest to a place (2,), row by row along the first axis; None beyond the grid."""
        steps = 0.5 * (np.asarray(place, dtype=np.float64) + 1.0) * (self.side_count - 1)
        column, row = np.floor(steps + 0.5).astype(int).tolist()
        if not (0 <= column < self.side_count and 0 <= row < self.side_count):
            return None
        return row * self.side_count + column

    @property
    def sites(self) -> FloatArray:
        """Places of all sites, shape (side_count**2, 2), in the order of their numbers."""
        axis = np.linspace(-1.0, 1.0, self.side_count)
        columns, rows = np.meshgrid(axis, axis)
        return np.column_stack([columns.ravel(), rows.ravel()])


def make_chart(face: PalpableFace, tip_radius: float) -> Chart:
    """The chart of a face: its outline's rectangle less its margin, sites about half a tip's radius [m] apart.

    Raises:
        ValueError: the margin leaves nothing of the face.
    """
    across, along = tangent_axes(face.approach)
    corners = face.points[face.triangles].reshape(-1, 3)
    plane = np.column_stack([corners @ across, corners @ along])
    lower, upper = plane.min(axis=0) + face.margin, plane.max(axis=0) - face.margin
    if not (upper > lower).all():
        raise ValueError(
            f"palpation.face_margin of {face.margin * 1000:.3g} mm leaves nothing of a palpable face of "
            f"{' x '.join(f'{side * 1000:.3g}' for side in np.ptp(plane, axis=0))} mm: make it smaller"
        )
    wanted = round(float((upper - lower).max()) / (0.5 * tip_radius)) + 1
    count = min(max(wanted + (wanted + 1) % 2, SITES_FEWEST), SITES_MOST)
    return Chart(across, along, lower, upper, count)
