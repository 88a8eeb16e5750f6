"""Play episodes of SurgSim/PalpateSites-v0 side by side and record them for scoring."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.scoring.site_agent import SiteAgent, site_facts
from surgsim_env.palpation.press import HOLD_TIME, PRESS_SPEED
from surgsim_env.palpation.scores import MapScore, PalpationRecord
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

ENV_ID = "SurgSim/PalpateSites-v0"


class SiteChooser(Protocol):
    """Chooses sites for many environments at once: a baseline in each, or one network for all."""

    def begin(self, envs: Sequence[Any], seeds: Sequence[int]) -> None:
        """Begin an episode in each."""
        ...

    def choose(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Where to press next, shape (n, 2)."""
        ...

    def reference(self, index: int) -> Any:
        """Replacement of the estimator in environment `index`, as `agents.roster.Truth` has it, or None."""
        ...


class AgentChooser:
    """A baseline in each environment, its random generator seeded with the episode's seed."""

    def __init__(self, make: Callable[[], SiteAgent]) -> None:
        self.make = make

    def begin(self, envs: Sequence[Any], seeds: Sequence[int]) -> None:
        """Make an agent for each environment."""
        self.agents = [self.make() for _ in seeds]
        for agent, env, seed in zip(self.agents, envs, seeds, strict=True):
            agent.reset(np.random.default_rng(seed), site_facts(env))

    def choose(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next site of each agent, as actions (n, 2)."""
        return np.stack([agent.act(one) for agent, one in zip(self.agents, observations, strict=True)])

    def reference(self, index: int) -> Any:
        """The agent, if it replaces the estimator."""
        return self.agents[index] if hasattr(self.agents[index], "estimate") else None


class PolicyChooser:
    """A trained policy for all environments."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def begin(self, envs: Sequence[Any], seeds: Sequence[int]) -> None:
        """Reset the policy's state."""
        self.policy.reset(len(envs))
        self._begins = np.ones(len(envs), dtype=bool)

    def choose(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """The policy's deterministic actions (n, 2)."""
        actions = self.policy.act(observations, self._begins)
        self._begins = np.zeros_like(self._begins)
        return actions

    def reference(self, index: int) -> None:
        """None: the estimator is not replaced."""


class _Episode:
    """Record of an episode in progress."""

    def __init__(self, task: PalpateSitesTask, reference: Any) -> None:
        self.task, self.reference = task, reference
        self.estimates: list[NDArray[np.float64]] = []
        self.forces: list[tuple[float, float, float]] = []
        self.record: PalpationRecord | None = None

    def note(self, info: dict[str, Any], over: bool) -> None:
        """Add a press; the last one completes the record."""
        self.estimates.append(
            np.array(self.task.estimated if self.reference is None else self.reference.estimate(self.task))
        )
        self.forces.append((float(info["force"]), float(info["force_peak"]), float(info["depth"])))
        if over:
            self.record = self._made(info)

    def _made(self, info: dict[str, Any]) -> PalpationRecord:
        made = map_score(self.task)
        force, peak, depth = np.array(self.forces).T
        return PalpationRecord(
            truth=self.task.truth.copy(),
            estimates=self.estimates,
            cutoff=self.task.cutoff,
            force=force,
            force_peak=peak,
            # A linear ramp on the way in, then the hold.
            impulse=float((force * (HOLD_TIME + 0.5 * np.maximum(depth, 0.0) / PRESS_SPEED)).sum()),
            seconds=float(info["seconds"]),
            path_length=float(info["path_length"]),
            soft_force=self.task.limits.soft_force,
            hard_limit=bool(info["hard_limit"]),
            fault=str(info["sim_fault"]),
            map=made if self.reference is None else self.reference.estimate_map(made),
        )


def map_score(task: PalpateSitesTask) -> MapScore:
    """The task's last estimate as a map, with the lesions seen along the approach."""
    estimate, chart = task.estimate, task.charted.chart
    across, along = estimate.axes
    points = np.stack(np.meshgrid(across, along), axis=-1)
    sites = 0.5 * (chart.sites + 1.0) * chart.extent
    columns, rows = (np.abs(axis[:, None] - sites[:, i]).argmin(axis=0) for i, axis in enumerate((across, along)))
    cell_area = float((across[1] - across[0]) * (along[1] - along[0]))
    return MapScore(
        excess=estimate.excess[rows, columns],
        lesion=_over_lesion(task, sites),
        outline=estimate.outline,
        outline_true=_over_lesion(task, points),
        cell_area=cell_area,
    )


def _over_lesion(task: PalpateSitesTask, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether places of the chart (..., 2) [m] lie over a lesion, seen along the approach."""
    over = np.zeros(points.shape[:-1], dtype=bool)
    chart = task.charted.chart
    for lesion in task.lesions:
        centre = 0.5 * (chart.place(lesion.centre) + 1.0) * chart.extent
        over |= ((points - centre) ** 2).sum(axis=-1) <= lesion.radius**2  # type: ignore[operator]
    return over


def play(
    chooser: SiteChooser,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    *,
    progress: Callable[[], None] = lambda: None,
) -> list[PalpationRecord]:
    """Play an episode of each seed, as many at once as environments; `progress` is called after each press."""
    starts = range(0, len(seeds), envs.num_envs)
    rounds = [_round(chooser, envs, seeds[start : start + envs.num_envs], progress) for start in starts]
    return [record for records in rounds for record in records]


def _round(
    chooser: SiteChooser, envs: gym.vector.VectorEnv, seeds: Sequence[int], progress: Callable[[], None]
) -> list[PalpationRecord]:
    # Surplus environments play the last seed again, unrecorded.
    filled = [int(seed) for seed in [*seeds, *[seeds[-1]] * (envs.num_envs - len(seeds))]]
    observations, _ = envs.reset(seed=filled)
    singles = envs.unwrapped.envs  # type: ignore[attr-defined]
    chooser.begin(singles, filled)
    episodes = [_Episode(env.unwrapped.task, chooser.reference(index)) for index, env in enumerate(singles)]
    while any(episode.record is None for episode in episodes):
        observations, _, terminated, truncated, infos = envs.step(chooser.choose(observations))
        for index, episode in enumerate(episodes):
            # An environment that ended earlier has begun another episode, which is not recorded.
            if episode.record is None:
                info = {name: values[index] for name, values in infos.items() if not name.startswith("_")}
                episode.note(info, bool(terminated[index] or truncated[index]))
        progress()
    return [episode.record for episode in episodes[: len(seeds)] if episode.record is not None]
