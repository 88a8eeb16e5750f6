"""The force sensor: bias, noise and range between the simulated and the observed force."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.model import ForceSensor


class ForceReading:
    """A three-axis force sensor: reading = held force + bias + drift x time + noise, clipped to +-range on each axis.

    Bias and drift are drawn once per episode, the noise for each reading; the held force follows the force with a play
    of +-hysteresis. The clip is the only one between simulation and observation, and it is reported.

    Fields:
        bias: [N] (3,)
        drift: rate of the bias [N/s] (3,)
        held: force that the sensor holds [N] (3,)
    """

    def __init__(self, sensor: ForceSensor, state: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Take the description of a sensor, and its present state (`get_state`)."""
        self.sensor = sensor
        values = np.array(state, dtype=np.float64)
        # One that neither drifts nor holds has a bias alone.
        self._plain = not (sensor.drift or sensor.hysteresis)
        self.bias = values[:3]
        self.drift, self.held = (values[3:6], values[6:]) if len(values) == 9 else np.zeros((2, 3))

    def get_state(self) -> list[float]:
        """Bias; of a sensor with drift or hysteresis also the drift and the held force."""
        return self.bias.tolist() if self._plain else np.concatenate([self.bias, self.drift, self.held]).tolist()

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's bias [N] and drift [N/s], each uniform on each axis; no force is held."""
        self.bias = rng.uniform(-self.sensor.bias, self.sensor.bias, size=3)
        if not self._plain:
            self.drift, self.held = rng.uniform(-self.sensor.drift, self.sensor.drift, size=3), np.zeros(3)

    def follow(self, force: FloatArray) -> None:
        """Let the held force follow a force (3,) [N]."""
        play = self.sensor.hysteresis
        self.held = np.clip(self.held, force - play, force + play)

    def read(self, force: FloatArray, rng: np.random.Generator, time: float) -> tuple[FloatArray, bool]:
        """One reading of a force (3,) [N] at a time of the episode [s], and whether an axis exceeded the range."""
        self.follow(force)
        reading = self.held + self.bias + self.drift * time + rng.normal(0.0, self.sensor.noise, size=3)
        saturated = bool((np.abs(reading) > self.sensor.range).any())
        return self._clipped(reading), saturated

    def read_along(self, force: FloatArray, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Readings [N] along unit normals (n, 3), clipped to +-range, of forces along them [N] (n,)."""
        error = self.bias + rng.normal(0.0, self.sensor.noise, size=normals.shape)
        return self._clipped(force + (normals * error).sum(axis=1))

    def _clipped(self, reading: FloatArray) -> FloatArray:
        return np.clip(reading, -self.sensor.range, self.sensor.range)
