"""Score methods on the evaluation seeds, write the leaderboard, film a policy; run from a checkout.

    python -m agents.evaluate --agent gp_ucb --scene phantom --level standard
    python -m agents.evaluate --all --scene phantom --level standard     # every baseline and every policy for it
    python -m agents.evaluate --agent oracle_retract --motion calm       # a patient who breathes
    python -m agents.evaluate --policy agents/policies/NAME.safetensors --episodes 20 --video out.mp4
    python -m agents.evaluate --reach --scene phantom --level hard       # lesions below the sensor's reach
    python -m agents.evaluate --leaderboard

Results go to agents/results/, one file per method, scene and level; the leaderboard is written from all of them.
Reading NAME.safetensors runs no code of its author; a zip of stable-baselines3 is read with --trust-pickle only.
"""

import argparse
import datetime
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from agents.expert_palpate import PalpateExpert
from agents.expert_retract import RetractExpert
from agents.scoring.episodes import (
    Actor,
    SiteActor,
    make_envs,
    play_scripts,
    play_sites,
    play_tasks,
    task_figures,
)
from agents.scoring.leaderboard import RESULTS, SITES, Result, write_leaderboard
from agents.scoring.site_agent import SiteAgent
from agents.site_search import AGENTS, RASTER_SIDES, REFERENCES
from surgsim_env.palpation.scores import EVALUATION_SEEDS, press_errors, score, with_intervals
from surgsim_env.scene.motions import list_motions
from surgsim_env.tasks.palpate_sites import SUCCESS_ERROR

with one_line_errors(__name__, "agents"):
    from tqdm import tqdm

# Seed of the bootstrap; time between two messages of progress [s].
BOOTSTRAP_SEED, PROGRESS_EVERY = 0, 60.0
POLICIES = Path(__file__).resolve().parent / "policies"


@dataclass(frozen=True)
class TaskAgent:
    """A script for another environment than SurgSim/PalpateSites-v0.

    Args:
        env_id: the environment's.
        make: the script, for the environment's arguments.
        kwargs: further arguments of the environment.
        has_places: whether the environment takes `scene` and `level`.
    """

    env_id: str
    make: Callable[[dict[str, Any]], Actor]
    kwargs: dict[str, Any] = field(default_factory=dict)
    has_places: bool = False


TASK_AGENTS = {
    "expert_retract": TaskAgent("SurgSim/Retract-v0", lambda kwargs: RetractExpert().act_all, {"scaled": False}),
    "expert_palpate": TaskAgent(
        "SurgSim/Palpate-v0",
        lambda kwargs: PalpateExpert(gym.make("SurgSim/Palpate-v0", **kwargs)).act,
        {"memory": True},
        has_places=True,
    ),
}


# Environments whose oracle plays its script, and whether they take `scene` and `level`.
ORACLES = {
    "oracle_palpate": ("SurgSim/Palpate-v0", True),
    "oracle_retract": ("SurgSim/Retract-v0", False),
    "oracle_bimanual_retract": ("SurgSim/BimanualRetract-v0", False),
}


def find_agent(name: str) -> Callable[[], SiteAgent]:
    """The factory of the site search with a name.

    Raises:
        ValueError: an unknown name (lists the known).
    """
    if name not in AGENTS:
        raise ValueError(f"agent {name!r} is unknown; the agents are {', '.join([*AGENTS, *TASK_AGENTS, *ORACLES])}")
    return AGENTS[name]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--all", action="store_true", help="every baseline, and every policy for this scene")
    what.add_argument("--agent", help=f"one of {', '.join([*AGENTS, *TASK_AGENTS, *ORACLES])}")
    what.add_argument("--policy", type=Path, help="NAME.safetensors, with NAME.json beside it")
    what.add_argument("--reach", action="store_true", help="count the lesions below the sensor's reach")
    what.add_argument("--leaderboard", action="store_true", help="write the leaderboard only")
    parser.add_argument(
        "--trust-pickle", action="store_true", help="let --policy be a zip, which runs any code of its author"
    )
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--motion", choices=list_motions(), help="how the patient moves; as the scene says by default")
    parser.add_argument(
        "--no-tracking", action="store_true", help="presses and oracles go where the surface is at rest, as it moves"
    )
    parser.add_argument("--episodes", type=int, default=len(EVALUATION_SEEDS))
    parser.add_argument("--budget", type=int, help="presses of an episode, in place of the environment's own")
    parser.add_argument("--envs", type=int, default=16, help="organs side by side")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--dtype", default="float32", choices=("float64", "float32"), help="of the lanes")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the result files")
    parser.add_argument("--video", type=Path, help="film the first episodes into this mp4 file")
    parser.add_argument("--video-episodes", type=int, default=3)
    options = parser.parse_args(arguments)
    if not 1 <= options.episodes <= len(EVALUATION_SEEDS):
        parser.error(f"--episodes is {options.episodes}; there are 1 to {len(EVALUATION_SEEDS)} evaluation seeds")
    if options.video is not None and options.policy is None:
        parser.error("--video films a policy: give --policy as well")
    if options.reach:
        write_reach(options)
    elif options.agent is not None:
        evaluate_agent(options.agent, options)
    elif options.policy is not None:
        evaluate_policy(options.policy, options)
    elif options.all:
        evaluate_all(options)
    if options.results == RESULTS:
        write_leaderboard()


