"""Control steps a second during learning with PPO: vectorised environments, the policy's actions and its updates."""

import time
from dataclasses import dataclass
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np

from surgsim_apps.bench.measurement import Effort, spread
from surgsim_apps.bench.report import AbsentError, Figure, Section, absent
from surgsim_env.coupling import core_count
from surgsim_env.rendering import NoGLError

LANES = 16
# Of PPO: steps of each environment between updates are the effort's.
BATCH_SIZE, EPOCHS = 512, 4
METHOD = f"""Control steps of {LANES} environments together per second, vectorised in float32, {{cores}} cores, resets
included; medians, per second of wall clock and of processor time of all threads. "Stepping" is with random actions;
"PPO" is stable-baselines3's with its updates: {{steps}} steps of each environment, then {EPOCHS} epochs of minibatches
of {BATCH_SIZE}; two layers of 128, and for pictures the three convolutions of Mnih et al. (2015) before them."""
WALL, PROCESSOR = "wall", "processor"


@dataclass(frozen=True)
class Training:
    """An environment to learn, and the kind of its policy.

    Args:
        case: its name in the report.
        env_id, settings: of the environment.
        policy: of stable-baselines3.
    """

    case: str
    env_id: str
    settings: dict[str, Any]
    policy: str

    def envs(self) -> gym.vector.VectorEnv:
        """The environments, with resets in the last step of an episode."""
        lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "SameStep", "dtype": "float32"}
        return gym.make_vec(self.env_id, LANES, **lanes, **self.settings)


TRAININGS = (
    Training(
        "Palpate, phantom_small, memory",
        "SurgSim/Palpate-v0",
        {"scene": "phantom_small", "level": "standard", "memory": True},
        "MlpPolicy",
    ),
    Training("Retract", "SurgSim/Retract-v0", {}, "MlpPolicy"),
    Training("Retract, pictures", "SurgSim/Retract-v0", {"obs_mode": "rgb"}, "CnnPolicy"),
)


class Clock:
    """Rates of control steps in each round, per second of wall clock and of processor time."""

    def __init__(self) -> None:
        self.rates: dict[str, list[float]] = {WALL: [], PROCESSOR: []}
        self._begin = time.perf_counter(), time.process_time()

    def end_round(self, steps: int) -> None:
        """Note the rates of a round of control steps, and begin the next."""
        now = time.perf_counter(), time.process_time()
        for rates, then, last in zip(self.rates.values(), now, self._begin, strict=True):
            rates.append(steps / (then - last))
        self._begin = now


def measure(effort: Effort) -> Section:
    """Rates of each training, without and with PPO; absent ones are listed with the reason."""
    method = METHOD.format(cores=core_count(), steps=effort.rollout_steps)
    section = Section("training", "Control steps a second while PPO learns", method)
    for training in TRAININGS:
        for doing, run in (("stepping", step), ("PPO", learn)):
            try:
                clock = run(training, effort)
            except AbsentError as error:
                section.figures.append(absent(training.case, f"{doing}, {WALL}", "1/s", error))
                continue
            for kind, rates in clock.rates.items():
                note = f"{doing}, {kind}: {spread(rates)}"
                section.figures.append(Figure(training.case, f"{doing}, {kind}", median(rates), "1/s", note))
    return section


def step(training: Training, effort: Effort) -> Clock:
    """Step the environments with random actions.

    Raises:
        AbsentError: pictures without OpenGL.
    """
    envs = training.envs()
    try:
        # One seed for all rounds: each measures the same work.
        envs.action_space.seed(0)
        _begin(envs)
        clock = Clock()
        for _ in range(effort.training_rounds):
            for _ in range(effort.rollout_steps):
                envs.step(envs.action_space.sample())
            clock.end_round(LANES * effort.rollout_steps)
        return clock
    finally:
        envs.close()


def learn(training: Training, effort: Effort) -> Clock:
    """Let PPO learn, a round for each update.

    Raises:
        AbsentError: no stable-baselines3, or no OpenGL for pictures.
    """
    try:
        from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

        from surgsim_env import VectorEnvForStableBaselines
    except ImportError as missing:
        raise AbsentError(f"stable-baselines3 cannot be imported ({missing}): pip install 'surgsim[agents]'") from None
    envs = training.envs()
    try:
        _begin(envs)
        steps = LANES * effort.rollout_steps
        model = PPO(
            training.policy,
            VectorEnvForStableBaselines(envs),
            n_steps=effort.rollout_steps,
            batch_size=min(BATCH_SIZE, steps),
            n_epochs=EPOCHS,
            policy_kwargs={"net_arch": [128, 128]},
            seed=0,
            device="cpu",
        )
        # The first update includes one-off preparations.
        model.learn(steps)
        clock = Clock()
        for _ in range(effort.training_rounds):
            model.learn(steps, reset_num_timesteps=False)
            clock.end_round(steps)
        return clock
    finally:
        envs.close()


def _begin(envs: gym.vector.VectorEnv) -> None:
    """A first step, for compiling and opening the graphics."""
    try:
        envs.reset(seed=0)
    except NoGLError as none:
        raise AbsentError(none) from None
    envs.step(np.zeros_like(envs.action_space.sample()))
