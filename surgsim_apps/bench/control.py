"""Control steps a second of the palpation environment, alone and in vector environments."""

import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_apps.bench.measurement import Effort, interleaved, spread
from surgsim_apps.bench.report import Figure, Section
from surgsim_env.coupling import core_count

SCENE = "phantom"
ENV_ID = "SurgSim/Palpate-v0"
# Control steps before the clock starts: at 20 mm/s the tip is on the tissue by then, from up to 6 mm above it.
WARM_UP = 9
METHOD = f"""Control steps of all environments together per second of wall clock, `{ENV_ID}` on `{SCENE}`, nearly
always in contact, resets included. "processes" is AsyncVectorEnv, one process per environment; "in turn"
SyncVectorEnv, one core; "abreast" `vectorization_mode="vector_entry_point"`, 8 organs per group in float64, 16 in
float32, one thread per group; {{cores}} cores here."""


def make_env() -> gym.Env:
    """One environment of the benchmark."""
    # The import of this package has registered the id, also in a process of its own.
    return gym.make(ENV_ID, scene=SCENE, scaled=False)


def contact_force() -> slice:
    """Entries of the contact force in an observation."""
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


def abreast(count: int, dtype: Literal["float64", "float32"]) -> Any:
    """Environments side by side in vector registers, one process, a thread for each group of organs."""
    return gym.make_vec(ENV_ID, count, vectorization_mode="vector_entry_point", scene=SCENE, scaled=False, dtype=dtype)


# One row each.
WAYS: dict[str, Callable[[int], Any]] = {
    "single": lambda count: gym.wrappers.Autoreset(make_env()),
    "in turn": lambda count: gym.vector.SyncVectorEnv([make_env] * count),
    "processes": lambda count: gym.vector.AsyncVectorEnv([make_env] * count),
    "abreast": partial(abreast, dtype="float64"),
    "abreast, float32": partial(abreast, dtype="float32"),
}


def rate(way: str, count: int, steps: int) -> float:
    """Control steps a second, `count` environments together."""
    envs, force = WAYS[way](count), contact_force()
    try:
        observation = envs.reset(seed=0)[0]
        for step in range(WARM_UP):
            observation = envs.step(stroke(observation, force, step))[0]
        begin = time.perf_counter()
        for step in range(steps):
            observation = envs.step(stroke(observation, force, step))[0]
        return count * steps / (time.perf_counter() - begin)
    finally:
        envs.close()


def measure(effort: Effort) -> Section:
    """The rates of all ways and numbers of environments."""
    section = Section("control_steps", "Control steps a second", METHOD.format(cores=core_count()))
    for count in effort.env_counts:
        steps = max(2, effort.control_steps // count)
        quantity = f"{count} envs" if count > 1 else "1 env"
        runs = {way: partial(rate, way, count, steps) for way in WAYS if count == 1 or way != "single"}
        for way, values in interleaved(runs, effort.control_rounds).items():
            section.figures.append(Figure(way, quantity, median(values), "1/s", f"{quantity}: {spread(values)}"))
    return section
