"""Long runs of environments with random, corner and adversarial actions, and checks in every step.

    python benchmarks/soak.py --minutes 60
    python benchmarks/soak.py --minutes 1 --quick    small organs, alone and in float64: kernels of the tests
    python benchmarks/soak.py --replay 0:17          repeats run 17 of seed 0, to the bit (--quick if it was)

A run makes an environment of one of CASES, alone or several side by side, plays some seconds of it and goes on to the
next; runs are drawn from a seed and their number. Checked in every control step: observations lie in their space,
rewards are finite, each end has a name (a fault of FAULTS, a limit, a success, the time), and no tet is turned inside
out without that fault, by volumes from the nodes' positions. At the end of a run a reset with the first seed must give
the first saved state to the bit. Memory is that held by a process between runs, without malloc's reserve of freed
memory (`memory_held`).

Prints a table and exits 1 with findings; other seeds in other processes use other cores.
"""

import argparse
import contextlib
import ctypes
import gc
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.bench.report import describe, load
from surgsim_env.scene import LEVELS

# Arguments of each id.
CASES: dict[str, dict[str, tuple[Any, ...]]] = {
    "SurgSim/Palpate-v0": {
        "scene": ("phantom_small", "phantom", "phantom_wide", "liver"),
        "level": tuple(LEVELS),
        "instrument": (None, "psm_palpator"),
    },
    "SurgSim/PalpateSites-v0": {"scene": ("phantom_small", "phantom", "liver"), "level": tuple(LEVELS)},
    "SurgSim/Retract-v0": {"instrument": (None, "psm_retractor")},
    "SurgSim/BimanualRetract-v0": {},
}
# Environments side by side and their precision; an id without lanes is played alone.
WIDTHS: tuple[tuple[int, str], ...] = (
    *((1, "alone"), (8, "float64"), (5, "float64")),
    *((8, "float32"), (16, "float32")),
)
# Of a quick soak: the scene of palpation, and the number of WIDTHS.
QUICK_SCENE, QUICK_WIDTHS = "phantom_small", 3
# Control steps of a run; presses of PalpateSites, each as long as many control steps.
STEPS, PRESSES = 80, 4
# Names of faults, and their words in `sim_fault`.
FAULTS = {
    "tet inverted": "turned inside out",
    "contact lost": "contact lost",
    "not finite": "no longer finite",
    "wrench not finite": "wrench is not finite",
    "force cap": "beyond the physical cap",
    "MuJoCo warning": "MuJoCo warning",
    "out of bounds": "left its bounds",
}
# Entries of `info` for ends without a fault.
ENDS = ("success", "hard_limit", "torn", "collided", "declared")
# Runs until the kinds of environments of a seed repeat: by then everything cached by scene or kernel is there.
KINDS = 30
# Largest growth of a process' memory from then on [bytes].
GROWTH_MOST = 20e6


# ---- actions ---------------------------------------------------------------------------------------------------------

Action = NDArray[np.float32]


def random_actions(rng: np.random.Generator, size: int) -> Generator[Action, float, None]:
    """Each entry anew in every step; sent values are ignored."""
    while True:
        yield rng.uniform(-1.0, 1.0, size).astype(np.float32)


def corner_actions(rng: np.random.Generator, size: int) -> Generator[Action, float, None]:
    """Entries at -1, 0 or 1, held for up to 20 steps."""
    while True:
        corner = rng.integers(-1, 2, size).astype(np.float32)
        for _ in range(int(rng.integers(1, 21))):
            yield corner


def adversarial_actions(rng: np.random.Generator, size: int) -> Generator[Action, float, None]:
    """Corners in search of force: after a step without a rise of the force an entry changes its sign.

    It is sent the largest contact force of each step [N].
    """
    corner, before = rng.choice((-1.0, 1.0), size).astype(np.float32), 0.0
    while True:
        force = yield corner.copy()
        if force <= before:
            corner[rng.integers(size)] *= -1.0
        before = force


ACTORS: dict[str, Callable[[np.random.Generator, int], Generator[Action, float, None]]] = {
    "random": random_actions,
    "corner": corner_actions,
    "adversarial": adversarial_actions,
}


