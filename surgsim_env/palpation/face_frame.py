"""Frame of a palpable face: tip positions on a registered organ, independent of its size and pose."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import matmul
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.palpation.chart import ChartedFace


@dataclass(frozen=True, eq=False)
class FaceFrame:
    """Axes along the sides of a face's chart and against the approach, with the origin above the chart's middle.

    Fields:
        axes: unit vectors as rows: the chart's first and second axis, and outward        (3, 3)
        origin: the middle of the chart, as high as the face's highest point [m]          (3,)
    """

    axes: FloatArray
    origin: FloatArray

    @classmethod
    def of(cls, charted: ChartedFace) -> "FaceFrame":
        """Frame of a face."""
        chart, outward = charted.chart, -charted.face.approach
        axes = np.stack([chart.across, chart.along, outward])
        top = float(matmul(charted.face.points[charted.face.triangles], outward).max())
        return cls(axes, matmul(np.append(chart.plane_point(np.zeros(2)), top), axes))

    def vector(self, world: ArrayLike) -> FloatArray:
        """Vector of the world (..., 3) in this frame."""
        return matmul(np.asarray(world, dtype=np.float64), self.axes.T)

    def point(self, world: ArrayLike) -> FloatArray:
        """Point of the world [m] (..., 3) in this frame."""
        return self.vector(np.asarray(world, dtype=np.float64) - self.origin)

    def in_world(self, vector: ArrayLike) -> FloatArray:
        """Vector of this frame (..., 3) in the world."""
        return matmul(np.asarray(vector, dtype=np.float64), self.axes)
