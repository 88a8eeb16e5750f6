"""Episodes of given seeds, played in vectorised environments and recorded, and the numbers of each.

An agent draws from `agent_generator(seed)`, separate from all environments. Only an agent of a class that declares
`sees_truth = True` gets the task with the truth, by its method `see`.
"""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from surgsim_apps.scoring.figures import MapScore, PalpationRecord, press_errors
from surgsim_apps.training.site_agent import site_facts
from surgsim_env.scripting import ScriptError, oracle_script, run_script, selected_observations
from surgsim_env.tasks import SUCCESS_ERROR, PalpateSitesTask

# Spawn key of the agents' random numbers in the `SeedSequence` of an episode.
AGENT_STREAM = 0x41_67_65_6E_74
# Actions (n, n_action) for observations (n, n_observation), or for a dictionary of arrays (n, ...), and a mask (n,) of
# environments that begin an episode.
Actor = Callable[[Any, NDArray[np.bool_]], NDArray[Any]]


@runtime_checkable
class EpisodeActor(Protocol):
    """An `Actor` with random numbers or a memory of its own for each episode."""

    def begin(self, index: int, env: Any, rng: np.random.Generator) -> None:
        """Begin an episode in environment `index`, with random numbers from its seed."""
        ...

    def end(self, index: int) -> None:
        """End the episode of environment `index`, if there is one."""
        ...

    def __call__(self, observations: Any, begins: NDArray[np.bool_]) -> NDArray[Any]:
        """Actions of an `Actor`."""
        ...


def make_envs(
    env_id: str, count: int, *, dtype: str = "float32", threads: int = 1, **kwargs: Any
) -> gym.vector.VectorEnv:
    """Vectorised environments for `play`, without automatic resets, which measure the tissue's load."""
    lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled", "dtype": dtype}
    kwargs["measure_tissue"] = True
    return gym.make_vec(env_id, num_envs=count, threads=threads, **lanes, **kwargs)


def equal_members(stream: Iterator[int], count: int, size: int) -> tuple[int, ...]:
    """The first `count` seeds of a stream with a family's members in numbers that differ by at most 1.

    Args:
        stream: of seeds, without end.
        count: of episodes.
        size: members of the family; an environment draws one by the first number of `default_rng(seed)`.
    """
    whole, extra = divmod(count, size)
    counts, seeds = [0] * size, []
    while len(seeds) < count:
        seed = next(stream)
        member = int(np.random.default_rng(seed).integers(size))
        if counts[member] < whole + (extra > 0):
            extra -= counts[member] == whole
            counts[member] += 1
            seeds.append(seed)
    return tuple(seeds)


def agent_generator(seed: int) -> np.random.Generator:
    """Random numbers of the agent in the episode of a seed.

    An environment draws its episode from `default_rng(seed)`: an agent with that generator could redraw the lesions.
    This one begins with words of a child of the seed's `SeedSequence`: it reveals neither the seed nor the
    environment's numbers.
    """
    child = np.random.SeedSequence(seed, spawn_key=(AGENT_STREAM,))
    return np.random.default_rng(child.generate_state(8).tolist())


