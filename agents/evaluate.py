"""Score methods on the evaluation seeds, write the leaderboard, film a policy; run from a checkout.

    python -m agents.evaluate --agent gp_ucb --scene phantom --level standard
    python -m agents.evaluate --all --scene phantom --level standard     # every baseline and every policy for it
    python -m agents.evaluate --agent oracle_retract --motion calm       # a patient who breathes
    python -m agents.evaluate --policy agents/policies/NAME.safetensors --episodes 20 --video out.mp4
    python -m agents.evaluate --agent my_agent:MyAgent --submit mine.json # an agent of your own: docs/own_agent.md
    python -m agents.evaluate --check mine.json
    python -m agents.evaluate --compare gp_ucb raster_3 --scene phantom --level standard
    python -m agents.evaluate --reach --scene phantom --level hard       # lesions below the sensor's reach
    python -m agents.evaluate --leaderboard

Results of the project's own methods on all evaluation seeds go to agents/results/, one file per method, scene and
level; the leaderboard is written from all of them. Other results are printed, and written where --results or --submit
says.
Reading NAME.safetensors runs no code of its author; a zip of stable-baselines3 is read with --trust-pickle only.
"""

import argparse
import datetime
import inspect
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import surgsim_env  # noqa: F401  (registers the ids)
from agents import site_search
from agents.command_line import named_class, one_line_errors
from agents.expert_palpate import PalpateExpert
from agents.expert_retract import RetractExpert
from agents.scoring.comparison import compare, describe
from agents.scoring.episodes import (
    Actor,
    AgentActor,
    episode_facts,
    estimates_itself,
    make_envs,
    play_scripts,
    play_sites,
    play_tasks,
    sees_truth,
    task_figures,
)
from agents.scoring.leaderboard import write_leaderboard
from agents.scoring.leaderboard_plots import IMAGES, draw_leaderboard
from agents.scoring.origin import check_origin, describe_origin
from agents.scoring.results import RESULTS, SITES, Result, family, load_result, load_results, read_seeds, seeds_text
from agents.scoring.site_agent import SiteAgent, site_facts
from agents.site_search import AGENTS, RASTER_SIDES, REFERENCES
from surgsim_env.palpation.scores import EVALUATION_SEEDS, press_errors, score, with_intervals
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import SPLITS
from surgsim_env.scene.motions import list_motions
from surgsim_env.scripting import oracle
from surgsim_env.tasks.palpate_sites import SUCCESS_ERROR

with one_line_errors(__name__, "agents"):
    from tqdm import tqdm

# Seed of the bootstrap; time between two messages of progress [s].
BOOTSTRAP_SEED, PROGRESS_EVERY = 0, 60.0
POLICIES = Path(__file__).resolve().parent / "policies"
# Where a method plays unless options say otherwise.
PLACES = {"scene": "phantom", "level": "standard"}
# Arguments of SurgSim/Palpate-v0 with which organs of any size and pose are alike.
IN_FACE = {"memory": True, "frame": "face"}
# The members of a family that scores are of.
SCORED_SPLIT = "test"


@dataclass(frozen=True)
class Player:
    """What is scored, and where.

    Args:
        name: of the method.
        actor: what plays; None: the oracle's script.
        env_id, kwargs: the environment.
        command: that scores it.
        files: that it consists of.
        sees_truth: whether it may see what is hidden.
        own_estimate: whether its own estimate is scored.
        ours: whether its result belongs in agents/results.
        check: refuses an environment that it cannot play.
    """

    name: str
    actor: Actor | AgentActor | None
    env_id: str
    kwargs: dict[str, Any]
    command: str
    files: tuple[Path, ...]
    sees_truth: bool = False
    own_estimate: bool = False
    ours: bool = True
    check: Callable[[gym.Env], None] = lambda env: None


