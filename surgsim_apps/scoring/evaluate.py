"""Evaluation of a method on seeds, and its result file: baselines, trained policies, agents of others.

Results of the project's own methods on all evaluation seeds go to agents/results of a checkout, one file per method,
scene and level. Other results are printed, and written into the folder of the option `results`.
"""

import datetime
import importlib
import itertools
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from surgsim_apps.scoring.comparison import compare, describe
from surgsim_apps.scoring.episodes import (
    Actor,
    AgentActor,
    EpisodeActor,
    TaskRecord,
    check_agent,
    episode_facts,
    equal_members,
    estimates_itself,
    make_envs,
    play_scripts,
    play_sites,
    play_tasks,
    sees_truth,
    site_success,
    task_columns,
)
from surgsim_apps.scoring.expert_retract import RetractExpert
from surgsim_apps.scoring.figures import EVALUATION_SEEDS, PalpationRecord, episode_columns, press_errors, score
from surgsim_apps.scoring.options import ScoringOptions
from surgsim_apps.scoring.results import (
    SITES,
    SLIDE,
    Result,
    load_result,
    seeds_text,
    shipped_results,
)
from surgsim_apps.scoring.site_search import AGENTS, RASTER_SIDES, REFERENCES
from surgsim_apps.scoring.submission import files_digest, module_digest, submission_seeds
from surgsim_apps.training.site_agent import site_facts
from surgsim_apps.training.slide_agents import SLIDES
from surgsim_env.scene import PHYSICS_VERSION, agents_folder, list_scenes, make_scene
from surgsim_env.step_progress import StepProgress
from surgsim_env.tasks import SlideTask

# Seed of the bootstrap.
BOOTSTRAP_SEED = 0
# Default scene and level of an evaluation.
PLACES = {"scene": "phantom", "level": "standard"}
SLIDE_PLACES = {"scene": SlideTask.setup.scene, "level": str(SlideTask.setup.level)}
# Arguments of SurgSim/Palpate-v0 for observations independent of an organ's size and pose.
IN_FACE = {"memory": True, "frame": "face"}
# Default split of a family of organs.
SCORED_SPLIT = "test"


@dataclass(frozen=True)
class Player:
    """A method with its environment.

    Args:
        name: of the method.
        actor: gives the actions; None: the oracle's script.
        env_id, kwargs: the environment.
        chosen_by: the option of `surgsim evaluate` that names it, and its value.
        sees_truth: True if it may see hidden truth.
        own_estimate: True if its own estimate is scored.
        ours: True if its result belongs in agents/results.
        digest: of its files, if it is submitted.
    """

    name: str
    actor: Actor | EpisodeActor | None
    env_id: str
    kwargs: dict[str, Any]
    chosen_by: tuple[str, str]
    sees_truth: bool = False
    own_estimate: bool = False
    ours: bool = True
    digest: str = ""


@dataclass(frozen=True)
class TaskAgent:
    """A script for another environment than SurgSim/PalpateSites-v0.

    Args:
        env_id: the environment's.
        make: the script, for the environment's arguments.
        kwargs: further arguments of the environment.
        sees_truth: True if it sees hidden truth.
    """

    env_id: str
    make: Callable[[dict[str, Any]], Actor | EpisodeActor]
    kwargs: dict[str, Any] = field(default_factory=dict)
    sees_truth: bool = False


def _slide(make: Callable[[], Any], *, sees: bool = False) -> TaskAgent:
    """An agent of SurgSim/Slide-v0 that observes the map of the pressable sites."""
    return TaskAgent(
        SLIDE,
        lambda kwargs: AgentActor(make, lambda env: episode_facts(env, SLIDE, kwargs)),
        {"face": True},
        sees,
    )


def _slide_learned() -> Any:
    # It needs torch.
    from surgsim_apps.training.slide_network import SlideLearned

    return SlideLearned()