# ---- a run -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One run: an environment, and the kind of its actions."""

    seed: int
    number: int
    env_id: str
    settings: dict[str, Any]
    width: int
    dtype: str
    actor: str

    @classmethod
    def drawn(cls, seed: int, number: int, *, quick: bool = False) -> "Run":
        """Run `number` of a seed: the environments of run `number` - KINDS with other actions."""
        rng = np.random.default_rng((seed, number % KINDS))
        env_id = str(rng.choice(list(CASES)))
        settings = {name: values[rng.integers(len(values))] for name, values in CASES[env_id].items()}
        if quick and "scene" in settings:
            settings["scene"] = QUICK_SCENE
        width, dtype = WIDTHS[rng.integers(QUICK_WIDTHS if quick else len(WIDTHS))]
        if gym.spec(env_id).vector_entry_point is None:
            width, dtype = WIDTHS[0]
        actor = np.random.default_rng((seed, number)).choice(list(ACTORS))
        return cls(seed, number, env_id, settings, width, dtype, str(actor))

    @property
    def name(self) -> str:
        """The run's name for --replay."""
        return f"{self.seed}:{self.number}"

    def __str__(self) -> str:
        chosen = ", ".join(f"{name}={value}" for name, value in self.settings.items() if value is not None)
        return f"run {self.name}, {self.env_id}({chosen}), {self.width} x {self.dtype}, {self.actor} actions"

    def make(self) -> gym.vector.VectorEnv:
        """The environments, without automatic resets."""
        if self.dtype == "alone":
            mode = gym.vector.AutoresetMode.DISABLED
            return gym.make_vec(self.env_id, 1, "sync", vector_kwargs={"autoreset_mode": mode}, **self.settings)
        lanes = {"vectorization_mode": "vector_entry_point", "autoreset_mode": "Disabled", "threads": 1}
        return gym.make_vec(self.env_id, num_envs=self.width, dtype=self.dtype, **lanes, **self.settings)


@dataclass
class Outcome:
    """Counts of a run; `findings`, a sentence each."""

    substeps: int = 0
    steps: int = 0
    episodes: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def play(run: Run) -> Outcome:
    """Make a run's environments, play them, and check them."""
    outcome = Outcome()
    with contextlib.closing(run.make()) as envs:
        Watch(run, envs, outcome).play()
    return outcome


class Watch:
    """Plays environments and checks each step."""

    def __init__(self, run: Run, envs: Any, outcome: Outcome) -> None:
        self.run, self.envs, self.outcome = run, envs, outcome
        self.singles = [env.unwrapped for env in envs.envs]
        self.sites = run.env_id == "SurgSim/PalpateSites-v0"
        self.elapsed = np.zeros(len(self.singles))

    def play(self) -> None:
        """All steps of the run; an episode is followed by one of another seed."""
        rng = np.random.default_rng((self.run.seed, self.run.number, 1))
        first = self.seeds(rng)
        begun = self.reset(first)
        size = self.singles[0].action_space.shape[0]
        actors = [ACTORS[self.run.actor](rng, size) for _ in self.singles]
        actions = np.array([next(actor) for actor in actors])
        for _ in range(PRESSES if self.sites else STEPS):
            observations, rewards, terminated, truncated, infos = self.envs.step(actions)
            self.outcome.steps += len(self.singles)
            self.check(observations, rewards)
            over = terminated | truncated
            for index, env in enumerate(self.singles):
                self.count(index, env)
                info = {name: values[index] for name, values in infos.items() if not name.startswith("_")}
                end = self.end_of(env, info, bool(truncated[index])) if over[index] else ""
                self.check_tets(index, env, end)
            forces = infos["force_peak"]
            actions = np.array([actor.send(float(force)) for actor, force in zip(actors, forces, strict=True)])
            if over.any():
                self.elapsed[over] = 0.0
                self.envs.reset(seed=self.seeds(rng), options={"reset_mask": over.copy()})
        if self.reset(first) != begun:
            self.find("a reset with the first seed does not give the first state")

    def seeds(self, rng: np.random.Generator) -> list[int]:
        """A seed for each environment."""
        return rng.integers(2**31, size=len(self.singles)).tolist()

    def reset(self, seeds: list[int]) -> list[bytes]:
        """Reset all; returns their saved states."""
        self.envs.reset(seed=seeds)
        return [env.save_state() for env in self.singles]

    def find(self, text: str) -> None:
        self.outcome.findings.append(f"{self.run}: {text}")

    def check(self, observations: NDArray[Any], rewards: NDArray[Any]) -> None:
        """Observations lie in their space, rewards are finite."""
        space = self.singles[0].observation_space
        for index, observation in enumerate(observations):
            if not space.contains(observation):
                bad = np.flatnonzero(~((observation >= space.low) & (observation <= space.high)))
                self.find(f"observation[{bad[:1]}] of environment {index} is {observation[bad[:1]]}")
        if not np.isfinite(rewards).all():
            self.find(f"rewards {rewards} are not finite")

    def count(self, index: int, env: Any) -> None:
        """Add the substeps since the last look."""
        simulation, timing = env.simulation, env.scene.timing
        elapsed = env.task.felt.seconds if self.sites else simulation.time
        new, self.elapsed[index] = elapsed - self.elapsed[index], elapsed
        self.outcome.substeps += round(new / timing.haptic_step) * timing.substep_count

    def end_of(self, env: Any, info: dict[str, Any], truncated: bool) -> str:
        """The name of an episode's end, counted."""
        self.outcome.episodes += 1
        fault = info["sim_fault"]
        if fault:
            end = next((name for name, words in FAULTS.items() if words in fault), "")
        elif truncated:
            end = "time"
        elif self.sites and not info["success"] and env.task.step_count == env.task.budget:
            end = "budget"
        else:
            end = next((name for name in ENDS if info.get(name)), "")
        if not end:
            self.find(f"an end without a name: {fault or info}")
        self.outcome.ends[end or "unnamed"] += 1
        return end

    def check_tets(self, index: int, env: Any, end: str) -> None:
        """No tet is inside out or not finite, unless the fault says so."""
        ratios = volume_ratios(env.simulation)
        if not ratios.min() > 0.0 and end not in ("tet inverted", "not finite"):
            self.find(
                f"tet {int(ratios.argmin())} of environment {index} has volume ratio {ratios.min():.3g}, no fault"
            )