@dataclass(frozen=True)
class TaskAgent:
    """A script for another environment than SurgSim/PalpateSites-v0.

    Args:
        env_id: the environment's.
        make: the script, for the environment's arguments.
        file: that it is in.
        kwargs: further arguments of the environment.
        has_places: whether the environment takes `scene` and `level`.
    """

    env_id: str
    make: Callable[[dict[str, Any]], Actor]
    file: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    has_places: bool = False


def _organ_expert(*, blind: bool) -> Callable[[dict[str, Any]], Actor]:
    """Makes the expert for any organ, which needs torch."""

    def make(kwargs: dict[str, Any]) -> Actor:
        from agents.expert_organs import OrganExpert

        return OrganExpert(blind=blind).act

    return make


TASK_AGENTS = {
    "expert_retract": TaskAgent(
        "SurgSim/Retract-v0", lambda kwargs: RetractExpert().act_all, "expert_retract.py", {"scaled": False}
    ),
    "expert_palpate": TaskAgent(
        "SurgSim/Palpate-v0",
        lambda kwargs: PalpateExpert(gym.make("SurgSim/Palpate-v0", **kwargs)).act,
        "expert_palpate.py",
        {"memory": True},
        has_places=True,
    ),
    "expert_organs": TaskAgent(
        "SurgSim/Palpate-v0", _organ_expert(blind=False), "expert_organs.py", IN_FACE, has_places=True
    ),
    "blind_middle": TaskAgent(
        "SurgSim/Palpate-v0", _organ_expert(blind=True), "expert_organs.py", IN_FACE, has_places=True
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
    what.add_argument("--agent", help=f"MODULE:CLASS, or one of {', '.join([*AGENTS, *TASK_AGENTS, *ORACLES])}")
    what.add_argument("--policy", type=Path, help="NAME.safetensors, with NAME.json beside it")
    what.add_argument("--reach", action="store_true", help="count the lesions below the sensor's reach")
    what.add_argument("--leaderboard", action="store_true", help="write the leaderboard and its pictures only")
    what.add_argument(
        "--compare", nargs=2, metavar=("A", "B"), help="two methods of --results on this scene and level, or two files"
    )
    what.add_argument(
        "--check", type=Path, metavar="FILE", help="whether a result can be compared with those made here"
    )
    parser.add_argument("--env", help=f"the environment of MODULE:CLASS, {SITES} by default")
    parser.add_argument(
        "--env-arguments", type=json.loads, default={}, help="of the environment of MODULE:CLASS, as JSON"
    )
    parser.add_argument(
        "--trust-pickle", action="store_true", help="let --policy be a zip, which runs any code of its author"
    )
    parser.add_argument("--scene", help="phantom by default; for a policy, that of its training")
    parser.add_argument("--level", help="standard by default; for a policy, that of its training")
    parser.add_argument("--split", choices=SPLITS, help=f"of a family of organs, {SCORED_SPLIT!r} by default")
    parser.add_argument("--motion", choices=list_motions(), help="how the patient moves; as the scene says by default")
    parser.add_argument(
        "--no-tracking", action="store_true", help="presses and oracles go where the surface is at rest, as it moves"
    )
    parser.add_argument(
        "--seeds",
        type=_seeds,
        default=tuple(EVALUATION_SEEDS),
        help="FIRST:LAST or A,B,C; the evaluation seeds by default",
    )
    parser.add_argument("--episodes", type=int, help="play the first of the seeds, so many")
    parser.add_argument("--budget", type=int, help="presses of an episode, in place of the environment's own")
    parser.add_argument("--envs", type=int, default=16, help="organs side by side")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--dtype", default="float32", choices=("float64", "float32"), help="of the lanes")
    parser.add_argument("--results", type=Path, help="folder of the result files; agents/results by default")
    parser.add_argument("--submit", type=Path, metavar="FILE", help="write the result into one file, and nowhere else")
    parser.add_argument("--video", type=Path, help="film the first episodes into this mp4 file")
    parser.add_argument("--video-episodes", type=int, default=3)
    options = parser.parse_args(arguments)
    if options.episodes is not None:
        if not 1 <= options.episodes <= len(options.seeds):
            parser.error(f"--episodes is {options.episodes}; there are 1 to {len(options.seeds)} seeds")
        options.seeds = options.seeds[: options.episodes]
    if options.envs < 1:
        parser.error(f"--envs is {options.envs}; at least 1 organ is played")
    if options.video is not None and options.policy is None:
        parser.error("--video films a policy: give --policy as well")
    if options.submit is not None and options.agent is None and options.policy is None:
        parser.error("--submit writes one result: give --agent or --policy as well")
    if (options.env or options.env_arguments) and ":" not in (options.agent or ""):
        parser.error(
            "--env and --env-arguments are for --agent MODULE:CLASS; other methods have environments of their own"
        )
    if options.reach:
        write_reach(options)
    elif options.agent is not None:
        evaluate(find_player(options.agent, options), options)
    elif options.policy is not None:
        evaluate(policy_player(options.policy, options), options)
    elif options.all:
        evaluate_all(options)
    elif options.compare:
        print_comparison(*options.compare, options)
    elif options.check is not None:
        check(options.check, options)
    if options.leaderboard:
        write_leaderboard()
        draw_leaderboard(load_results(), IMAGES)


def evaluate_all(options: argparse.Namespace) -> None:
    """Every baseline on the scene and level of the options, then every policy trained on that scene."""
    from agents.training.policy_files import home_scene

    options.scene = options.scene or PLACES["scene"]
    options.level = options.level or PLACES["level"]
    widest = 7 if "wide" in options.scene else 5
    skipped = {f"raster_{side}" for side in RASTER_SIDES if not widest - 3 <= side <= widest}
    for name in AGENTS:
        if name not in skipped:
            evaluate(find_player(name, options), options)
    for path in sorted(POLICIES.glob("*.json")):
        described = json.loads(path.read_text(encoding="utf-8"))
        if home_scene(described["env_id"], described["env_kwargs"]) == options.scene:
            evaluate(policy_player(path.with_suffix(".safetensors"), options), options)


def find_player(name: str, options: argparse.Namespace) -> Player:
    """The player of a name: a site search, a script of another environment, an oracle, or MODULE:CLASS.

    Raises:
        ValueError: an unknown name, or a class that is not there.
    """
    command, ours = f"python -m agents.evaluate --agent {name}", Path(__file__).resolve().parent
    if ":" in name:
        return _strangers_player(name, options)
    if name in ORACLES:
        env_id, has_places = ORACLES[name]
        kwargs = _places(options, PLACES if has_places else {})
        return Player(
            name, None, env_id, kwargs, command + _place_options(kwargs), (Path(oracle.__file__),), sees_truth=True
        )
    if name in TASK_AGENTS:
        script = TASK_AGENTS[name]
        kwargs = _places(options, PLACES if script.has_places else {})
        command += _place_options(kwargs)
        kwargs |= script.kwargs
        return Player(name, script.make(kwargs), script.env_id, kwargs, command, (ours / script.file,))
    make, kwargs = find_agent(name), _places(options, PLACES)
    command += _place_options(kwargs)
    if name in REFERENCES:
        # Their estimates do not depend on the presses.
        kwargs["budget"] = 1
    files = (Path(site_search.__file__),)
    return Player(name, AgentActor(make), SITES, kwargs, command, files, **_declared(make()))


def _strangers_player(name: str, options: argparse.Namespace) -> Player:
    make, env_id = named_class(name, "--agent"), options.env or SITES
    kwargs = {**_places(options, PLACES if env_id == SITES else {}), **options.env_arguments}
    command = f"python -m agents.evaluate --agent {name}" + f" --env {env_id}" * (env_id != SITES)
    command += f" --env-arguments '{json.dumps(options.env_arguments)}'" * bool(options.env_arguments)
    command += _place_options(_places(options, {}))
    agent = make()
    for method in ("reset", "act"):
        if not callable(getattr(agent, method, None)):
            raise ValueError(f"--agent {name}: it has no method {method}; docs/own_agent.md says what an agent has")
    facts = site_facts if env_id == SITES else lambda env: episode_facts(env, env_id, kwargs)
    file = inspect.getsourcefile(type(agent))
    files = () if file is None else (Path(file),)
    actor = AgentActor(make, facts)
    return Player(name.replace(":", "."), actor, env_id, kwargs, command, files, ours=False, **_declared(agent))


def _declared(agent: Any) -> dict[str, bool]:
    return {"sees_truth": sees_truth(agent), "own_estimate": estimates_itself(agent)}


def _places(options: argparse.Namespace, defaults: dict[str, str]) -> dict[str, Any]:
    """Scene, level and split as the options or else the defaults have them; else they are the environment's own.

    A family of organs is scored on its test split.
    """
    given = {name: getattr(options, name) for name in (*PLACES, "split") if getattr(options, name) is not None}
    places = {**defaults, **given}
    if "scene" in places and make_scene(places["scene"]).family is not None:
        places.setdefault("split", SCORED_SPLIT)
    return places


def _place_options(kwargs: dict[str, Any]) -> str:
    told = _without_folders(kwargs)
    return "".join(f" --{name} {told[name]}" for name in (*PLACES, "split") if name in told)


def policy_player(path: Path, options: argparse.Namespace) -> Player:
    """A trained policy on its own environment, or on the scene and level of the options where it can play them."""
    from agents.training.policy_files import load_policy

    policy = load_policy(path, trust_pickle=options.trust_pickle)
    env_id = policy.description.env_id
    module, _, _ = env_id.rpartition(":")
    if module not in ("", "surgsim_env") and not options.trust_pickle:
        raise ValueError(
            f"policy {path}: env_id {env_id!r} imports the module {module!r}: give --trust-pickle "
            "if you trust the policy's author"
        )
    own = {**(PLACES if env_id == SITES else {}), **policy.description.env_kwargs}
    kwargs = {**own, **_places(options, {})}
    command = f"python -m agents.evaluate --policy {_from_here(path)}"
    # The level always, the scene where it is another than that of the training.
    told = {name: value for name, value in kwargs.items() if name == "level" or value != own.get(name)}
    policy.reset(min(options.envs, len(options.seeds)))

    def check(env: gym.Env) -> None:
        policy.check_environment(env, f"policy {path}")
        if options.video is not None:
            from agents.scoring.policy_video import film

            film(policy, _arguments(player, options), options.seeds[: options.video_episodes], options.video)
            policy.reset(min(options.envs, len(options.seeds)))

    files = (path, path.with_suffix(".json"))
    player = Player(
        *(path.stem, policy.act, env_id, kwargs, command + _place_options(told), files),
        ours=_is_ours(path),
        check=check,
    )
    return player


def _is_ours(path: Path) -> bool:
    return path.resolve().parent == POLICIES


def _arguments(player: Player, options: argparse.Namespace) -> dict[str, Any]:
    """The environment's arguments, with those that options add.

    Raises:
        ValueError: an option that this player or its environment cannot take.
    """
    kwargs = dict(player.kwargs)
    if options.motion is not None:
        kwargs["motion"] = options.motion
    if options.budget is not None:
        if player.env_id != SITES:
            raise ValueError(f"--budget is the number of presses of {SITES}; {player.name} plays {player.env_id}")
        kwargs["budget"] = options.budget
    if options.no_tracking:
        if player.env_id == SITES:
            kwargs["track_motion"] = False
        elif player.actor is not None:
            raise ValueError(
                f"--no-tracking is for the presses of {SITES} and for oracles; {player.name} moves as it will"
            )
    return kwargs


def evaluate(player: Player, options: argparse.Namespace) -> Result:
    """Play the seeds of the options; print the result and write it where it belongs."""
    kwargs, seeds, env_id, actor = _arguments(player, options), options.seeds, player.env_id, player.actor
    name = player.name + "_untracked" * options.no_tracking
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    count = 1 if actor is None else min(options.envs, len(seeds))
    try:
        envs = make_envs(env_id, count, dtype=options.dtype, threads=options.threads, **kwargs)
    except (gym.error.Error, TypeError, ValueError) as error:
        raise ValueError(f"{name}: {env_id} with {kwargs} cannot be made: {error}") from error
    first = envs.unwrapped.envs[0].unwrapped  # type: ignore[attr-defined]
    player.check(first)
    origin = describe_origin(first, player.files, "float64" if actor is None else options.dtype)
    start, bar = time.perf_counter(), tqdm(desc=name, unit=" steps", mininterval=PROGRESS_EVERY)
    scored: dict[str, Any]
    if actor is not None and env_id == SITES:
        presses, budget = play_sites(actor, envs, seeds, bar.update), first.task.budget
        line = SUCCESS_ERROR * first.task.tip_scale
        succeeded = [bool(press_errors(record, budget)[-1] <= line) for record in presses]
        share = {"success": np.array(succeeded, dtype=np.float64)}
        scored = {
            "budget": budget,
            "figures": {**score(presses, budget, rng), **with_intervals(share, rng)},
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
        succeeded = [bool(record.last["success"]) for record in records]
        scored = {
            "budget": first.task.episode_steps or 0,
            "figures": task_figures(records, control_step, soft_force, rng),
        }
    taken = time.perf_counter() - start
    bar.close()
    envs.close()
    result = Result(
        method=name,
        env_id=env_id,
        env_kwargs=_without_folders(kwargs),
        seeds=tuple(seeds),
        command=_with_options(player.command, options),
        wall_time=round(taken, 1),
        date=datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        successes=succeeded,
        sees_truth=player.sees_truth,
        own_estimate=player.own_estimate,
        origin=origin,
        **scored,
    )
    path = _write(result, player, options)
    shown = {name: figure.value for name, figure in result.figures.items()}
    printed = ("presses_to_median", "presses_to_p90", "error_mm", "success", "seconds", "force_peak", "torn")
    figures = ", ".join(f"{name} {shown[name]:.3g}" for name in printed if shown.get(name) is not None)
    where = "not written (--results FOLDER or --submit FILE does)" if path is None else f"-> {path}"
    print(f"{result.place} {result.method}: {figures}; {result.wall_time:.0f} s {where}", flush=True)
    return result


def _write(result: Result, player: Player, options: argparse.Namespace) -> Path | None:
    """Write a result where it belongs; agents/results holds the project's own methods on all evaluation seeds alone."""
    if options.submit is not None:
        result.write(options.submit)
        return options.submit
    if options.results is not None:
        path = result.save(options.results)
    elif player.ours and result.seeds == tuple(EVALUATION_SEEDS):
        path = result.save(RESULTS)
    else:
        return None
    if path.parent.resolve() == RESULTS:
        write_leaderboard()
        draw_leaderboard(load_results(), IMAGES)
    return path


def print_comparison(one: str, other: str, options: argparse.Namespace) -> None:
    """Print the differences of two methods, each a file, a method's name, or a name that training seeds share."""
    groups = [_group(name, options) for name in (one, other)]
    names = [Path(name).stem if name.endswith(".json") else name for name in (one, other)]
    first, differences = groups[0][0], compare(*groups, np.random.default_rng(BOOTSTRAP_SEED))
    print(f"{first.place}, seeds {seeds_text(first.seeds)}: differences with 95 % intervals of a paired bootstrap")
    for name, group in zip(names, groups, strict=True):
        if len(group) > 1:
            print(f"{name}: mean over {len(group)} training seeds")
    for difference in differences:
        print(describe(difference, *names))


def _group(name: str, options: argparse.Namespace) -> list[Result]:
    """The results of a file or of a name: one, or one for each seed of a training."""
    if name.endswith(".json"):
        return [load_result(Path(name))]
    folder = options.results or RESULTS
    wanted = _places(options, PLACES)
    named = [one for one in load_results(folder) if name in (one.method, family(one.method))]
    # An environment without a choice of scene or level has neither.
    found = [
        one
        for one in named
        if one.scene in ("", Path(wanted["scene"]).stem)
        and one.env_kwargs.get("level") in (None, wanted["level"])
        and one.env_kwargs.get("split") == wanted.get("split")
        and one.motion == (options.motion or "")
    ]
    if not found or len({one.place for one in found}) > 1:
        places = ", ".join(sorted({one.place for one in named})) or "none"
        raise ValueError(
            f"{name!r} names {len(found)} results in {_from_here(folder)} at {wanted['scene']}, {wanted['level']}; it "
            f"has some at {places}: give --scene, --level and --motion, or a file"
        )
    return found


def check(path: Path, options: argparse.Namespace) -> None:
    """Say whether a result can be compared with those made here.

    Raises:
        ValueError: it cannot (says why).
    """
    result = load_result(path)
    faults = list(check_origin(result, _files_here(result)))
    if faults:
        raise ValueError(f"{path} cannot be compared with results made here: {'; '.join(faults)}")
    print(f"{path}: {result.method} on {result.place}, seeds {seeds_text(result.seeds)}: the environment is the same")


def _files_here(result: Result) -> list[Path]:
    """The agent's files that are in the working folder or in the project, for digests to be compared."""
    ours = Path(__file__).resolve().parent
    folders = (Path(), ours, POLICIES, Path(oracle.__file__).parent)
    return [
        next(folder / name for folder in folders if (folder / name).is_file())
        for name in map(str, result.origin.get("agent", {}))
        if Path(name).name == name and any((folder / name).is_file() for folder in folders)
    ]


def write_reach(options: argparse.Namespace) -> None:
    """Press over each lesion of the evaluation seeds, with and without it, and count those below the sensor's reach."""
    from surgsim_env.palpation.scores import lesion_reaches

    kwargs = _places(options, PLACES)
    env = gym.make(SITES, **kwargs).unwrapped
    reaches = []
    for seed in tqdm(options.seeds, desc="reach", mininterval=PROGRESS_EVERY):
        env.reset(seed=seed)
        reaches += lesion_reaches(env.task.anatomy, env.task.drawn)  # type: ignore[attr-defined]
    table = {
        **kwargs,
        "lesions": len(reaches),
        "below": sum(reach.below for reach in reaches),
        "noise": reaches[0].noise,
        "differences": [round(reach.force - reach.force_without, 5) for reach in reaches],
    }
    print(f"{table['below']} of {table['lesions']} lesions below reach", flush=True)
    folder = options.results or (RESULTS if options.seeds == tuple(EVALUATION_SEEDS) else None)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"reach_PalpateSites_{kwargs['scene']}_{kwargs['level']}.json"
        path.write_text(json.dumps(table) + "\n", encoding="utf-8")
        print(f"-> {path}")


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return read_seeds(text)
    except ValueError as error:
        # Of a ValueError argparse would not show the text.
        raise argparse.ArgumentTypeError(str(error)) from None


def _with_options(command: str, options: argparse.Namespace) -> str:
    command += "" if options.seeds == tuple(EVALUATION_SEEDS) else f" --seeds {seeds_text(options.seeds)}"
    command += "" if options.budget is None else f" --budget {options.budget}"
    command += "" if options.motion is None else f" --motion {options.motion}"
    command += " --no-tracking" * options.no_tracking
    return command + ("" if options.dtype == "float32" else f" --dtype {options.dtype}")


def _without_folders(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Arguments with files relative to the checkout or by their names, so that no machine's folders are written."""
    return {
        name: _from_here(Path(value)) if isinstance(value, str) and Path(value).is_absolute() else value
        for name, value in kwargs.items()
    }


def _from_here(path: Path) -> str:
    """The path relative to the checkout, so that no machine's folders are written."""
    absolute, checkout = path.resolve(), POLICIES.parent.parent
    return absolute.relative_to(checkout).as_posix() if absolute.is_relative_to(checkout) else path.name


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