def _organ_expert(*, blind: bool) -> Actor:
    # It needs torch.
    from surgsim_apps.scoring.expert_organs import OrganExpert

    return OrganExpert(blind=blind).act


TASK_AGENTS = {
    "expert_retract": TaskAgent("SurgSim/Retract-v0", lambda kwargs: RetractExpert().act_all, {"scaled": False}),
    "expert_organs": TaskAgent("SurgSim/Palpate-v0", lambda kwargs: _organ_expert(blind=False), IN_FACE),
    **{name: _slide(make, sees=sees_truth(make())) for name, make in SLIDES.items()},
    "slide_learned": _slide(_slide_learned),
    "blind_middle": TaskAgent("SurgSim/Palpate-v0", lambda kwargs: _organ_expert(blind=True), IN_FACE),
}
# Oracles that play a script, by environment.
ORACLES = {
    "oracle_palpate": "SurgSim/Palpate-v0",
    "oracle_retract": "SurgSim/Retract-v0",
    "oracle_bimanual_retract": "SurgSim/BimanualRetract-v0",
}


def policies_folder() -> Path:
    """The folder of the shipped policies."""
    return agents_folder() / "policies"


def named_class(text: str, option: str) -> Any:
    """The class, or other constructor of agents, of MODULE:CLASS; the module may lie in the working folder.

    Importing the module runs its code.

    Args:
        text: MODULE:CLASS.
        option: its option, for messages.

    Raises:
        ValueError: another text, or no such module or class.
    """
    module, _, name = text.partition(":")
    if not (module and name):
        raise ValueError(f"{option} is {text!r}; the rule is MODULE:CLASS")
    # `surgsim` is a script of an environment: Python looks for modules beside it, not in the working folder.
    if not {"", str(Path.cwd())} & set(sys.path):
        sys.path.insert(0, str(Path.cwd()))
    try:
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise ValueError(f"{option} {text}: there is no module {error.name!r} on Python's path") from None
    if not callable(getattr(imported, name, None)):
        raise ValueError(f"{option} {text}: {module} has no class {name!r}")
    return getattr(imported, name)


def strangers_actor(text: str, option: str, env_id: str, env_kwargs: dict[str, Any]) -> AgentActor:
    """The actor of the agents of MODULE:CLASS.

    Args:
        text: MODULE:CLASS.
        option: its option, for messages.
        env_id: of its environment.
        env_kwargs: of its environment.

    Raises:
        ValueError: of `named_class` and `check_agent`, or a class that needs arguments.
    """
    make = named_class(text, option)
    try:
        agent = make()
    except TypeError as error:
        raise ValueError(f"{option} {text}: it is made without arguments, and that failed: {error}") from None
    check_agent(agent, f"{option} {text}: it")
    return AgentActor(make, site_facts if env_id == SITES else lambda env: episode_facts(env, env_id, env_kwargs))


def evaluate_all(options: ScoringOptions, console: Console) -> None:
    """Evaluate every baseline on the scene and level of the options, then every shipped policy for that scene."""
    from surgsim_apps.training.policy_files import read_description

    places = _places(options, PLACES)
    options = replace(options, **places)
    # The widest raster that the presses of an episode complete, and the three next.
    widest = math.isqrt(options.budget or gym.make(SITES, **places).unwrapped.task.budget)  # type: ignore[attr-defined]
    skipped = {f"raster_{side}" for side in RASTER_SIDES if not widest - 3 <= side <= widest}
    for name in AGENTS:
        if name not in skipped:
            evaluate(find_player(name, options), options, console)
    for path in sorted(policies_folder().glob("*.json")):
        description = read_description(path)
        if description.plays_every_scene or description.home_scene == Path(places["scene"]).stem:
            evaluate(policy_player(path, options), options, console)


