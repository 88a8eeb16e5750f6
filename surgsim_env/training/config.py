"""Configuration of a training run: one YAML file read into frozen dataclasses, every entry checked."""

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from surgsim_env.scene.load import fill


@dataclass(frozen=True)
class EnvironmentSettings:
    """The training environments.

    Fields:
        id: of the environment, such as "SurgSim/Palpate-v0"
        kwargs: its arguments (scene, level, memory, ...)
        kind: "lanes" (side by side in vector registers), "library" (presses looked up, PalpateSites only), "bells"
            (contrast from bell curves on drawn faces, PalpateSites only), "surrogate" (forces by formula, Palpate on
            blocks only) or "dummy" (one after the other, any Gymnasium id)
        count: number of environments
        dtype, threads: of lanes
        library: file of presses for kind "library"
        action_repeat: control steps per decision
        without_force: force channels of the observation are set to 0
        belief: PalpateSites with memory as maps of belief, its action as a site's number: for the policy "SitePolicy"
        normalize_observation, normalize_reward: running mean and variance, as stable-baselines3's VecNormalize
    """

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    kind: Literal["lanes", "library", "bells", "surrogate", "dummy"] = "lanes"
    count: int = 16
    dtype: Literal["float64", "float32"] = "float32"
    threads: int = 1
    library: str | None = None
    action_repeat: int = 1
    without_force: bool = False
    belief: bool = False
    normalize_observation: bool = True
    normalize_reward: bool = True

    def __post_init__(self) -> None:
        for name in ("count", "threads", "action_repeat"):
            _at_least(f"environment.{name}", getattr(self, name), 1)
        if (self.kind == "library") != (self.library is not None):
            raise ValueError(
                f"environment.kind is {self.kind!r} and environment.library is {self.library!r}: "
                'a library file goes with kind "library", and with no other'
            )


@dataclass(frozen=True)
class Stage:
    """A part of a run's curriculum: what training pays beside the environment's rewards. Evaluations pay none of it.

    Fields:
        begin: environment steps at which it begins; the first stage begins at 0
        failure: share of the reward terms of a failure (`per` "failure" or "step left") that training pays; below 1 a
            policy that still fails by chance does not learn to do nothing instead
        novelty: reward of each site of the touch map that is felt for the first time in an episode
            (`count-based exploration`, Bellemare et al. 2016), for SurgSim/Palpate-v0 with memory
        near: distance from the lesion [m] up to which a wrong declaration of SurgSim/Palpate-v0 is paid as a right one
    """

    begin: int = 0
    failure: float = 1.0
    novelty: float = 0.0
    near: float = 0.0

    def __post_init__(self) -> None:
        _at_least("stage.begin", self.begin, 0)
        if not 0.0 <= self.failure <= 1.0:
            raise ValueError(f"stage.failure is {self.failure}; it is a share, 0 to 1")
        if not 0.0 <= self.novelty < math.inf:
            raise ValueError(f"stage.novelty is {self.novelty}; it is the reward of a site, finite and at least 0")
        if not 0.0 <= self.near < math.inf:
            raise ValueError(f"stage.near is {self.near}; it is a distance in m, finite and at least 0")


@dataclass(frozen=True)
class EvaluationSettings:
    """Periodic evaluation on separate seeds.

    Fields:
        every: environment steps between evaluations; 0 for none
        sampled: actions are drawn from the policy's distribution as in training, also by the policies that the run
            writes; otherwise the distribution's mean or mode acts
        episodes: of each evaluation
        score: criterion of the best policy: "return", or an entry of the episodes' last info
        score_sign: 1 if more is better, -1 if less is
    """

    every: int = 50_000
    sampled: bool = False
    episodes: int = 16
    score: str = "return"
    score_sign: Literal[1, -1] = 1

    def __post_init__(self) -> None:
        _at_least("evaluation.every", self.every, 0)
        _at_least("evaluation.episodes", self.episodes, 1)


@dataclass(frozen=True)
class CheckpointSettings:
    """Checkpoints, written between rollouts.

    Fields:
        every: environment steps between them
        keep: number of checkpoints that are kept
        replay_buffer: save the replay buffer (off-policy algorithms); else a resumed run first fills a new one
    """

    every: int = 50_000
    keep: int = 2
    replay_buffer: bool = True

    def __post_init__(self) -> None:
        _at_least("checkpoint.every", self.every, 1)
        _at_least("checkpoint.keep", self.keep, 1)