def evaluate_all(options: argparse.Namespace) -> None:
    """Every baseline on the scene and level of the options, then every policy trained on that scene."""
    widest = 7 if "wide" in options.scene else 5
    skipped = {f"raster_{side}" for side in RASTER_SIDES if not widest - 3 <= side <= widest}
    for name in AGENTS:
        if name not in skipped:
            evaluate_agent(name, options)
    for path in sorted(POLICIES.glob("*.json")):
        kwargs = json.loads(path.read_text(encoding="utf-8"))["env_kwargs"]
        if kwargs.get("scene", "phantom") == options.scene:
            evaluate_policy(path.with_suffix(".safetensors"), options)


def evaluate_agent(name: str, options: argparse.Namespace) -> Result:
    """A baseline of SurgSim/PalpateSites-v0, or the script of another environment on its own scene."""
    if name in ORACLES:
        return evaluate_oracle(name, options)
    if name in TASK_AGENTS:
        script = TASK_AGENTS[name]
        command, kwargs = f"python -m agents.evaluate --agent {name}", dict(script.kwargs)
        if script.has_places:
            kwargs = {"scene": options.scene, "level": options.level, **kwargs}
            command += f" --scene {options.scene} --level {options.level}"
        return _evaluate(name, script.make(kwargs), script.env_id, kwargs, command, options)
    kwargs: dict[str, Any] = {"scene": options.scene, "level": options.level}
    if options.no_tracking:
        kwargs["track_motion"] = False
    if name in REFERENCES:
        # Their estimates do not depend on the presses.
        kwargs["budget"] = 1
    command = f"python -m agents.evaluate --agent {name} --scene {options.scene} --level {options.level}"
    return _evaluate(name, SiteActor(find_agent(name)), SITES, kwargs, command, options)


def evaluate_oracle(name: str, options: argparse.Namespace) -> Result:
    """The oracle's script of an environment, played alone."""
    env_id, has_places = ORACLES[name]
    places = {"scene": options.scene, "level": options.level} if has_places else {}
    command = f"python -m agents.evaluate --agent {name}" + "".join(
        f" --{key} {value}" for key, value in places.items()
    )
    return _evaluate(name, None, env_id, places, command, options)


def evaluate_policy(path: Path, options: argparse.Namespace) -> Result:
    """A trained policy on its own environment; `--level` sets the level if the environment has one."""
    from agents.training.policy_files import load_policy

    policy = load_policy(path, trust_pickle=options.trust_pickle)
    module, _, _ = policy.description.env_id.rpartition(":")
    if module not in ("", "surgsim_env") and not options.trust_pickle:
        raise ValueError(
            f"policy {path}: env_id {policy.description.env_id!r} imports the module {module!r}: give --trust-pickle "
            "if you trust the policy's author"
        )
    kwargs = dict(policy.description.env_kwargs)
    command = f"python -m agents.evaluate --policy {_from_here(path)}"
    if "level" in kwargs or policy.description.env_id == SITES:
        kwargs["level"] = options.level
        command += f" --level {options.level}"
    if options.video is not None:
        from agents.scoring.policy_video import film

        film(policy, kwargs, EVALUATION_SEEDS[: options.video_episodes], options.video)
    if policy.description.env_id == SITES:
        kwargs = {"scene": "phantom", **kwargs}
    policy.reset(min(options.envs, options.episodes))

    def check(env: gym.Env) -> None:
        policy.check_environment(env, f"policy {path}")

    return _evaluate(path.stem, policy.act, policy.description.env_id, kwargs, command, options, check)


