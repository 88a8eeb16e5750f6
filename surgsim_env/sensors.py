"""Sensor models: what stands between the simulated force and the observation."""

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.scenes import ForceSensor


class ForceReading:
    """A three-axis force sensor: reading = force + bias + noise, cut at +-range.

    The bias is drawn once an episode, the noise at each reading. The cut is the only clipping between simulation and
    observation, and it is flagged.
    """

    def __init__(self, sensor: ForceSensor) -> None:
        self.sensor = sensor
        self.bias = np.zeros(3)

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's bias [N], uniform in +-sensor.bias on each axis."""
        self.bias = rng.uniform(-self.sensor.bias, self.sensor.bias, size=3)

    def read(self, force: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, bool]:
        """One reading of a force (3,) [N], and whether an axis was beyond the sensor's range."""
        reading = force + self.bias + rng.normal(0.0, self.sensor.noise, size=3)
        saturated = bool((np.abs(reading) > self.sensor.range).any())
        return np.clip(reading, -self.sensor.range, self.sensor.range), saturated