def play(
    actor: Actor | EpisodeActor,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    begin: Callable[[int, int], Any],
    progress: Callable[[int], object] = lambda ended: None,
) -> list[Any]:
    """Records of an episode of each seed; an environment that ends one begins that of the next seed.

    Environments without a further seed are paused (`LaneVectorEnv.pause`).

    Args:
        actor: gives the actions. An `EpisodeActor` may draw from each episode's own random numbers: its records do not
            depend on the other episodes.
        envs: of `make_envs`.
        seeds: of the episodes.
        begin: makes the record of an episode from the index of its environment and its seed; its `note` takes steps.
        progress: called after each step with the number of episodes that ended.
    """
    lanes = envs.unwrapped
    waiting, records = list(range(len(seeds))), dict[int, Any]()
    playing: list[int | None] = [None] * envs.num_envs
    observations, begins = np.zeros(0), np.ones(envs.num_envs, dtype=np.bool_)
    while True:
        for env in np.flatnonzero(begins):
            playing[env] = waiting.pop(0) if waiting else None
        idle = np.array([index is None for index in playing])
        if idle.all():
            return [records[index] for index in range(len(seeds))]
        # All environments are reset once, also those without a seed (by the first): an observation is of all.
        resets = begins & ~idle if records else np.ones_like(begins)
        if resets.any():
            starts = [int(seeds[index or 0]) for index in playing]
            observations, _ = envs.reset(seed=starts, options={"reset_mask": resets})  # type: ignore[arg-type]
        for env in np.flatnonzero(begins):
            index = playing[env]
            if isinstance(actor, EpisodeActor):
                actor.end(int(env))
            if index is not None:
                if isinstance(actor, EpisodeActor):
                    actor.begin(int(env), lanes.envs[env], agent_generator(int(seeds[index])))  # type: ignore[attr-defined]
                records[index] = begin(int(env), int(seeds[index]))
        if begins.any() and idle.any():
            lanes.pause(idle)  # type: ignore[attr-defined]
        observations, rewards, terminated, truncated, infos = envs.step(actor(observations, begins))
        begins = (terminated | truncated) & ~idle
        for env, index in enumerate(playing):
            if index is not None:
                info = {name: values[env] for name, values in infos.items() if not name.startswith("_")}
                records[index].note(float(rewards[env]), info, bool(begins[env]))
        progress(int(begins.sum()))


# ---- agents, one for each episode ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EpisodeFacts:
    """Constants of an environment with control steps.

    Fields:
        env_id, env_kwargs: of the environment; an agent may make its own from them
        observation_slices: entries of an observation, by channel
        action_size: entries of an action, each in [-1, 1]
        control_step: duration of a step [s]
        step_count: most steps of an episode
        soft_force, hard_force: limits of the contact force [N]
    """

    env_id: str
    env_kwargs: dict[str, Any]
    observation_slices: dict[str, slice]
    action_size: int
    control_step: float
    step_count: int
    soft_force: float
    hard_force: float


def episode_facts(env: Any, env_id: str, env_kwargs: dict[str, Any]) -> EpisodeFacts:
    """Facts of an environment, without its wrappers."""
    single = env.unwrapped
    return EpisodeFacts(
        env_id=env_id,
        env_kwargs=copy.deepcopy(env_kwargs),
        observation_slices=single.observation_slices,
        action_size=single.action_space.shape[0],
        control_step=single.scene.timing.control_step,
        step_count=single.task.episode_steps or 0,
        soft_force=single.scene.limits.soft_force,
        hard_force=single.scene.limits.hard_force,
    )


def sees_truth(agent: object) -> bool:
    """True if an agent's class declares a view of the truth."""
    return bool(getattr(type(agent), "sees_truth", False))


def check_agent(agent: object, name: str) -> None:
    """Check an agent for the methods of an episode; messages call it `name`.

    Raises:
        ValueError: a missing method, or a method `see` without `sees_truth = True`.
    """
    has = {
        method: callable(getattr(type(agent), method, None))
        for method in ("reset", "act", "see", "estimate", "estimate_map")
    }
    needed = ("reset", "act", *["see"] * sees_truth(agent), *["estimate_map"] * has["estimate"])
    for method in needed:
        if not has[method]:
            raise ValueError(f"{name} has no method {method}: docs/own_agent.md says what an agent has")
    if has["see"] and not sees_truth(agent):
        raise ValueError(
            f"{name} has a method see, which takes the task with the truth, and its class does not declare "
            "sees_truth = True: declare it, or call the method otherwise"
        )


