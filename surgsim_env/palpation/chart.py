"""The chart of a palpable face: a rectangle across the approach with a grid of sites, and its sites on the surface."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.palpable_surface import PalpableFace, tangent_axes

# Fewest and most sites on a side of the grid; an odd number has one in the middle.
SITES_FEWEST, SITES_MOST = 13, 25
# Subdivisions of a cell of the grid in the table of surface points.
POINTS_BETWEEN = 2
# Rounding puts the chart's border slightly inside the margin: sites up to this [m] within it are accepted.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Chart:
    """A rectangle, seen along the approach, that contains all places where a face may be pressed.

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
        """Place (..., 2) of a point (..., 3) [m] on the chart: -1 to 1 along each axis inside it."""
        values = np.asarray(point, dtype=np.float64)
        plane = np.stack([values @ self.across, values @ self.along], axis=-1)
        return 2.0 * (plane - self.lower) / self.extent - 1.0

    def plane_point(self, place: ArrayLike) -> FloatArray:
        """The point of the plane [m] (..., 2) at a place (..., 2) of the chart, the inverse of `place`."""
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
    """The chart of a face: the bounding rectangle less the margin, sites about half a tip's radius [m] apart.

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


@dataclass(frozen=True, eq=False)
class Site:
    """A place that may be pressed.

    Fields:
        place: on the chart                                     (2,)
        point, normal: on the surface [m], and outward unit     (3,)
        moved: distance along the chart from the requested place [m]
    """

    place: FloatArray
    point: FloatArray
    normal: FloatArray
    moved: float


@dataclass(frozen=True, eq=False)
class ChartedFace:
    """A palpable face and its chart."""

    face: PalpableFace
    chart: Chart

    def site(self, place: ArrayLike) -> Site:
        """The site at a place of the chart (2,); the grid's nearest one if that may not be pressed.

        A place may not be pressed beyond the face, nearer to its rim than its margin, and over too thin tissue.
        """
        asked = np.asarray(place, dtype=np.float64)
        u, v = self.chart.plane_point(asked).tolist()
        found = self.face.site(u, v, slack=ROUNDING)
        if found is not None:
            return Site(asked, *found, moved=0.0)
        places, points, normals = self._allowed
        distance = np.linalg.norm(0.5 * (places - asked) * self.chart.extent, axis=1)
        best = int(np.argmin(distance))
        return Site(places[best], points[best], normals[best], float(distance[best]))

    @cached_property
    def _allowed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (n, 2), surface points [m] and normals (n, 3) of the grid's sites that may be pressed.

        Raises:
            ValueError: there is none.
        """
        points = self.chart.plane_point(self.chart.sites).tolist()
        sites = [
            (place, self.face.site(u, v, slack=ROUNDING))
            for place, (u, v) in zip(self.chart.sites, points, strict=True)
        ]
        allowed = [(place, *site) for place, site in sites if site is not None]
        if not allowed:
            raise ValueError(
                "no site of the palpable face may be pressed: lower palpation.face_margin or thickness_smallest"
            )
        places, points, normals = (np.array(values) for values in zip(*allowed, strict=True))
        return places, points, normals

    def surface(self, places: ArrayLike) -> FloatArray:
        """Surface points [m] (..., 3) at places of the chart (..., 2), interpolated in a table of projected points.

        Beyond the face, the table has the nearest point on it.
        """
        return interpolated(self._surface, places)

    @cached_property
    def _surface(self) -> FloatArray:
        side = POINTS_BETWEEN * (self.chart.side_count - 1) + 1
        axis = np.linspace(-1.0, 1.0, side)
        places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        dropped = [self.face.drop(*self.chart.plane_point(place).tolist()) for place in places]
        known = np.array([index for index, point in enumerate(dropped) if point is not None])
        points = np.array([dropped[index][0] for index in known])  # type: ignore[index]
        nearest = [int(np.argmin(((places[known] - place) ** 2).sum(axis=1))) for place in places]
        return points[nearest].reshape(side, side, 3)


def interpolated(values: FloatArray, places: ArrayLike) -> FloatArray:
    """Bilinear interpolation of a square grid over a chart (m, m, ...), rows along its second axis, at places (..., 2).

    Places beyond the chart take the values of its border.
    """
    side = len(values)
    steps = np.clip(0.5 * (np.asarray(places, dtype=np.float64) + 1.0), 0.0, 1.0) * (side - 1)
    low = np.minimum(steps.astype(np.intp), side - 2)
    share = steps - low
    column, row = low[..., 0], low[..., 1]
    trailing = (...,) + (None,) * (values.ndim - 2)
    s, t = share[..., 0][trailing], share[..., 1][trailing]
    lower = (1.0 - s) * values[row, column] + s * values[row, column + 1]
    upper = (1.0 - s) * values[row + 1, column] + s * values[row + 1, column + 1]
    return (1.0 - t) * lower + t * upper
