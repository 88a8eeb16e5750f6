"""A fast surrogate of SurgSim/Palpate-v0 on organs of any shape: forces from a formula, all else from the task itself.

Training starts here; agents are scored on the full physics only. The ball follows its command, and the surface stays at
rest. With Hertz's force h of healthy tissue at the ball's depth below it, the force along the normal is

    F = s b h(depth) (1 + A exp(-r^2 / (2 w^2))) (1 + g(x))

with s the organ's stiffness over Hertz's half space, b the drawn background, r the distance from the lesion's place, A
and w its excess and width, and g a smooth field of a few waves, in place of rims and ligaments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_env.palpation import Indenter
from surgsim_env.tasks import ControlStep

# Ranges of an episode: s, A, w over the lesion's radius, amplitude of g, and wavelength over the tip's radius.
STIFFNESS, EXCESS, WIDTH, WAVE_MOST, WAVE_LENGTH = (1.2, 1.8), (0.35, 1.1), (0.6, 0.9), 0.12, (5.0, 15.0)
WAVES = 3
FRICTION = 0.2


@dataclass
class FormulaTip:
    """Stand-in for the instrument and the simulation of a task."""

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    tip_reading: NDArray[np.float64]
    tip_velocity: NDArray[np.float64]
    contact_force: NDArray[np.float64]
    contact_centre: NDArray[np.float64] | None = None
    time: float = 0.0
    fault: str = ""

    @property
    def instrument(self) -> "FormulaTip":
        """Itself."""
        return self

    def command_velocity(self, velocity: NDArray[np.float64]) -> None:
        """Take the velocity of the next step [m/s] (3,)."""
        self.tip_velocity = np.asarray(velocity, dtype=np.float64)

    def ground_shift(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Zero: the ground is at rest."""
        return np.zeros(3)


class FaceSurrogate:
    """Palpations of organs side by side, one episode each.

    Fields:
        envs: environments for their tasks alone, without simulation
        over: mask of ended episodes                                          (n_env,)
        infos: the last info of each
    """

    def __init__(self, envs: Sequence[gym.Env], rng: np.random.Generator) -> None:
        """Play environments of SurgSim/Palpate-v0 with memory=True and frame="face", of any scenes."""
        self.envs: list[Any] = [env.unwrapped for env in envs]
        self.rng = rng
        self.tips: list[FormulaTip] = []
        self.over = np.zeros(len(envs), dtype=np.bool_)
        self.infos: list[dict[str, Any]] = [{} for _ in envs]

    def reset(self) -> NDArray[np.float32]:
        """Draw an episode in each environment; returns observations (n_env, n_observation)."""
        self.over[:] = False
        self.tips = [self._begun(env) for env in self.envs]
        count, rng = len(self.envs), self.rng
        self.stiffness, self.excess = rng.uniform(*STIFFNESS, count), rng.uniform(*EXCESS, count)
        self.width = rng.uniform(*WIDTH, count) * [env.task.lesion.radius for env in self.envs]
        radius = np.array([env.task.charted.tip_radius for env in self.envs])
        wave = rng.normal(size=(count, WAVES, 3))
        length = rng.uniform(*WAVE_LENGTH, (count, WAVES)) * radius[:, None]
        self.wave = 2.0 * np.pi * wave / np.linalg.norm(wave, axis=2, keepdims=True) / length[:, :, None]
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (count, WAVES))
        self.amplitude = rng.uniform(0.0, WAVE_MOST / WAVES, (count, WAVES))
        self.truth = [env.task.anatomy.face.project(env.task.lesion.centre)[0] for env in self.envs]
        self.indenter = [Indenter(env.task.charted.tip_radius, env.scene.material) for env in self.envs]
        self._observations = np.stack([self._observe(index) for index in range(count)])
        return self._observations.copy()

    def step(self, actions: NDArray[np.floating]) -> NDArray[np.float32]:
        """One control step of the running episodes; returns observations (n_env, n_observation)."""
        for index in np.flatnonzero(~self.over):
            env, tip, action = self.envs[index], self.tips[index], np.asarray(actions[index], dtype=np.float64)
            env.runtime.begin(action, tip)
            tip.tip_reading = np.clip(
                tip.tip_reading + tip.tip_velocity * env.scene.timing.control_step, tip.lower, tip.upper
            )
            self._press(index)
            self._observations[index] = self._observe(index)
            verdict = env.runtime.judge(self._step(index))
            self.over[index] = verdict.terminated or verdict.truncated
            self.infos[index] = verdict.info
        return self._observations.copy()

    def _begun(self, env: Any) -> FormulaTip:
        """A tip at the start of a drawn episode, without its organ."""
        instrument = env.simulation.instrument
        start = np.asarray(env.runtime.draw(self.rng), dtype=np.float64)
        return FormulaTip(instrument.lower, instrument.upper, start, np.zeros(3), np.zeros(3))

    def _press(self, index: int) -> None:
        """Set the force and the touched point of a tip."""
        task, tip = self.envs[index].task, self.tips[index]
        surface, normal = task.anatomy.face.project(tip.tip_reading)
        depth = task.charted.tip_radius - float((tip.tip_reading - surface) @ normal)
        tip.contact_centre = surface if depth > 0.0 else None
        bump = self.excess[index] * np.exp(-0.5 * ((surface - self.truth[index]) ** 2).sum() / self.width[index] ** 2)
        field = 1.0 + self.amplitude[index] @ np.sin(self.wave[index] @ surface + self.phase[index])
        healthy = self.stiffness[index] * task.drawn.background * self.indenter[index].force(max(depth, 0.0))
        speed = float(np.linalg.norm(tip.tip_velocity))
        way = tip.tip_velocity / speed if speed > 0.0 else np.zeros(3)
        tip.contact_force = healthy * field * (1.0 + bump) * (normal - FRICTION * (way - (way @ normal) * normal))

    def _observe(self, index: int) -> NDArray[np.float32]:
        env = self.envs[index]
        return env.as_observed(env.runtime.observe(self._step(index), self.rng)[0])

    def _step(self, index: int) -> ControlStep:
        tip: Any = self.tips[index]
        return ControlStep(tip, float(np.linalg.norm(tip.contact_force)))