@dataclass(frozen=True)
class TrainingConfig:
    """One run.

    Fields:
        name: of the run and its policy
        algorithm: a class of stable_baselines3 or sb3_contrib, such as "PPO", "SAC", "RecurrentPPO"
        policy: its policy's name
        environment: the training environments
        total_steps: environment steps (decisions, summed over environments)
        seed: of environments, networks and exploration
        hyperparameters: arguments of the algorithm; `{linear: x}` falls from x to 0, activation functions by name
        warm_start: initial policy file, with its normalisation
        warm_spread: initial standard deviation of a warm start's actions; by default the file's
        critic_first: first steps that train the value function alone, which a cloned policy lacks
        initial_action, initial_spread: mean and standard deviation of each entry of a new policy's actions; by default
            near 0, and what `log_std_init` in `policy_kwargs` says. For algorithms whose actions are Gaussian, as PPO
        stages: the curriculum; empty: the environment's rewards alone
        torch_threads: threads of torch
    """

    name: str
    algorithm: str
    environment: EnvironmentSettings
    total_steps: int
    policy: str = "MlpPolicy"
    seed: int = 0
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    warm_start: str | None = None
    warm_spread: float | None = None
    critic_first: int = 0
    initial_action: tuple[float, ...] | None = None
    initial_spread: tuple[float, ...] | None = None
    stages: tuple[Stage, ...] = ()
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    checkpoint: CheckpointSettings = field(default_factory=CheckpointSettings)
    torch_threads: int = 1

    def __post_init__(self) -> None:
        for name, least in (("total_steps", 1), ("seed", 0), ("critic_first", 0), ("torch_threads", 1)):
            _at_least(name, getattr(self, name), least)
        if self.warm_spread is not None and (self.warm_start is None or not self.warm_spread > 0.0):
            raise ValueError(
                f"warm_spread is {self.warm_spread} and warm_start {self.warm_start}: it is the positive standard "
                "deviation of a warm start's actions"
            )
        if self.initial_spread is not None and not all(0.0 < one < math.inf for one in self.initial_spread):
            raise ValueError(f"initial_spread is {list(self.initial_spread)}; standard deviations are above 0")
        for name in ("initial_action", "initial_spread"):
            if self.warm_start is not None and getattr(self, name) is not None:
                raise ValueError(f"{name} is of a new policy, and warm_start names a trained one: leave one out")
        begins = [stage.begin for stage in self.stages]
        if begins and (begins[0] != 0 or sorted(set(begins)) != begins):
            raise ValueError(f"stages begin at {begins}; the first begins at 0, and each later than the one before")
        _refuse_texts_of_numbers(self.hyperparameters, "hyperparameters")
        _refuse_texts_of_numbers(self.environment.kwargs, "environment.kwargs")


def read_config(path: Path, **changes: Any) -> TrainingConfig:
    """The configuration in a YAML file, top-level entries replaced by those of `changes` that are not None.

    Raises:
        ValueError: a file that cannot be read or is no YAML table; an entry that is unknown (suggests the nearest),
            missing or wrong.
    """
    try:
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"configuration {path} cannot be read: {error.strerror}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"configuration {path} is not valid YAML: {error}") from None
    if not isinstance(table, dict):
        raise ValueError(f"configuration {path} must hold a table of entries, not {type(table).__name__}")
    table |= {name: value for name, value in changes.items() if value is not None}
    return fill(TrainingConfig, table, f"configuration {path}")


def config_text(config: TrainingConfig) -> str:
    """The configuration as YAML, every entry written out."""
    return yaml.safe_dump(asdict(config), sort_keys=False)


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"{name} is {value}; it must be at least {least}")


def _refuse_texts_of_numbers(value: Any, where: str) -> None:
    """Refuse texts such as 3e-4: YAML reads a number without a point as text."""
    if isinstance(value, dict):
        for key, entry in value.items():
            _refuse_texts_of_numbers(entry, f"{where}.{key}")
    elif isinstance(value, str):
        try:
            number = float(value)
        except ValueError:
            return
        raise ValueError(f"{where} is the text {value!r}; write the number {number!r} with a point: 3.0e-4")