class AgentActor:
    """An agent for each episode, with its own random numbers."""

    def __init__(self, make: Callable[[], Any], facts: Callable[[Any], Any] = site_facts) -> None:
        """Play agents of a constructor.

        Args:
            make: makes an agent (docs/own_agent.md).
            facts: constants of an environment for its agent, by default `SiteFacts`.
        """
        self.make, self.facts = make, facts
        self.agents: dict[int, Any] = {}
        self._idle = np.zeros(0, dtype=np.float32)

    def begin(self, index: int, env: Any, rng: np.random.Generator) -> None:
        """Make the agent of environment `index` for an episode."""
        agent = self.agents[index] = self.make()
        self._idle = np.zeros(env.action_space.shape, dtype=np.float32)
        agent.reset(rng, self.facts(env))
        if sees_truth(agent):
            agent.see(env.unwrapped.task)

    def end(self, index: int) -> None:
        """Forget the agent of environment `index`, if there is one."""
        self.agents.pop(index, None)

    def __call__(self, observations: Any, begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """The next action of each agent (n, n_action); 0 for an environment without one."""
        actions = [
            self.agents[index].act(selected_observations(observations, index)) if index in self.agents else self._idle
            for index in range(len(begins))
        ]
        return np.stack(actions)


# ---- SurgSim/Palpate-v0 and Retract-v0 ------------------------------------------------------------------------------


@dataclass
class TaskRecord:
    """One episode: length in steps, return, largest force [N] and tissue load (Pa, strain) of each step, last info."""

    steps: int = 0
    total: float = 0.0
    force_peaks: list[float] = field(default_factory=list)
    loads: list[tuple[float, float]] = field(default_factory=list)
    last: dict[str, Any] = field(default_factory=dict)

    def note(self, reward: float, info: dict[str, Any], over: bool) -> None:
        """Add a step."""
        self.steps, self.total = self.steps + 1, self.total + reward
        self.force_peaks.append(float(info["force_peak"]))
        self.loads.append(tissue_load_of(info))
        if over:
            self.last = info


def tissue_load_of(info: dict[str, Any]) -> tuple[float, float]:
    """Largest pressure [Pa] and strain of the tissue in the info of a step, of an environment that measures them."""
    return float(info["tissue_pressure"]), float(info["tissue_strain"])


def play_tasks(
    actor: Actor | EpisodeActor,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    progress: Callable[[int], object] = lambda ended: None,
) -> list[TaskRecord]:
    """`play` with a `TaskRecord` for each episode."""
    return play(actor, envs, seeds, lambda env, seed: TaskRecord(), progress)


def play_scripts(
    env: gym.Env, seeds: Sequence[int], *, tracks: bool, progress: Callable[[int], object] = lambda ended: None
) -> list[TaskRecord]:
    """Episodes of the oracle's script, one after the other; a failed script ends its episode without success.

    Args:
        env: one environment, which measures the tissue's load.
        seeds: of the episodes.
        tracks: True to follow a moving surface.
        progress: called with 1 after each episode.
    """
    records = []
    for seed in seeds:
        env.reset(seed=seed)
        try:
            trace = run_script(env, oracle_script(env, tracks=tracks))
        except ScriptError as failed:
            trace = failed.trace
        peaks, loads = [float(info["force_peak"]) for info in trace.infos], [*map(tissue_load_of, trace.infos)]
        records.append(TaskRecord(len(trace.reward), float(trace.reward.sum()), peaks, loads, trace.infos[-1]))
        progress(1)
    return records


def task_columns(
    records: Sequence[TaskRecord], control_step: float, soft_force: float
) -> dict[str, NDArray[np.float64]]:
    """One number per episode (n,) of each figure of a policy, NaN if undefined.

    Args:
        records: at least one.
        control_step: duration of a step [s].
        soft_force: [N]; limit of the force in a gentle episode.
    """
    succeeded = [bool(record.last["success"]) for record in records]
    loads = np.array([np.max(record.loads, axis=0) for record in records])
    columns = {
        "success": succeeded,
        # Of successful episodes; the others take the time limit.
        "seconds": [
            record.steps * control_step if won else math.nan for record, won in zip(records, succeeded, strict=True)
        ],
        "return": [record.total for record in records],
        "force_peak": [max(record.force_peaks) for record in records],
        "pressure_peak": loads[:, 0],
        "strain_peak": loads[:, 1],
        "under_soft_force": [max(record.force_peaks) <= soft_force for record in records],
        "hard_limit_share": [bool(record.last["hard_limit"]) for record in records],
        "fault_share": [bool(record.last["sim_fault"]) for record in records],
    }
    for name in (
        "map_score",
        "torn",
        "visible",
        "grip_force_peak",
        "pull_force_peak",
        "pull_force_mean",
        "slips",
        "path_length",
    ):
        if name in records[0].last:
            columns[name] = [float(record.last[name]) for record in records]
    if "error_mm" in records[0].last:
        errors = [float(record.last["error_mm"]) for record in records]
        columns["error_mm"] = [error if error >= 0.0 else math.nan for error in errors]
    return {name: np.array(values, dtype=np.float64) for name, values in columns.items()}


# ---- SurgSim/PalpateSites-v0 ----------------------------------------------------------------------------------------


def play_sites(
    actor: Actor | EpisodeActor,
    envs: gym.vector.VectorEnv,
    seeds: Sequence[int],
    progress: Callable[[int], object] = lambda ended: None,
) -> list[PalpationRecord]:
    """`play` with a `PalpationRecord` for each episode.

    An agent's methods `estimate` and `estimate_map` (`surgsim_apps.scoring.site_search.TruthAgent`) replace the
    estimator.
    """
    singles = envs.unwrapped.envs  # type: ignore[attr-defined]

    def begin(index: int, seed: int) -> SiteRecord:
        agent = actor.agents[index] if isinstance(actor, AgentActor) else None
        return SiteRecord(singles[index].unwrapped.task, agent if estimates_itself(agent) else None)

    return [site_record.record for site_record in play(actor, envs, seeds, begin, progress)]


def estimates_itself(agent: object) -> bool:
    """True if an agent's class has a method `estimate`: scored instead of the common estimator."""
    return callable(getattr(type(agent), "estimate", None))


def site_success(record: PalpationRecord, task: PalpateSitesTask) -> bool:
    """True for an episode without harm and with a small last error of the scored estimate."""
    harmed = record.hard_limit or bool(record.fault)
    return not harmed and bool(press_errors(record, task.budget)[-1] <= SUCCESS_ERROR * task.tip_scale)


class SiteRecord:
    """Record of an episode's presses; the estimates of an agent `reference` replace the estimator's."""

    def __init__(self, task: PalpateSitesTask, reference: Any) -> None:
        self.task, self.reference = task, reference
        self.estimates: list[NDArray[np.float64]] = []
        self.presses: list[tuple[float, ...]] = []

    def note(self, reward: float, info: dict[str, Any], over: bool) -> None:
        """Add a press; the last one completes the record."""
        self.estimates.append(np.array(self.task.estimated if self.reference is None else self._own_places()))
        self.presses.append((float(info["force"]), float(info["force_peak"]), *tissue_load_of(info)))
        if over:
            self._complete(info)

    def _complete(self, info: dict[str, Any]) -> None:
        score = map_score(self.task)
        force, peak, pressure, strain = np.array(self.presses).T
        self.record = PalpationRecord(
            truth=self.task.truth.copy(),
            estimates=self.estimates,
            cutoff=self.task.cutoff,
            force=force,
            force_peak=peak,
            pressure=pressure,
            strain=strain,
            seconds=float(info["seconds"]),
            hard_limit=bool(info["hard_limit"]),
            fault=str(info["sim_fault"]),
            map=score if self.reference is None else self._own_map(score),
            member=str(info.get("member", "")),
        )

    def _own_places(self) -> NDArray[np.float64]:
        return np.asarray(self.reference.estimate(self.task.charted.surface), dtype=np.float64).reshape(-1, 3)

    def _own_map(self, score: MapScore) -> MapScore:
        """The agent's own map beside the truth, hidden from an agent without `sees_truth`."""
        hidden = {"lesion": np.zeros_like(score.lesion), "outline_true": np.zeros_like(score.outline_true)}
        own = self.reference.estimate_map(score if sees_truth(self.reference) else replace(score, **hidden))
        return replace(score, excess=own.excess, outline=own.outline)


def map_score(task: PalpateSitesTask) -> MapScore:
    """The task's last estimate as a map, beside the lesions along the approach."""
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
    """Mask of places of the chart (..., 2) [m] over a lesion, along the approach."""
    over = np.zeros(points.shape[:-1], dtype=bool)
    chart = task.charted.chart
    for lesion in task.lesions:
        centre = 0.5 * (chart.place(lesion.centre) + 1.0) * chart.extent  # type: ignore[arg-type]
        over |= np.square(points - centre).sum(axis=-1) <= lesion.radius * lesion.radius  # type: ignore[operator]
    return over
