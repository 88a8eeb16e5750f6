"""Learn an acquisition function for presses on any organ by an evolution strategy.

    python -m agents.learn_sites --faces agents/faces/phantom_standard.npz \
        --check-faces agents/faces/phantom_standard_held.npz --out runs/sites.json

The covariance matrix adaptation evolution strategy (Hansen 2016, "The CMA evolution strategy: a tutorial"; package
`cma`) changes the 13 numbers of `surgsim_apps.training.acquisition.Acquisition`, beginning at the upper confidence
bound of `gp_ucb`. All candidates of a generation play the same episodes on faces of `agents.record_faces`, as many of
each recording, with `--weights` in the cost; each generation has new ones. Processes share the episodes. An episode
costs

    mean error / 20 mm + mean over lines of (presses until the error stays below the line) / presses
    + mean over presses 8 to 20 of 1 / (1 + exp((5 mm - error) / 1 mm))

with the lines 5 mm and 3.3 mm, over the first 30 presses. The last term is a smooth share of episodes with an error
above 5 mm after so many presses: the leaderboard counts the presses until that is a half of them. Without it a search
leaves lesions at errors of 5 to 9 mm and looks for others, which costs less on average and more in the median. The
policy of the generation with the least cost on `--check-faces` is kept, faces without a part in the learning;
generation 0 is the upper confidence bound.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cma
import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.scoring.figures import ERROR_LINE
from surgsim_apps.training.acquisition import Acquisition
from surgsim_apps.training.policy_files import (
    PolicyDescription,
    observation_declaration,
    policy_path,
    save_policy,
)
from surgsim_apps.training.recorded_faces import load_faces
from surgsim_apps.training.site_agent import GrowingBelief, SiteProcess, observed_facts
from surgsim_apps.training.site_surrogate import SiteSurrogate, SurrogateFace
from surgsim_env.palpation import CUTOFF, MAP_SIDE

Draw = Callable[[np.random.Generator], SurrogateFace]
# From an acquisition function, seeds and a source of faces to the errors [mm] after each press of episodes.
Play = Callable[[Acquisition, Sequence[int], Draw], list[NDArray[np.float64]]]

ID = "SurgSim/PalpateSites-v0"
# Comparable steps of the parameters, in the order of `Acquisition.values`.
PARAMETER_STEPS = (0.7, 1.5, 1.0, 0.7, 0.7, 0.2, 0.5, 0.3, 0.3, 0.2, 0.1, 0.6, 0.4)
# Standard deviation of the first generation in these steps.
FIRST_SPREAD = 0.5
# Lines of the cost [mm].
LINES_MM = (1000.0 * ERROR_LINE, 1000.0 * ERROR_LINE / 1.5)
# Presses with counted errors above the first line, and the width of that step [mm].
EARLY, STEP_WIDTH_MM = slice(7, 20), 1.0
# Played presses of an episode: later ones are slow, and hardly differ between candidates.
PRESSES_MOST = 30
# Episodes of generation g are drawn from seeds after FIRST_SEED + g GENERATION_SEEDS; those for comparing generations
# have seeds of their own.
FIRST_SEED, GENERATION_SEEDS, CHECK_SEED = 4_000_000, 1000, 3_900_000


def play(acquisition: Acquisition, seeds: Sequence[int], draw: Draw) -> list[NDArray[np.float64]]:
    """Errors [mm] after each press of episodes of an acquisition function.

    An episode ends after PRESSES_MOST, or a smaller budget.
    """
    return [_play(acquisition, seed, draw) for seed in seeds]


def _play(acquisition: Acquisition, seed: int, draw: Draw) -> NDArray[np.float64]:
    env = SiteSurrogate(draw)
    observation, _ = env.reset(seed=seed)
    process = SiteProcess(observed_facts(observation))
    growing, pressed = GrowingBelief(process, env.budget), np.zeros(MAP_SIDE**2, dtype=np.bool_)
    errors: list[float] = []
    while len(errors) < min(env.budget, PRESSES_MOST):
        site = acquisition.best(process, growing.belief, pressed)
        _, _, _, _, info = env.step(env.face.map.places[site].astype(np.float32))
        growing.add(site, env.values[-1])
        pressed[site] = True
        errors.append(info["error_mm"])
    return np.array(errors)


def played(
    acquisition: Acquisition, seeds: Sequence[int], draw: Draw, *, pool: Executor, shares: int
) -> list[NDArray[np.float64]]:
    """As `play`, the episodes in shares on the processes of a pool."""
    parts = [seeds[share::shares] for share in range(shares)]
    errors = list(pool.map(play, [acquisition] * shares, parts, [draw] * shares))
    return [errors[number % shares][number // shares] for number in range(len(seeds))]


def presses_to_stay(errors: NDArray[np.float64], line: float) -> int:
    """Presses until errors (n,) are and stay at most a line; n + 1 for never."""
    above = np.flatnonzero(errors > line)
    return int(above[-1]) + 2 if len(above) else 1


def cost(errors: Sequence[NDArray[np.float64]]) -> float:
    """The mean cost of episodes from their errors [mm]."""
    means = [episode.mean() / (1000.0 * CUTOFF) for episode in errors]
    shares = [np.mean([presses_to_stay(episode, line) / len(episode) for line in LINES_MM]) for episode in errors]
    above = [np.mean(expit((episode[EARLY] - LINES_MM[0]) / STEP_WIDTH_MM)) for episode in errors]
    return float(np.mean(means) + np.mean(shares) + np.mean(above))


@dataclass
class Evolution:
    """The search: `step` plays a generation, `best` is the mean of its distribution.

    Args:
        population: candidates of a generation.
        episodes: of each candidate, on faces of each source.
        seed: of the candidates and the episodes.
        sources: of faces, each with its weight in the cost; the weights' sum is 1.
        spread: standard deviation of the first generation in PARAMETER_STEPS.
        play: plays the episodes.
    """

    population: int
    episodes: int
    seed: int
    sources: Sequence[tuple[Draw, float]]
    spread: float = FIRST_SPREAD
    play: Play = play

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        # A seed of 0 or above would set numpy's global generator.
        settings = {
            "popsize": self.population,
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": np.nan,
            "verbose": -9,
        }
        self.strategy = cma.CMAEvolutionStrategy(np.zeros(len(PARAMETER_STEPS)), self.spread, settings)
        self.generation = self.episode_count = 0

    def acquisition(self, steps: NDArray[np.float64]) -> Acquisition:
        """The acquisition function at a distance in steps from the first one (13,)."""
        return Acquisition(tuple((np.array(Acquisition().values) + steps * PARAMETER_STEPS).tolist()))

    @property
    def best(self) -> Acquisition:
        """The mean of the candidates' distribution."""
        return self.acquisition(self.strategy.mean)

    def cost(self, acquisition: Acquisition, seeds: Sequence[int], sources: Sequence[tuple[Draw, float]]) -> float:
        """The mean cost of the episodes of seeds on faces of weighted sources."""
        return sum(weight * cost(self.play(acquisition, seeds, draw)) for draw, weight in sources)

    def step(self) -> None:
        """Play one generation."""
        first = FIRST_SEED + (1000 * self.seed + self.generation) * GENERATION_SEEDS
        seeds = range(first, first + self.episodes)
        candidates = self.strategy.ask()
        self.strategy.tell(
            candidates, [self.cost(self.acquisition(steps), seeds, self.sources) for steps in candidates]
        )
        self.generation += 1
        self.episode_count += self.population * self.episodes * len(self.sources)


