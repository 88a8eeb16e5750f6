"""Callbacks: checkpoints between rollouts, periodic evaluation, a value function that is trained first."""

import csv
from dataclasses import replace
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from agents.training.environments import make_environments
from agents.training.evaluation import mean_figures, play_episodes
from agents.training.policy_files import PolicyDescription, TrainedPolicy, save_policy
from agents.training.run import Run
from agents.training.whole_folders import keep_newest, write_file, write_folder


class BetweenRollouts(BaseCallback):
    """Evaluates and saves at intervals, only at the start of a rollout, when no update is in progress.

    A resumed run thus has the same rollouts as an uninterrupted one, and ends with the same number of steps.
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run
        notes = run.notes()
        start = run.model.num_timesteps
        self.saved_at = start
        self.evaluated_at = notes.get("evaluated_at", start)
        self.best_score: float | None = notes.get("best_score")
        self._envs = None
        _forget_rows_after(run.folder / "evaluations.csv", start)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        now, config = self.num_timesteps, self.run.config
        if config.evaluation.every and now - self.evaluated_at >= config.evaluation.every:
            self.evaluate()
        if now - self.saved_at >= config.checkpoint.every:
            self.save()

    def finish(self) -> None:
        """After the last update: evaluate, save, and write the final policy."""
        if self.run.config.evaluation.every:
            self.evaluate()
        self.save()
        self._write_policy("final", self.run.description())

    def save(self) -> None:
        """Write a checkpoint."""
        self.saved_at = self.run.model.num_timesteps
        self.run.save_checkpoint({"evaluated_at": self.evaluated_at, "best_score": self.best_score})

    def evaluate(self) -> None:
        """Play episodes, record the figures, save the policy if it is the best so far."""
        settings, model = self.run.config.evaluation, self.run.model
        if self._envs is None:
            count = min(self.run.config.environment.count, settings.episodes)
            self._envs = make_environments(self.run.config.environment, count)
        # These environments repeat actions, remove force and compute beliefs themselves.
        seen = replace(self.run.description(), action_repeat=1, force_entries=[], belief=None)
        figures = mean_figures(play_episodes(TrainedPolicy(model, seen), self._envs, settings.episodes))
        self.evaluated_at = model.num_timesteps
        if settings.score not in figures:
            raise ValueError(
                f"evaluation.score is {settings.score!r}, which no episode reports; known are {', '.join(figures)}"
            )
        score = figures[settings.score]
        _append_row(self.run.folder / "evaluations.csv", {"steps": model.num_timesteps, **figures})
        for name, value in figures.items():
            self.run.model.logger.record(f"evaluation/{name}", value)
        if self.best_score is None or settings.score_sign * (score - self.best_score) > 0.0:
            self.best_score = score
            self._write_policy("best", self.run.description(score))

    def _write_policy(self, place: str, description: PolicyDescription) -> None:
        folder = self.run.folder / place
        write_folder(
            folder,
            f"{self.run.model.num_timesteps:012d}",
            lambda path: save_policy(self.run.model, description, path / "policy.zip"),
        )
        keep_newest(folder, 1)


class CriticFirst(BaseCallback):
    """Trains the value function alone for the first steps: a cloned policy has an untrained value function."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        learns = self.num_timesteps >= self.steps
        for name, parameter in self.model.policy.named_parameters():
            if "value" not in name and "vf" not in name and "critic" not in name:
                parameter.requires_grad_(learns)
                if not learns:
                    parameter.grad = None


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
