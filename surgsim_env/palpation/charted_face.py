"""Where a chart's places are on the organ: the site to press at each, and surface points for what is estimated."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray
from surgsim_env.palpable_face import PalpableFace
from surgsim_env.palpation.chart import Chart

# The surface is kept at so many points between two sites of the chart's grid.
POINTS_BETWEEN = 2
# The chart's border lies on the margin, by rounding a little within it [m].
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Site:
    """A place that may be pressed: on the chart (2,), its surface point and unit outward normal [m] (3,) each.

    `moved` is how far the place that was asked for had to be moved along the chart [m].
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
        """The site at a place of the chart (2,), or the nearest of the grid's where that may not be pressed.

        Beyond the face, nearer to its rim than its margin, or too thin: such a place is moved.
        """
        asked = np.asarray(place, dtype=np.float64)
        u, v = self.chart.plane_point(asked).tolist()
        found = self.face.site(u, v, slack=ROUNDING)
        if found is not None:
            return Site(asked, *found, moved=0.0)
        places, points, normals = self._allowed
        way = np.linalg.norm(0.5 * (places - asked) * self.chart.extent, axis=1)
        best = int(np.argmin(way))
        return Site(places[best], points[best], normals[best], float(way[best]))

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
        """Surface points [m] (..., 3) at places of the chart (..., 2), between points that were dropped onto the face.

        Beyond the face: of the nearest point on it.
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
    """Values given on a square grid over a chart, rows along its second axis (m, m, ...), at places (..., 2): bilinear.

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
