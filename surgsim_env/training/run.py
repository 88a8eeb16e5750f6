"""A training run in its folder: begun, resumed, evaluated and saved."""

import csv
import json
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from surgsim_env.training.config import TrainingConfig, config_text, read_config
from surgsim_env.training.environments import (
    StagedRewards,
    force_entries,
    make_environments,
    observed_environment,
)
from surgsim_env.training.networks import POLICIES, algorithm_class, describe_networks, with_classes
from surgsim_env.training.policy_files import PolicyDescription, TrainedPolicy, describe, load_policy, save_policy

# First seeds of training and of its periodic evaluation; scores use others
# (`surgsim_env.palpation.scores.EVALUATION_SEEDS`, from 1,000,000 to 1,000,099).
TRAINING_SEEDS_FROM = 2_000_000
EVALUATION_SEED = 500_000
# Sample count of a warm start's normalisation: so large that new observations hardly change it.
WARM_COUNT = 1e9


class Run:
    """The algorithm, its environments and its folder.

    The folder holds config.yaml, checkpoints/STEPS/, best/STEPS/ (policy.safetensors and .json), evaluations.csv, one
    progress csv and one TensorBoard file for each start, and at the end final/STEPS/.
    """

    def __init__(self, config: TrainingConfig, folder: Path, *, trust_pickle: bool = False) -> None:
        """Begin a run, or resume it from its folder's last complete checkpoint.

        Checkpoints are pickles, as stable-baselines3 writes them: resume only runs of your own.

        Args:
            config: of the run.
            folder: of the run.
            trust_pickle: a warm start may be a zip of stable-baselines3, which runs any code that its author put there.

        Raises:
            ValueError: the folder holds a run with another configuration, a warm start that cannot be read or does not
                fit, or networks that a policy's file has no names for.
        """
        self.config, self.folder, self.trust_pickle = config, folder, trust_pickle
        torch.set_num_threads(config.torch_threads)
        self._claim_folder()
        saved = whole_folders(folder / "checkpoints")
        self.resumed_from = saved[-1] if saved else None
        self.bare = make_environments(config.environment)
        self._observed = observed_environment(config.environment, self.bare)
        self.staged = StagedRewards(self.bare, config.stages[0]) if config.stages else None
        self.blind_entries = force_entries(self.bare) if config.environment.without_force else []
        self.model = self._begin() if self.resumed_from is None else self._resume(self.resumed_from)
        # Refused now, and not when the first policy is written.
        describe_networks(self.model)
        # One progress file for each start, named by its first step.
        start = self.model.num_timesteps
        formats = [make_output_format(kind, str(folder), f"_{start:012d}") for kind in ("csv", "tensorboard")]
        self.model.set_logger(Logger(str(folder), formats))
        notes: dict[str, Any] = {}
        if self.resumed_from is not None:
            notes = json.loads((self.resumed_from / "notes.json").read_text(encoding="utf-8"))
        self.saved_at = start
        self.evaluated_at = notes.get("evaluated_at", start)
        self.best_score: float | None = notes.get("best_score")
        self._evaluated: VecEnv | None = None
        _forget_rows_after(folder / "evaluations.csv", start)

    @property
    def normalization(self) -> VecNormalize | None:
        """The environments' normalisation, if they have one."""
        return self.model.get_vec_normalize_env()

    def description(self, score: float | None = None) -> PolicyDescription:
        """The description of the current policy."""
        settings = self.config.environment
        return describe(
            self.model,
            self.normalization,
            self._observed,
            env_id=settings.id,
            env_kwargs=settings.kwargs,
            action_repeat=settings.action_repeat,
            sampled=self.config.evaluation.sampled,
            force_entries=self.blind_entries,
            belief=settings.belief,
            trained_steps=self.model.num_timesteps,
            seed=self.config.seed,
            score=score,
        )

    def between_rollouts(self) -> None:
        """Evaluate and save where it is due; called when no update is in progress.

        A resumed run thus has the same rollouts as an uninterrupted one, and ends with the same number of steps.
        """
        now, every = self.model.num_timesteps, self.config.evaluation.every
        if self.staged is not None:
            self.staged.stage = [stage for stage in self.config.stages if stage.begin <= now][-1]
        if every and now - self.evaluated_at >= every:
            self.evaluate()
        if now - self.saved_at >= self.config.checkpoint.every:
            self.save()

    def finish(self) -> None:
        """After the last update: evaluate, save, write the final policy and close the environments."""
        if self.config.evaluation.every:
            self.evaluate()
        self.save()
        self._write_policy("final", self.description())
        self.bare.close()

    def save(self) -> None:
        """Write a checkpoint: model, normalisation, replay buffer and notes on evaluations."""
        self.saved_at = self.model.num_timesteps

        def fill(folder: Path) -> None:
            self.model.save(folder / "model.zip")
            if self.normalization is not None:
                self.normalization.save(str(folder / "normalization.pkl"))
            if isinstance(self.model, OffPolicyAlgorithm) and self.config.checkpoint.replay_buffer:
                self.model.save_replay_buffer(folder / "replay_buffer.pkl")
            notes = {"evaluated_at": self.evaluated_at, "best_score": self.best_score}
            (folder / "notes.json").write_text(json.dumps(notes), encoding="utf-8")

        write_folder(self.folder / "checkpoints", f"{self.saved_at:012d}", fill)
        keep_newest(self.folder / "checkpoints", self.config.checkpoint.keep)

    def evaluate(self) -> None:
        """Play episodes, record the figures, save the policy if it is the best so far."""
        settings, steps = self.config.evaluation, self.model.num_timesteps
        if self._evaluated is None:
            count = min(self.config.environment.count, settings.episodes)
            self._evaluated = make_environments(self.config.environment, count)
        # These environments repeat actions, remove force and compute beliefs themselves.
        seen = replace(self.description(), action_repeat=1, force_entries=[], belief=False)
        figures = mean_figures(
            play_episodes(TrainedPolicy(self.model.policy, seen), self._evaluated, settings.episodes)
        )
        self.evaluated_at = steps
        if settings.score not in figures:
            raise ValueError(
                f"evaluation.score is {settings.score!r}, which no episode reports; known are {', '.join(figures)}"
            )
        score = figures[settings.score]
        _append_row(self.folder / "evaluations.csv", {"steps": steps, **figures})
        for name, value in figures.items():
            self.model.logger.record(f"evaluation/{name}", value)
        if self.best_score is None or settings.score_sign * (score - self.best_score) > 0.0:
            self.best_score = score
            self._write_policy("best", self.description(score))

    def _write_policy(self, place: str, description: PolicyDescription) -> None:
        folder, name = self.folder / place, f"{self.model.num_timesteps:012d}"
        networks = self.model.policy
        write_folder(folder, name, lambda path: save_policy(networks, description, path / "policy.safetensors"))
        keep_newest(folder, 1)

    def _claim_folder(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / "config.yaml"
        if file.exists():
            # A run may be extended.
            old, new = (
                {name: json.dumps(value, sort_keys=True) for name, value in asdict(one).items()}
                for one in (read_config(file, total_steps=self.config.total_steps), self.config)
            )
            if differ := [name for name in new if old[name] != new[name]]:
                shown = "; ".join(f"{name}: {old[name]} there, {name}: {new[name]} here" for name in differ)
                raise ValueError(
                    f"{self.folder} holds a run with other settings ({shown}): name another folder with --out"
                )
        write_file(file, config_text(self.config))

    def _begin(self) -> BaseAlgorithm:
        config, envs = self.config, self.staged or self.bare
        seen, paid = config.environment.normalize_observation, config.environment.normalize_reward
        if seen or paid:
            gamma = float(config.hyperparameters.get("gamma", 0.99))
            envs = VecNormalize(envs, norm_obs=seen, norm_reward=paid, gamma=gamma)
        policy: Any = POLICIES.get(config.policy, config.policy)
        settings = {"seed": config.seed, "device": "cpu", **keywords(config.hyperparameters)}
        model = algorithm_class(config.algorithm)(policy, envs, **settings)
        if config.warm_start is not None:
            self._warm(model, Path(config.warm_start))
        for entry in ("initial_action", "initial_spread"):
            if getattr(config, entry) is not None:
                set_initial(model, entry, getattr(config, entry))
        envs.seed(training_seed(config.seed, 0))
        return model

    def _warm(self, model: BaseAlgorithm, path: Path) -> None:
        """Copy a policy's weights and normalisation.

        Raises:
            ValueError: other networks, or only one of policy and run has a normalisation.
        """
        warm = load_policy(path, trust_pickle=self.trust_pickle)
        try:
            model.policy.load_state_dict(warm.networks.state_dict())
        except RuntimeError as error:
            raise ValueError(
                f"warm_start {path}: its networks are not those of this run; set policy and policy_kwargs alike: "
                f"{' '.join(str(error).split())}"
            ) from None
        if self.config.warm_spread is not None:
            policy: Any = model.policy
            with torch.no_grad():
                policy.log_std.fill_(math.log(self.config.warm_spread))
        mean, scaled = warm.description.observation_mean, model.get_vec_normalize_env()
        here = scaled is not None and scaled.norm_obs
        if (mean is not None) != here:
            raise ValueError(
                f"warm_start {path} was made {'with' if mean is not None else 'without'} a normalisation of its "
                f"observation: set environment.normalize_observation: {str(mean is not None).lower()}"
            )
        if scaled is not None and mean is not None:
            statistics: Any = scaled.obs_rms
            statistics.mean[:] = mean
            statistics.var[:] = warm.description.observation_variance
            statistics.count = WARM_COUNT

    def _resume(self, saved: Path) -> BaseAlgorithm:
        envs: VecEnv = self.staged or self.bare
        if (saved / "normalization.pkl").exists():
            envs = VecNormalize.load(str(saved / "normalization.pkl"), envs)
        model = algorithm_class(self.config.algorithm).load(saved / "model.zip", env=envs, device="cpu")
        if (saved / "replay_buffer.pkl").exists():
            assert isinstance(model, OffPolicyAlgorithm)
            model.load_replay_buffer(saved / "replay_buffer.pkl")
        elif isinstance(model, OffPolicyAlgorithm):
            # The buffer is empty: it is filled before training continues.
            model.learning_starts += model.num_timesteps
        envs.seed(training_seed(self.config.seed, model.num_timesteps))
        return model


class BetweenRollouts(BaseCallback):
    """Evaluates and saves between rollouts, and trains the value function alone for the first steps.

    A cloned policy has an untrained value function.
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.run.between_rollouts()
        learns = self.num_timesteps >= self.run.config.critic_first
        for name, parameter in self.model.policy.named_parameters():
            if "value" not in name and "vf" not in name and "critic" not in name:
                parameter.requires_grad_(learns)
                if not learns:
                    parameter.grad = None


def train(config: TrainingConfig, folder: Path, *, progress: bool = False, trust_pickle: bool = False) -> int:
    """Train up to the configuration's number of steps; returns the number reached."""
    run = Run(config, folder, trust_pickle=trust_pickle)
    model, start = run.model, run.model.num_timesteps
    if run.resumed_from is not None:
        print(f"resuming from {run.resumed_from} ({start} of {config.total_steps} steps)", flush=True)
    if start >= config.total_steps:
        return start
    # A resumed run trains for the remaining steps.
    left = config.total_steps - start
    model.learn(left, BetweenRollouts(run), reset_num_timesteps=start == 0, progress_bar=progress)
    run.finish()
    return model.num_timesteps


def set_initial(model: BaseAlgorithm, entry: str, values: Sequence[float]) -> None:
    """Set mean ("initial_action") or standard deviation ("initial_spread") of a new policy's actions, (n_action,).

    Raises:
        ValueError: actions that are not Gaussian with one standard deviation each, or another number of values.
    """
    policy: Any = model.policy
    spread = getattr(policy, "log_std", None)
    if spread is None or spread.ndim != 1:
        raise ValueError(
            f"{entry}: the actions of {type(model).__name__} are not Gaussian with one standard deviation each; leave "
            "it out, or train with PPO without use_sde"
        )
    if len(values) != len(spread):
        raise ValueError(f"{entry} has {len(values)} values; an action has {len(spread)} entries")
    given = torch.tensor(values, dtype=spread.dtype)
    with torch.no_grad():
        if entry == "initial_spread":
            spread.copy_(given.log())
        else:
            policy.action_net.bias.copy_(given)


def keywords(hyperparameters: dict[str, Any]) -> dict[str, Any]:
    """Hyperparameters as the algorithm's arguments: `{linear: x}` becomes a schedule, some names become classes.

    Raises:
        ValueError: an activation function or a features extractor that is unknown.
    """
    made: dict[str, Any] = {
        name: LinearSchedule(float(value["linear"]), 0.0, 1.0)
        if isinstance(value, dict) and set(value) == {"linear"}
        else value
        for name, value in hyperparameters.items()
    }
    if made.get("policy_kwargs"):
        made["policy_kwargs"] = with_classes(made["policy_kwargs"], "hyperparameters.policy_kwargs")
    return made


def training_seed(seed: int, steps: int) -> int:
    """First seed of the environments' episodes, different at each start of a run."""
    drawn = int(np.random.SeedSequence([seed, steps]).generate_state(1)[0])
    return TRAINING_SEEDS_FROM + drawn % (2**31 - 2 * TRAINING_SEEDS_FROM)


# ---- evaluation -----------------------------------------------------------------------------------------------------


def play_episodes(policy: TrainedPolicy, envs: VecEnv, episodes: int, seed: int = EVALUATION_SEED) -> list[dict]:
    """The last infos of deterministic episodes, with their returns and lengths.

    Each environment plays an equal share, so that short episodes are not over-represented. Environments that repeat
    actions need a policy with action_repeat 1.
    """
    wanted = np.array([(episodes + index) // envs.num_envs for index in range(envs.num_envs)])
    envs.seed(seed)
    observations, begins = envs.reset(), np.ones(envs.num_envs, dtype=np.bool_)
    policy.reset(envs.num_envs)
    records: list[list[dict]] = [[] for _ in wanted]
    while any(len(done) < count for done, count in zip(records, wanted, strict=True)):
        observations, _, begins, infos = envs.step(policy.act(observations, begins))
        for index in np.flatnonzero(begins):
            if len(records[index]) < wanted[index]:
                records[index].append(infos[index])
    return [record for one in records for record in one]


def mean_figures(records: list[dict[str, Any]]) -> dict[str, float]:
    """Means over episodes of return, length and every number in the last info."""
    figures = {
        "return": float(np.mean([record["episode"]["r"] for record in records])),
        "length": float(np.mean([record["episode"]["l"] for record in records])),
    }
    for name, value in records[0].items():
        if isinstance(value, bool | int | float | np.number | np.bool_):
            figures[name] = float(np.mean([float(record[name]) for record in records]))
    return figures


def _append_row(file: Path, row: dict[str, float]) -> None:
    begins = not file.exists()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(row))
        if begins:
            writer.writeheader()
        writer.writerow({name: f"{value:g}" if name != "steps" else value for name, value in row.items()})


def _forget_rows_after(file: Path, steps: int) -> None:
    """Drop rows that a killed run wrote after its last checkpoint: they will be evaluated again."""
    if not file.exists():
        return
    header, *rows = file.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [row for row in rows if row.endswith("\n") and int(row.split(",", 1)[0]) <= steps]
    write_file(file, "".join([header, *kept]))


# ---- atomic writes: under another name, synced, then renamed ---------------------------------------------------------

UNFINISHED = ".unfinished"


def write_folder(parent: Path, name: str, fill: Callable[[Path], None]) -> Path:
    """Let `fill` write the files of a new folder, which gets its name when all are on the disk.

    After a kill at any moment the folder is complete or absent; the next call removes an unfinished one.
    """
    parent.mkdir(parents=True, exist_ok=True)
    for leftover in parent.glob(f"*{UNFINISHED}"):
        shutil.rmtree(leftover)
    unfinished, finished = parent / f"{name}{UNFINISHED}", parent / name
    unfinished.mkdir()
    fill(unfinished)
    for file in unfinished.iterdir():
        _sync(file)
    _sync(unfinished)
    if finished.exists():
        _remove(finished)
    os.replace(unfinished, finished)
    _sync(parent)
    return finished


def write_file(file: Path, text: str) -> None:
    """Write a file atomically."""
    unfinished = file.with_name(file.name + UNFINISHED)
    unfinished.write_text(text, encoding="utf-8")
    _sync(unfinished)
    os.replace(unfinished, file)


def whole_folders(parent: Path) -> list[Path]:
    """The finished folders, in the order of their names."""
    return sorted(path for path in parent.glob("*") if path.is_dir() and path.suffix != UNFINISHED)


def keep_newest(parent: Path, count: int) -> None:
    """Remove all but the last `count` folders."""
    for old in whole_folders(parent)[:-count]:
        _remove(old)


def _remove(folder: Path) -> None:
    """Remove a folder; it is renamed first, so that no incomplete folder has its name."""
    doomed = folder.with_name(f"{folder.name}.old{UNFINISHED}")
    os.replace(folder, doomed)
    shutil.rmtree(doomed)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