def find_player(name: str, options: ScoringOptions) -> Player:
    """The player of a name: a site search, a script of another environment, an oracle, or MODULE:CLASS.

    Raises:
        ValueError: an unknown name or class.
    """
    chosen_by = ("--agent", name)
    if ":" in name:
        return _strangers_player(name, options)
    if name in ORACLES:
        env_id = ORACLES[name]
        return Player(name, None, env_id, _places(options, _defaults(env_id)), chosen_by, sees_truth=True)
    if name in TASK_AGENTS:
        script = TASK_AGENTS[name]
        kwargs = _places(options, _defaults(script.env_id)) | script.kwargs
        return Player(name, script.make(kwargs), script.env_id, kwargs, chosen_by, script.sees_truth)
    if name not in AGENTS:
        raise ValueError(f"agent {name!r} is unknown; the agents are {', '.join([*AGENTS, *TASK_AGENTS, *ORACLES])}")
    make, kwargs = AGENTS[name], _places(options, PLACES)
    if name in REFERENCES:
        # Their estimates do not depend on the presses.
        kwargs["budget"] = 1
    return Player(name, AgentActor(make), SITES, kwargs, chosen_by, *_declared(make()))


def _strangers_player(name: str, options: ScoringOptions) -> Player:
    env_id = options.env or SITES
    for argument in (*PLACES, "split", "motion", "instrument", "budget"):
        if argument in options.env_kwargs and getattr(options, argument) is not None:
            raise ValueError(f"{argument} is given by --{argument} and in --env-arguments: leave one out")
    own = {**(_defaults(env_id) if env_id in (SITES, SLIDE) else {}), **options.env_kwargs}
    # A split in --env-arguments precedes the default one.
    kwargs = {**_places(options, own), **options.env_kwargs}
    all_kwargs = kwargs if options.motion is None else {**kwargs, "motion": options.motion}
    actor = strangers_actor(name, "--agent", env_id, all_kwargs)
    declared = _declared(actor.make())
    digest = _agent_digest(name, actor.make) if options.submit else ""
    return Player(name.replace(":", "."), actor, env_id, kwargs, ("--agent", name), *declared, False, digest)


def _agent_digest(text: str, make: Any) -> str:
    """Digest of the module of MODULE:CLASS; refuses a class that another module or package defines."""
    module, owner = text.partition(":")[0], str(getattr(make, "__module__", None))
    if module.partition(".")[0] != owner.partition(".")[0]:
        raise ValueError(f"--agent {text}: the class is of the module {owner}, which must be named for --submit")
    return module_digest(module)


def _defaults(env_id: str) -> dict[str, str]:
    """Default scene and level; none for an environment without levels."""
    return SLIDE_PLACES if env_id == SLIDE else PLACES if "Palpate" in env_id else {}


def _declared(agent: Any) -> tuple[bool, bool]:
    """`sees_truth` and `own_estimate` of a `Player`."""
    return sees_truth(agent), estimates_itself(agent)


def _places(options: ScoringOptions, defaults: dict[str, str]) -> dict[str, Any]:
    """Scene, level and split of the options, else of the defaults; missing ones are the environment's own.

    A family of organs is scored on its test split unless the options name another, even for a method trained on its
    training split.
    """
    chosen = {name: getattr(options, name) for name in PLACES if getattr(options, name) is not None}
    places = {name: value for name, value in {**defaults, **chosen}.items() if name in PLACES}
    is_family = places.get("scene") is not None and make_scene(places["scene"]).family is not None
    if options.split is not None or is_family:
        places["split"] = options.split or SCORED_SPLIT
    return places


