"""The force sensor and the taxels: errors between the simulated and the observed forces."""

import math
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.model import ForceSensor, Taxels


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

    def restored(self, state: ArrayLike) -> Self:
        """The same sensor in a state from `get_state`."""
        return type(self)(self.sensor, state)

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


class TaxelReading:
    """Patches of taxels: reading = f + (c / 4) sum_n (f_n - f) + drift x time + noise, clipped to +-range.

    f_n are the forces of the up to four neighbours, c the cross-talk, which changes no sum. Drift is drawn once per
    episode, the noise for each reading.

    Fields:
        drift: rate of each taxel's bias [N/s]                                    (n_patch, rows, columns, 3)
    """

    def __init__(self, taxels: Taxels, shape: tuple[int, ...], state: ArrayLike = 0.0) -> None:
        """Take the description of taxels, the shape of their forces, and their present state (`get_state`)."""
        self.sensor = taxels
        self.drift = np.broadcast_to(np.array(state, dtype=np.float64).reshape(-1), (math.prod(shape),)).reshape(shape)

    def get_state(self) -> list[float]:
        """Drift of all taxels."""
        return self.drift.ravel().tolist()

    def restored(self, state: ArrayLike) -> Self:
        """The same taxels in a state from `get_state`."""
        return type(self)(self.sensor, self.drift.shape, state)

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's drift [N/s], uniform on each axis of each taxel."""
        self.drift = rng.uniform(-self.sensor.drift, self.sensor.drift, size=self.drift.shape)

    def read(self, force: FloatArray, rng: np.random.Generator, time: float) -> tuple[FloatArray, bool]:
        """One reading of forces [N], of `drift`'s number, at a time of the episode [s], and whether any saturated."""
        true = force.reshape(self.drift.shape)
        reading, share = true + self.drift * time, 0.25 * self.sensor.cross_talk
        for axis in (1, 2):
            flow = share * np.diff(true, axis=axis)
            reading += np.diff(flow, axis=axis, prepend=0.0, append=0.0)
        reading += rng.normal(0.0, self.sensor.noise, size=true.shape)
        saturated = bool((np.abs(reading) > self.sensor.range).any())
        return np.clip(reading, -self.sensor.range, self.sensor.range).reshape(force.shape), saturated
