"""A training run in its folder, new or resumed from its last complete checkpoint."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from agents.training.algorithms import algorithm_class, keywords, policy_class
from agents.training.config import TrainingConfig, config_text
from agents.training.environments import belief_facts, force_entries, make_environments, normalized, training_seed
from agents.training.policy_files import PolicyDescription, describe, load_policy
from agents.training.whole_folders import keep_newest, whole_folders, write_file, write_folder

# Sample count of a warm start's normalisation: so large that new observations hardly change it.
WARM_COUNT = 1e9


class Run:
    """The algorithm, its environments and its folder.

    The folder holds config.yaml, checkpoints/STEPS/, best/STEPS/ (policy.zip and policy.json), evaluations.csv, one
    progress csv and one TensorBoard file for each start, and at the end final/STEPS/.
    """

    def __init__(self, config: TrainingConfig, folder: Path) -> None:
        """Begin a run, or resume it from its folder's last complete checkpoint.

        Raises:
            ValueError: the folder holds a run with another configuration.
        """
        self.config, self.folder = config, folder
        torch.set_num_threads(config.torch_threads)
        self._claim_folder()
        saved = whole_folders(folder / "checkpoints")
        self.resumed_from = saved[-1] if saved else None
        self.gamma = float(config.hyperparameters.get("gamma", 0.99))
        self.bare = make_environments(config.environment)
        self.blind_entries = force_entries(self.bare) if config.environment.without_force else []
        self.model = self._begin() if self.resumed_from is None else self._resume(self.resumed_from)
        self.model.set_logger(self._logger())

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
            env_id=settings.id,
            env_kwargs=settings.kwargs,
            action_repeat=settings.action_repeat,
            force_entries=self.blind_entries,
            belief=asdict(belief_facts(self.bare)) if settings.belief else None,
            trained_steps=self.model.num_timesteps,
            seed=self.config.seed,
            score=score,
        )

    def save_checkpoint(self, notes: dict) -> None:
        """Write a checkpoint: model, normalisation, replay buffer, and the callbacks' notes."""

        def fill(folder: Path) -> None:
            self.model.save(folder / "model.zip")
            if self.normalization is not None:
                self.normalization.save(str(folder / "normalization.pkl"))
            if isinstance(self.model, OffPolicyAlgorithm) and self.config.checkpoint.replay_buffer:
                self.model.save_replay_buffer(folder / "replay_buffer.pkl")
            (folder / "notes.json").write_text(json.dumps(notes), encoding="utf-8")

        place = self.folder / "checkpoints"
        write_folder(place, f"{self.model.num_timesteps:012d}", fill)
        keep_newest(place, self.config.checkpoint.keep)

    def notes(self) -> dict:
        """The callbacks' notes in the checkpoint that the run was resumed from; empty for a new run."""
        if self.resumed_from is None:
            return {}
        return json.loads((self.resumed_from / "notes.json").read_text(encoding="utf-8"))

    def _claim_folder(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        file, text = self.folder / "config.yaml", config_text(self.config)
        if file.exists():
            # A run may be extended.
            old, new = (
                {line for line in one.splitlines() if not line.startswith("total_steps")}
                for one in (file.read_text(encoding="utf-8"), text)
            )
            if old != new:
                raise ValueError(
                    f"{self.folder} holds a run with other settings ({'; '.join(sorted(old - new))} there, "
                    f"{'; '.join(sorted(new - old))} here): name another folder with --out"
                )
        write_file(file, text)

    def _begin(self) -> BaseAlgorithm:
        config = self.config
        envs = normalized(self.bare, config.environment, self.gamma)
        kind = algorithm_class(config.algorithm)
        model = kind(
            policy_class(config.policy), envs, seed=config.seed, device="cpu", **keywords(config.hyperparameters)
        )
        if config.warm_start is not None:
            self._warm(model, Path(config.warm_start))
        envs.seed(training_seed(config.seed, 0))
        return model

    def _warm(self, model: BaseAlgorithm, path: Path) -> None:
        """Copy a policy's weights and normalisation.

        Raises:
            ValueError: other networks, or only one of policy and run has a normalisation.
        """
        warm = load_policy(path)
        try:
            model.policy.load_state_dict(warm.model.policy.state_dict())
        except RuntimeError as error:
            raise ValueError(
                f"warm_start {path}: its networks are not those of this run; set policy and policy_kwargs alike: "
                f"{error}"
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
        envs: VecEnv = self.bare
        if (saved / "normalization.pkl").exists():
            envs = VecNormalize.load(str(saved / "normalization.pkl"), self.bare)
        model = algorithm_class(self.config.algorithm).load(saved / "model.zip", env=envs, device="cpu")
        if (saved / "replay_buffer.pkl").exists():
            assert isinstance(model, OffPolicyAlgorithm)
            model.load_replay_buffer(saved / "replay_buffer.pkl")
        elif isinstance(model, OffPolicyAlgorithm):
            # The buffer is empty: it is filled before training continues.
            model.learning_starts += model.num_timesteps
        envs.seed(training_seed(self.config.seed, model.num_timesteps))
        return model

    def _logger(self) -> Logger:
        """A logger with one progress file for each start, named by its first step."""
        start = f"_{self.model.num_timesteps:012d}"
        kinds = ("csv", "tensorboard")
        return Logger(str(self.folder), [make_output_format(kind, str(self.folder), start) for kind in kinds])
