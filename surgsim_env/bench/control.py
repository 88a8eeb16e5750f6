"""Control steps a second of the palpation environment, alone and in vector environments."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_env.bench.measurement import Effort, median, spread
from surgsim_env.bench.report import AbsentError, Figure, Section, absent, core_count

SCENE = "phantom"
ENV_ID = "SurgSim/Palpate-v0"
# Control steps before the clock starts: at 20 mm/s the tip is on the tissue by then, from up to 6 mm above it.
WARM_UP = 9
METHOD = f"""Control steps of all environments together per second of wall clock, `{ENV_ID}` on `{SCENE}`, each
environment with its own lesion and place. A policy presses until it feels 0.1 N and then strokes to and fro, so that
nearly every haptic step is one in contact; resets are in the time where episodes end. "processes" is AsyncVectorEnv,
one process an environment; "in turn" SyncVectorEnv, one core; "abreast" `vectorization_mode="vector_entry_point"`, 8
organs a group in float64, 16 in float32, a thread a group; {{cores}} cores here."""


def make_env() -> gym.Env:
    """One environment of the benchmark."""
    # The import of this package has registered the id, also in a process of its own.
    return gym.make(ENV_ID, scene=SCENE)


def contact_force() -> slice:
    """The entries of an observation that are the contact force."""
    env = make_env()
    try:
        return env.unwrapped.observation_slices["contact_force"]  # type: ignore[attr-defined]
    finally:
        env.close()


def stroke(observation: NDArray[Any], force: slice, step: int) -> NDArray[np.float32]:
    """Actions for observations (..., n): down until 0.1 N, then to and fro."""
    action = np.zeros((*observation.shape[:-1], 4), dtype=np.float32)
    touching = np.linalg.norm(observation[..., force], axis=-1) > 0.1
    action[..., 2] = np.where(touching, 0.0, -1.0)
    action[..., 0] = np.where(touching, 0.25 * (-1) ** step, 0.0)
    return action


class One:
    """A single environment, stepped and reset as a vector environment would be."""

    num_envs = 1

    def __init__(self) -> None:
        self.env = make_env()

    def reset(self, *, seed: int) -> tuple[Any, Any]:
        """Begin an episode."""
        return self.env.reset(seed=seed)

    def step(self, action: NDArray[np.float32]) -> tuple[Any, ...]:
        """One control step; a reset where the episode is over."""
        result = self.env.step(action)
        return (self.env.reset()[0], *result[1:]) if result[2] or result[3] else result

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def in_turn(count: int) -> Any:
    """Gymnasium's SyncVectorEnv."""
    return gym.vector.SyncVectorEnv([make_env] * count)


def processes(count: int) -> Any:
    """Gymnasium's AsyncVectorEnv."""
    return gym.vector.AsyncVectorEnv([make_env] * count)


def abreast(count: int, dtype: Literal["float64", "float32"] = "float64") -> Any:
    """Environments side by side in vector registers, one process, a thread for each group of organs."""
    return gym.make_vec(ENV_ID, count, vectorization_mode="vector_entry_point", scene=SCENE, dtype=dtype)


def one(count: int) -> Any:
    """A single environment without a vector environment around it."""
    assert count == 1
    return One()


# One row each; a way that this version lacks raises AbsentError.
WAYS: dict[str, Callable[[int], Any]] = {
    "single": one,
    "in turn": in_turn,
    "processes": processes,
    "abreast": abreast,
    "abreast, float32": partial(abreast, dtype="float32"),
}


def rate(make: Callable[[], Any], steps: int) -> float:
    """Control steps a second, all environments together."""
    envs, force = make(), contact_force()
    try:
        observation = envs.reset(seed=0)[0]
        for step in range(WARM_UP):
            observation = envs.step(stroke(observation, force, step))[0]
        begin = time.perf_counter()
        for step in range(steps):
            observation = envs.step(stroke(observation, force, step))[0]
        return envs.num_envs * steps / (time.perf_counter() - begin)
    finally:
        envs.close()


def measure(effort: Effort) -> Section:
    """The rates of all ways and numbers of environments."""
    section = Section("control_steps", "Control steps a second", METHOD.format(cores=core_count()))
    for count in effort.env_counts:
        steps = max(2, effort.control_steps // count)
        quantity = f"{count} envs" if count > 1 else "1 env"
        ways = {way: partial(make, count) for way, make in WAYS.items() if count == 1 or way != "single"}
        rates: dict[str, list[float]] = {}
        for _ in range(effort.control_rounds):
            for way, make in list(ways.items()):
                try:
                    rates.setdefault(way, []).append(rate(make, steps))
                except AbsentError as why:
                    section.figures.append(absent(way, quantity, "1/s", why))
                    del ways[way], rates[way]
        for way, values in rates.items():
            section.figures.append(Figure(way, quantity, median(values), "1/s", f"{quantity}: {spread(values)}"))
    return section
