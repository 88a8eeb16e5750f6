"""Play episodes of given seeds side by side, record them, and the figures of a policy."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from agents.scoring.site_agent import SiteAgent, site_facts
from agents.site_search import OracleSites
from surgsim_env.palpation.press import HOLD_TIME, PRESS_SPEED
from surgsim_env.palpation.scores import MapScore, PalpationRecord, ScoreEstimate, with_intervals
from surgsim_env.scripting import ScriptError, oracle_script, run_script
from surgsim_env.tasks.palpate_sites import PalpateSitesTask

# Actions (n, n_action) for observations (n, n_observation); where the second (n,) is true an episode begins.
Actor = Callable[[NDArray[Any], NDArray[np.bool_]], NDArray[Any]]


class EpisodeRecord(Protocol):
    """What is kept of an episode."""

    def note(self, reward: float, info: dict[str, Any], over: bool) -> None:
        """Add a step; `over` is true for the last one."""
        ...


R = TypeVar("R", bound=EpisodeRecord)


def make_envs(
    env_id: str, count: int, *, dtype: str = "float32", threads: int = 1, **kwargs: Any
) -> gym.vector.VectorEnv:
    """Environments side by side that reset when `play` says so."""
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled", "dtype": dtype}
    return gym.make_vec(env_id, num_envs=count, threads=threads, **lanes, **kwargs)


def play(
    actor: Actor,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    begin: Callable[[int, int], R],
    progress: Callable[[], object] = lambda: None,
) -> list[R]:
    """Play an episode of each seed and return its record; where one ends the next seed begins.

    Args:
        actor: what plays.
        envs: with autoreset_mode="Disabled", so that each reset has its seed.
        seeds: of the episodes.
        begin: makes the record of an episode from the index of its environment and its seed.
        progress: called after each step.

    Raises:
        ValueError: another autoreset mode.
    """
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not AutoresetMode.DISABLED:
        raise ValueError(f'autoreset_mode is {mode.value!r}; episodes of given seeds need "Disabled"')
    waiting, records = list(range(len(seeds))), dict[int, R]()
    playing: list[int | None] = [None] * envs.num_envs
    observations, begins = np.zeros(0), np.ones(envs.num_envs, dtype=np.bool_)
    while True:
        for env in np.flatnonzero(begins):
            playing[env] = waiting.pop(0) if waiting else None
        if all(index is None for index in playing):
            return [records[index] for index in range(len(seeds))]
        if begins.any():
            # A surplus environment plays the first seed again, unrecorded.
            starts = [int(seeds[index or 0]) for index in playing]
            observations, _ = envs.reset(seed=starts, options={"reset_mask": begins.copy()})  # type: ignore[arg-type]
            made = {playing[env]: begin(int(env), starts[env]) for env in np.flatnonzero(begins)}
            records |= {index: record for index, record in made.items() if index is not None}
        observations, rewards, terminated, truncated, infos = envs.step(actor(observations, begins))
        begins = terminated | truncated
        for env, index in enumerate(playing):
            if index is not None:
                info = {name: values[env] for name, values in infos.items() if not name.startswith("_")}
                records[index].note(float(rewards[env]), info, bool(begins[env]))
        progress()


# ---- SurgSim/Palpate-v0 and Retract-v0 ------------------------------------------------------------------------------


@dataclass
class TaskRecord:
    """One episode: length in steps, return, largest force of each step [N] and last info."""

    steps: int = 0
    total: float = 0.0
    force_peaks: list[float] = field(default_factory=list)
    last: dict[str, Any] = field(default_factory=dict)

    def note(self, reward: float, info: dict[str, Any], over: bool) -> None:
        """Add a step."""
        self.steps, self.total = self.steps + 1, self.total + reward
        self.force_peaks.append(float(info["force_peak"]))
        if over:
            self.last = info


def play_tasks(
    actor: Actor, envs: gym.vector.VectorEnv, seeds: Sequence[int], progress: Callable[[], object] = lambda: None
) -> list[TaskRecord]:
    """`play` for the records of these environments."""
    return play(actor, envs, seeds, lambda env, seed: TaskRecord(), progress)


def play_scripts(
    env: gym.Env, seeds: Sequence[int], *, tracks: bool, progress: Callable[[], object] = lambda: None
) -> list[TaskRecord]:
    """Episodes of the oracle's script, one after the other; a script that fails ends its episode without success.

    Args:
        env: one environment.
        seeds: of the episodes.
        tracks: the script follows a surface that moves.
        progress: called after each episode.
    """
    records = []
    for seed in seeds:
        env.reset(seed=seed)
        try:
            trace = run_script(env, oracle_script(env, tracks=tracks))
        except ScriptError as failed:
            trace = failed.trace
        peaks = [float(info["force_peak"]) for info in trace.infos]
        records.append(TaskRecord(len(trace.reward), float(trace.reward.sum()), peaks, trace.infos[-1]))
        progress()
    return records


def task_figures(
    records: Sequence[TaskRecord], control_step: float, soft_force: float, rng: np.random.Generator
) -> dict[str, ScoreEstimate]:
    """The figures of a policy, with bootstrap intervals over episodes.

    Args:
        records: at least one.
        control_step: duration of a step [s].
        soft_force: [N]; an episode counts as gentle where no step's largest force passes it.
        rng: for the bootstrap.
    """
    succeeded = [bool(record.last["success"]) for record in records]
    columns = {
        "success": succeeded,
        # Of successful episodes; the others take the time limit.
        "seconds": [
            record.steps * control_step if won else math.nan for record, won in zip(records, succeeded, strict=True)
        ],
        "return": [record.total for record in records],
        "force_peak": [max(record.force_peaks) for record in records],
        "under_soft_force": [max(record.force_peaks) <= soft_force for record in records],
        "hard_limit_share": [bool(record.last["hard_limit"]) for record in records],
        "fault_share": [bool(record.last["sim_fault"]) for record in records],
    }
    for name in ("torn", "visible", "grip_force_peak", "pull_force_peak", "pull_force_mean", "slips", "path_length"):
        if name in records[0].last:
            columns[name] = [float(record.last[name]) for record in records]
    if "error_mm" in records[0].last:
        errors = [float(record.last["error_mm"]) for record in records]
        columns["error_mm"] = [error if error >= 0.0 else math.nan for error in errors]
    return with_intervals({name: np.array(values, dtype=np.float64) for name, values in columns.items()}, rng)


def print_episodes(records: Sequence[TaskRecord], seeds: Sequence[int], soft_force: float, *names: str) -> None:
    """Print a line per episode with some entries of its last info, and a line of figures."""
    for seed, one in zip(seeds, records, strict=True):
        shown = " ".join(f"{name}={one.last[name]}" for name in names)
        print(f"seed={seed} steps={one.steps} return={one.total:.2f} peak={max(one.force_peaks):.2f} N {shown}")
    won = np.mean([bool(one.last["success"]) for one in records])
    gentle = np.mean([max(one.force_peaks) <= soft_force for one in records])
    steps = np.median([one.steps for one in records])
    print(
        f"{len(records)} episodes: success {won:.0%}, median {steps:.0f} control steps, "
        f"under the soft limit {gentle:.0%}"
    )


# ---- SurgSim/PalpateSites-v0 ----------------------------------------------------------------------------------------


class SiteActor:
    """A baseline in each environment, its random generator seeded with the episode's seed."""

    def __init__(self, make: Callable[[], SiteAgent]) -> None:
        self.make = make
        self.agents: dict[int, SiteAgent] = {}

    def begin(self, index: int, env: Any, seed: int) -> SiteAgent:
        """Make the agent of an episode in environment `index`."""
        agent = self.agents[index] = self.make()
        agent.reset(np.random.default_rng(seed), site_facts(env))
        if isinstance(agent, OracleSites):
            agent.see(env.unwrapped.task)
        return agent

    def __call__(self, observations: NDArray[Any], begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The next site of each agent, as actions (n, 2)."""
        return np.stack([self.agents[index].act(one) for index, one in enumerate(observations)])


def play_sites(
    actor: Actor | SiteActor,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    progress: Callable[[], object] = lambda: None,
) -> list[PalpationRecord]:
    """`play` for baselines, or for one policy in all environments.

    An agent with a method `estimate`, as `agents.site_search.TruthAgent` has it, replaces the estimator.
    """
    singles = envs.unwrapped.envs  # type: ignore[attr-defined]

    def begin(index: int, seed: int) -> SiteRecord:
        agent = actor.begin(index, singles[index], seed) if isinstance(actor, SiteActor) else None
        return SiteRecord(singles[index].unwrapped.task, agent if hasattr(agent, "estimate") else None)

    return [one.record for one in play(actor, envs, seeds, begin, progress)]


class SiteRecord:
    """A record of presses; `reference` replaces the estimator."""

    def __init__(self, task: PalpateSitesTask, reference: Any) -> None:
        self.task, self.reference = task, reference
        self.estimates: list[NDArray[np.float64]] = []
        self.forces: list[tuple[float, float, float]] = []

    def note(self, reward: float, info: dict[str, Any], over: bool) -> None:
        """Add a press; the last one completes the record."""
        self.estimates.append(
            np.array(self.task.estimated if self.reference is None else self.reference.estimate(self.task))
        )
        self.forces.append((float(info["force"]), float(info["force_peak"]), float(info["depth"])))
        if over:
            self._complete(info)

    def _complete(self, info: dict[str, Any]) -> None:
        made = map_score(self.task)
        force, peak, depth = np.array(self.forces).T
        self.record = PalpationRecord(
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