def policy_player(path: Path, options: ScoringOptions) -> Player:
    """A trained policy on its own environment, with scene and level of the options.

    Args:
        path: of either of its files, or the name of a shipped policy.
        options: of the evaluation.

    Raises:
        ValueError: no such policy, or one for another scene.
    """
    from surgsim_apps.training.policy_files import load_policy

    shipped = policies_folder() / f"{path}.json"
    if shipped.is_file():
        path = shipped
    policy = load_policy(path)
    env_id = policy.description.env_id
    own = {**(PLACES if env_id == SITES else {}), **policy.description.env_kwargs}
    kwargs = {**{name: value for name, value in own.items() if name != "split"}, **_places(options, own)}
    policy.reset(min(options.envs, len(options.played_seeds)))
    ours, digest = path.resolve().parent == policies_folder(), ""
    if options.submit:
        suffixes = (".json",) if policy.description.network is None else (".json", ".safetensors")
        digest = files_digest({suffix: path.with_suffix(suffix) for suffix in suffixes})
    return Player(path.stem, policy, env_id, kwargs, ("--policy", _from_here(path)), ours=ours, digest=digest)


def _arguments(player: Player, options: ScoringOptions) -> dict[str, Any]:
    """Arguments of the environment, with those of the options.

    Raises:
        ValueError: an option that does not suit this player or its environment.
    """
    kwargs = dict(player.kwargs)
    if options.motion is not None:
        kwargs["motion"] = options.motion
    if options.instrument is not None:
        kwargs["instrument"] = options.instrument
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


def evaluate(player: Player, options: ScoringOptions, console: Console) -> Result:
    """Play the seeds of the options; print the result and write its file."""
    kwargs, env_id, actor = _arguments(player, options), player.env_id, player.actor
    suffixes = ("untracked" * options.no_tracking, Path(options.instrument or "").stem)
    name = "_".join([player.name, *filter(None, suffixes)])
    count = 1 if actor is None else min(options.envs, len(options.played_seeds))
    try:
        envs = make_envs(env_id, count, dtype=options.dtype, threads=options.threads, **kwargs)
    except (gym.error.Error, TypeError, ValueError) as error:
        raise ValueError(f"{name}: {env_id} with {kwargs} cannot be made: {error}") from error
    first = envs.unwrapped.envs[0].unwrapped  # type: ignore[attr-defined]
    if player.chosen_by[0] == "--policy":
        actor.check_environment(first, f"policy {name}")  # type: ignore[union-attr]
    seeds = _seeds(player, options, first)
    start = time.perf_counter()
    with StepProgress(console) as shown, shown.step(f"{name}, {len(seeds)} episodes", total=len(seeds)) as ended:
        if actor is not None and env_id == SITES:
            scored = _site_scores(play_sites(actor, envs, seeds, ended), first.task)
        elif actor is not None:
            scored = _task_scores(play_tasks(actor, envs, seeds, ended), first)
        else:
            single = gym.make(env_id, measure_tissue=True, **kwargs)
            records = play_scripts(single, seeds, tracks=not options.no_tracking, progress=ended)
            scored = _task_scores(records, first)
    wall_time = time.perf_counter() - start
    envs.close()
    result = Result(
        method=name,
        env_id=env_id,
        env_kwargs=_without_folders(kwargs),
        seeds=tuple(seeds),
        command=_command(player, options),
        wall_time=round(wall_time, 1),
        date=datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        physics_version=PHYSICS_VERSION,
        sees_truth=player.sees_truth,
        own_estimate=player.own_estimate,
        agent_digest=player.digest,
        **scored,
    )
    path = _write(result, player, options)
    values = {name: figure.value for name, figure in result.figures.items()}
    printed = (
        *("error_of_presses_mm", "presses_to_median", "error_mm", "success", "seconds"),
        *("force_peak", "pressure_peak", "strain_peak", "torn"),
    )
    figures = ", ".join(f"{name} {values[name]:.3g}" for name in printed if values.get(name) is not None)
    where = "not written (--results FOLDER does)" if path is None else f"-> {path}"
    kind = f"submission {player.digest[:12]}" if player.digest else "public seeds"
    _say(console, f"{result.place} {result.method}, {kind}: {figures}; {result.wall_time:.0f} s {where}")
    return result