def volume_ratios(simulation: Any) -> NDArray[np.float64]:
    """Volume of each tet over its volume at rest, (n_tet,), from the definition."""
    tets = simulation.anatomy.mesh.tets

    def volumes(points: NDArray[np.float64]) -> NDArray[np.float64]:
        edges = points[tets[:, 1:]] - points[tets[:, :1]]
        return np.linalg.det(edges)

    return volumes(simulation.organ_state.node_position) / volumes(simulation.organ_model.node_rest_position)


def memory_resident() -> float:
    """Resident memory of this process [bytes]; 0 if unknown to the system."""
    status = Path("/proc/self/statm")
    return float(int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")) if status.exists() else 0.0


def memory_held() -> float:
    """Memory held by this process [bytes]: resident after glibc's malloc has returned free pages to the system.

    malloc keeps freed memory for later calls: 30 to 150 MB after a run, another amount after each kind of environments,
    so that resident memory drifts by tens of MB while nothing is held for longer. Without glibc it is resident memory;
    0 if unknown to the system.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(ctypes.c_size_t(0))
    return memory_resident()


def growth(memory: list[float]) -> float | None:
    """Median gain of the memory held after each run [bytes] from the first to the last run of a kind; None for few.

    Runs of one kind are compared because kinds hold different amounts; the first of each fills the caches.
    """
    gained = [held[-1] - held[0] for kind in range(KINDS) if len(held := memory[KINDS + kind :: KINDS]) > 1]
    return float(np.median(gained)) if len(gained) >= 5 else None


# ---- the soak --------------------------------------------------------------------------------------------------------


def play_all(seed: int, minutes: float, quick: bool, console: Console) -> int:
    """Play runs for some minutes and print the table; returns the exit status."""
    before, begin = load(), time.time()
    totals: dict[str, Outcome] = {}
    memory: list[float] = []
    while time.time() < begin + 60.0 * minutes:
        run = Run.drawn(seed, len(memory), quick=quick)
        try:
            outcome = play(run)
        except Exception:  # any is a finding, and the next run goes on
            outcome = Outcome(findings=[f"{run}: {traceback.format_exc()}"])
        memory.append(memory_held())
        add(totals.setdefault(run.env_id, Outcome()), outcome)
        for text in outcome.findings:
            console.print(f"finding: {text}", markup=False, highlight=False, soft_wrap=True)
    gained, count = growth(memory), sum(len(total.findings) for total in totals.values())
    show(totals, console)
    for line in (
        f"{len(memory)} runs of seed {seed} in {(time.time() - begin) / 60.0:.1f} min, {count} findings",
        "memory: too few runs"
        if gained is None
        else f"memory: {gained / 1e6:+.1f} MB between runs of a kind; the rule is at most {GROWTH_MOST / 1e6:.0f} MB",
        describe(before),
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return int(bool(count) or (gained is not None and gained > GROWTH_MOST))


def add(total: Outcome, outcome: Outcome) -> None:
    """Add a run's outcome to that of its id."""
    total.substeps += outcome.substeps
    total.steps += outcome.steps
    total.episodes += outcome.episodes
    total.ends += outcome.ends
    total.findings += outcome.findings


def show(totals: dict[str, Outcome], console: Console) -> None:
    """The table: a row an id."""
    table = Table("id", "substeps", "control steps", "episodes", "ends", "findings")
    for env_id, total in sorted(totals.items()):
        ends = ", ".join(f"{count} {name}" for name, count in total.ends.most_common())
        counts = (f"{number:,}".replace(",", " ") for number in (total.substeps, total.steps, total.episodes))
        table.add_row(env_id, *counts, ends, str(len(total.findings)))
    console.print(table)


def main() -> int:
    """Read the arguments and play."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--replay", metavar="SEED:RUN")
    options = parser.parse_args()
    console = Console(width=120)
    if options.replay:
        run = Run.drawn(*map(int, options.replay.split(":")), quick=options.quick)
        console.print(str(run), markup=False, highlight=False, soft_wrap=True)
        outcome = play(run)
        show({run.env_id: outcome}, console)
        for finding in outcome.findings:
            console.print(finding, markup=False, highlight=False, soft_wrap=True)
        return 1 if outcome.findings else 0
    return play_all(options.seed, options.minutes, options.quick, console)


if __name__ == "__main__":
    sys.exit(main())