def _evaluate(
    name: str,
    actor: Actor | SiteActor | None,
    env_id: str,
    kwargs: dict[str, Any],
    command: str,
    options: argparse.Namespace,
    check: Callable[[gym.Env], None] = lambda env: None,
) -> Result:
    """Play the evaluation seeds, with the oracle's script where there is no actor; save and print the result."""
    if options.motion is not None:
        kwargs = {**kwargs, "motion": options.motion}
    if options.no_tracking:
        name += "_untracked"
    seeds, rng = EVALUATION_SEEDS[: options.episodes], np.random.default_rng(BOOTSTRAP_SEED)
    if env_id == SITES and options.budget is not None:
        kwargs = {**kwargs, "budget": options.budget}
    count = 1 if actor is None else min(options.envs, options.episodes)
    try:
        envs = make_envs(env_id, count, dtype=options.dtype, threads=options.threads, **kwargs)
    except (gym.error.Error, TypeError) as error:
        raise ValueError(f"{name}: {env_id} with {kwargs} cannot be made: {error}") from error
    first = envs.unwrapped.envs[0].unwrapped  # type: ignore[attr-defined]
    check(first)
    start, bar = time.perf_counter(), tqdm(desc=name, unit=" steps", mininterval=PROGRESS_EVERY)
    scored: dict[str, Any]
    if actor is not None and env_id == SITES:
        presses, budget = play_sites(actor, envs, seeds, bar.update), first.task.budget
        line = SUCCESS_ERROR * first.task.tip_scale
        succeeded = np.array([press_errors(record, budget)[-1] <= line for record in presses], dtype=np.float64)
        scored = {
            "budget": budget,
            "figures": {**score(presses, budget, rng), **with_intervals({"success": succeeded}, rng)},
            "errors_mm": [np.round(1000.0 * press_errors(record, budget), 2).tolist() for record in presses],
            "lesion_counts": [len(record.truth) for record in presses],
        }
    else:
        control_step, soft_force = first.scene.timing.control_step, first.scene.limits.soft_force
        if actor is None:
            single = gym.make(env_id, **kwargs)
            records = play_scripts(single, seeds, tracks=not options.no_tracking, progress=bar.update)
        else:
            records = play_tasks(actor, envs, seeds, bar.update)
        scored = {
            "budget": gym.spec(env_id).max_episode_steps or 0,
            "figures": task_figures(records, control_step, soft_force, rng),
        }
    taken = time.perf_counter() - start
    bar.close()
    envs.close()
    result = Result(
        method=name,
        env_id=env_id,
        env_kwargs=kwargs,
        seeds=(seeds[0], seeds[-1]),
        command=_with_options(command, options),
        wall_time=round(taken, 1),
        date=datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        **scored,
    )
    path = result.save(options.results)
    shown = {name: figure.value for name, figure in result.figures.items()}
    printed = ("presses_to_median", "presses_to_p90", "error_mm", "success", "seconds", "force_peak", "torn")
    figures = ", ".join(f"{name} {shown[name]:.3g}" for name in printed if shown.get(name) is not None)
    print(f"{result.place} {result.method}: {figures}; {result.wall_time:.0f} s -> {path}", flush=True)
    return result


def write_reach(options: argparse.Namespace) -> None:
    """Press over each lesion of the evaluation seeds, with and without it, and count those below the sensor's reach."""
    from surgsim_env.palpation.scores import lesion_reaches

    kwargs = {"scene": options.scene, "level": options.level}
    env = gym.make(SITES, **kwargs).unwrapped
    reaches = []
    for seed in tqdm(EVALUATION_SEEDS[: options.episodes], desc="reach", mininterval=PROGRESS_EVERY):
        env.reset(seed=seed)
        reaches += lesion_reaches(env.task.anatomy, env.task.drawn)  # type: ignore[attr-defined]
    table = {
        **kwargs,
        "lesions": len(reaches),
        "below": sum(reach.below for reach in reaches),
        "noise": reaches[0].noise,
        "differences": [round(reach.force - reach.force_without, 5) for reach in reaches],
    }
    options.results.mkdir(parents=True, exist_ok=True)
    path = options.results / f"reach_PalpateSites_{options.scene}_{options.level}.json"
    path.write_text(json.dumps(table) + "\n", encoding="utf-8")
    print(f"{table['below']} of {table['lesions']} lesions below reach -> {path}")


def _with_options(command: str, options: argparse.Namespace) -> str:
    command += "" if options.episodes == len(EVALUATION_SEEDS) else f" --episodes {options.episodes}"
    command += "" if options.budget is None else f" --budget {options.budget}"
    command += "" if options.motion is None else f" --motion {options.motion}"
    command += " --no-tracking" * options.no_tracking
    return command + ("" if options.dtype == "float32" else f" --dtype {options.dtype}")


def _from_here(path: Path) -> str:
    """The path relative to the checkout, so that no machine's folders are written."""
    absolute, checkout = path.resolve(), POLICIES.parent.parent
    return absolute.relative_to(checkout).as_posix() if absolute.is_relative_to(checkout) else path.name


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