def weighted_sources(paths: Sequence[Path], weights: Sequence[float] | None = None) -> list[tuple[Draw, float]]:
    """Recordings with their shares of the weights, by default equal ones."""
    weights = weights or [1.0] * len(paths)
    return [(load_faces(path), weight / math.fsum(weights)) for path, weight in zip(paths, weights, strict=True)]


def learn(arguments: argparse.Namespace) -> None:
    """Search; print a line after each generation, and write the policy at each new least cost."""
    context, one_thread = get_context("spawn"), {"initializer": torch.set_num_threads, "initargs": (1,)}
    with lone_run(arguments.out), ProcessPoolExecutor(arguments.processes, context, **one_thread) as pool:
        _search(arguments, partial(played, pool=pool, shares=arguments.processes))


def _search(arguments: argparse.Namespace, play: Play) -> None:
    sources = weighted_sources(arguments.faces, arguments.weights)
    check_sources = weighted_sources(arguments.check_faces, arguments.weights)
    evolution = Evolution(arguments.population, arguments.episodes, arguments.seed, sources, arguments.spread, play)
    check, began = range(CHECK_SEED, CHECK_SEED + arguments.check_episodes), time.time()
    env = gym.make(ID, scene="phantom_small").unwrapped
    least = math.inf
    while True:
        checked = evolution.cost(evolution.best, check, check_sources)
        print(
            f"generation {evolution.generation}: cost {checked:.3f} on {len(check)} other episodes, "
            f"{time.time() - began:.0f} s",
            flush=True,
        )
        if checked < least:
            least = checked
            description = PolicyDescription(
                env_id=ID,
                observation=observation_declaration(env),
                trained_steps=evolution.episode_count,
                seed=arguments.seed,
            )
            save_policy(evolution.best, description, arguments.out)
        if evolution.generation >= arguments.generations:
            return
        evolution.step()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=policy_path, required=True, help="the policy's file, NAME.json")
    parser.add_argument("--faces", type=Path, nargs="+", required=True, help="recordings of agents.record_faces")
    parser.add_argument("--weights", type=float, nargs="*", help="of the recordings in the cost; equal by default")
    parser.add_argument(
        "--check-faces", type=Path, nargs="+", required=True, help="as many, that generations are compared on"
    )
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--population", type=int, default=12, help="candidates of a generation")
    parser.add_argument("--episodes", type=int, default=96, help="of each candidate")
    parser.add_argument("--check-episodes", type=int, default=192, help="that generations are compared by")
    parser.add_argument("--spread", type=float, default=FIRST_SPREAD, help="of the first generation, in steps")
    parser.add_argument("--processes", type=int, default=2, help="that episodes are shared among")
    parser.add_argument("--seed", type=int, default=0)
    learn(parser.parse_args())


if __name__ == "__main__":
    sys.exit(exit_status(main))
