"""The force sensor: bias, noise and range between the simulated force and what is observed."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.model import ForceSensor


class ForceReading:
    """A three-axis force sensor: reading = force + bias + noise, clipped to +-range on each axis.

    The bias is drawn once per episode, the noise for each reading. The clip is the only one between simulation and
    observation, and it is reported.
    """

    def __init__(self, sensor: ForceSensor, bias: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Take the description of a sensor, and its present bias [N] (3,)."""
        self.sensor = sensor
        self.bias = np.array(bias, dtype=np.float64)

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's bias [N], uniform in +-sensor.bias on each axis."""
        self.bias = rng.uniform(-self.sensor.bias, self.sensor.bias, size=3)

    def read(self, force: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """One reading of a force (3,) [N], and whether an axis exceeded the sensor's range."""
        reading = force + self.bias + rng.normal(0.0, self.sensor.noise, size=3)
        saturated = bool((np.abs(reading) > self.sensor.range).any())
        return self._clipped(reading), saturated

    def read_along(self, force: FloatArray, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Readings [N] along unit normals (n, 3), clipped to +-range, of forces along them [N] (n,)."""
        error = self.bias + rng.normal(0.0, self.sensor.noise, size=normals.shape)
        return self._clipped(force + (normals * error).sum(axis=1))

    def _clipped(self, reading: FloatArray) -> FloatArray:
        return np.clip(reading, -self.sensor.range, self.sensor.range)