def _seeds(player: Player, options: ScoringOptions, env: Any) -> tuple[int, ...]:
    """Seeds of the episodes, of a family as many of each member unless the options name them."""
    if options.seeds is not None:
        return options.played_seeds
    stream: Iterator[int] = itertools.count(EVALUATION_SEEDS.start)
    if options.submit:
        level = "" if env.task.level is None else env.task.level.name
        stream = submission_seeds(player.digest, player.env_id, env.scene.name, level)
    count, family = len(options.played_seeds), env.runtime.family
    return tuple(itertools.islice(stream, count) if family is None else equal_members(stream, count, family.size))


def _site_scores(presses: list[PalpationRecord], task: Any) -> dict[str, Any]:
    """Entries of a `Result` by episodes of presses."""
    succeeded = np.array([site_success(record, task) for record in presses], dtype=np.float64)
    errors = [np.round(1000.0 * press_errors(record, task.budget), 2).tolist() for record in presses]
    columns = {**episode_columns(presses, task.budget), "success": succeeded}
    members = [record.member for record in presses]
    return _scores(task.budget, columns, members, errors_mm=errors, lesion_counts=[len(each.truth) for each in presses])


def _task_scores(records: list[TaskRecord], env: Any) -> dict[str, Any]:
    """Entries of a `Result` by episodes of control steps."""
    columns = task_columns(records, env.scene.timing.control_step, env.scene.limits.soft_force)
    return _scores(env.task.episode_steps or 0, columns, [record.last.get("member", "") for record in records])


def _scores(budget: int, columns: dict[str, Any], members: list[str], **presses: Any) -> dict[str, Any]:
    members = members if any(members) else []
    return {
        "budget": budget,
        "figures": score(columns, members, np.random.default_rng(BOOTSTRAP_SEED), **presses),
        "episodes": {
            name: [None if math.isnan(value) else float(f"{value:.5g}") for value in values]
            for name, values in columns.items()
        },
        "members": members,
        **presses,
    }


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def _write(result: Result, player: Player, options: ScoringOptions) -> Path | None:
    """Write a result into the folder of the options, or a standard result of ours on our scenes into agents/results."""
    if options.results is not None:
        return result.save(options.results)
    own_place = result.env_kwargs.get("scene") in (None, *list_scenes())
    if player.ours and options.standard and own_place and _checkout() is not None:
        return result.save(shipped_results())
    return None


def print_comparison(paths: tuple[Path, Path], console: Console) -> None:
    """Print the differences of two results."""
    first, second = map(load_result, paths)
    _say(
        console,
        f"{first.place}, seeds {seeds_text(first.seeds)}: differences with 95 % intervals of a paired bootstrap",
    )
    for difference in compare(first, second, np.random.default_rng(BOOTSTRAP_SEED)):
        _say(console, describe(difference, first.method, second.method))


def _command(player: Player, options: ScoringOptions) -> str:
    """The command that repeats a result: the method, and the options with an effect on its figures."""
    words = ["surgsim", "evaluate", *player.chosen_by]
    for option in fields(options):
        value = getattr(options, option.name)
        if option.name in ("envs", "threads", "results") or value == option.default:
            continue
        words.append(f"--{option.name.replace('_', '-')}")
        if value is not True:
            words.append(_from_here(Path(value)) if Path(str(value)).is_absolute() else str(value))
    return shlex.join(words)


def _without_folders(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Arguments with paths of `_from_here`."""
    return {
        name: _from_here(Path(value)) if isinstance(value, str) and Path(value).is_absolute() else value
        for name, value in kwargs.items()
    }


def _from_here(path: Path) -> str:
    """The path relative to the checkout, else the file's name: results hold no folders of a machine."""
    absolute, checkout = path.resolve(), _checkout()
    inside = checkout is not None and absolute.is_relative_to(checkout)
    return absolute.relative_to(checkout).as_posix() if inside else path.name  # type: ignore[arg-type]


def _checkout() -> Path | None:
    """The folder of this package's checkout; None for an installed package."""
    folder = agents_folder().parent
    return folder if (folder / "pyproject.toml").is_file() else None
