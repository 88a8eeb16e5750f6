"""A study of two arms on an organ: setups evaluated and ranked, episodes run, report and data files written."""

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from surgsim_env.arm_study.episodes import Episodes, clause, plain_episodes, run_episodes
from surgsim_env.arm_study.maps import ArmMaps
from surgsim_env.arm_study.pictures import write_given_pictures, write_pictures
from surgsim_env.arm_study.ports import Ports
from surgsim_env.arm_study.report import write_report
from surgsim_env.arm_study.results import ArmsEvaluation, extreme, number_text, verdict, worst_clearance
from surgsim_env.arm_study.study import evaluate_arms
from surgsim_env.arm_study.table import Candidate, Ranked, rank, write_points
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.palpation.report import package_version, plain_json
from surgsim_env.reports.html_page import Picture
from surgsim_env.scene.anatomy import Anatomy

REPORT_NAME, POINTS_NAME, SUMMARY_NAME = "report.html", "points.csv", "summary.json"


@dataclass(frozen=True)
class ArmSetup:
    """Two arms at their ports.

    Fields:
        name, what: as a ranking shows them
        left, right: the arms, placed
        ports: theirs and the endoscope's
    """

    name: str
    what: str
    left: Arm
    right: Arm
    ports: Ports


@dataclass(frozen=True)
class StudyPlan:
    """How a study is run.

    Fields:
        points: number of points of the organ to be tried
        seed: of the points, of the searches for joints, and of the first episode
        episodes: number of episodes of the oracle script
        instruments: the first setup's left and right arm, each a name or a TOML file, for the episodes
        inputs: what the arms, ports and scene were read from, for the summary
        command: the command line, for the report
    """

    points: int
    seed: int
    episodes: int
    instruments: tuple[str, str]
    inputs: Mapping[str, Any]
    command: str


def run_study(
    setups: Sequence[ArmSetup], anatomy: Anatomy, plan: StudyPlan, folder: Path, console: Console
) -> ArmsEvaluation:
    """Evaluate the setups, rank them if there are several, and write report, points, heat maps, pictures and summary.

    Args:
        setups: the one that is reported first, then those it is compared with.
        anatomy: of the organ.
        plan: how it is run.
        folder: for the files.
        console: for progress and results.

    Returns:
        The evaluation of the first setup.
    """
    found = [evaluate(setup, anatomy, plan, console, pictures=number == 0) for number, setup in enumerate(setups)]
    first = found[0]
    ranking = rank([Candidate(s.name, s.what, one) for s, one in zip(setups, found, strict=True)]) if found[1:] else []
    episodes = scripted_episodes(setups[0], plan, console) if plan.episodes else None
    said = " ".join(filter(None, (verdict(first), clause(episodes, first.scene))))
    summary = {**_summary(first, plan, ranking), **plain_json(plain_episodes(episodes), digits=12), "verdict": said}
    first = replace(first, summary=summary)
    (folder / SUMMARY_NAME).write_text(
        json.dumps(summary, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    write_points(first, folder / POINTS_NAME)
    pictures = write_pictures(first, (setups[0].left, setups[0].right), folder)
    ends = _write_ends(episodes, folder)
    maps = ArmMaps(first).write_all(folder)
    write_report(
        first,
        folder / REPORT_NAME,
        pictures=pictures,
        maps=maps,
        command=plan.command,
        ranking=ranking,
        episodes=episodes,
        episode_pictures=ends,
    )
    console.print(said, highlight=False)
    if ranking:
        _print_ranking(ranking, console)
    names = ",".join((REPORT_NAME, POINTS_NAME, SUMMARY_NAME, *(one.name for one in (*pictures, *maps, *ends))))
    console.print(f"written: {folder}/{{{names}}}", highlight=False, soft_wrap=True)
    return first


def evaluate(setup: ArmSetup, anatomy: Anatomy, plan: StudyPlan, console: Console, *, pictures: bool) -> ArmsEvaluation:
    """One setup on the organ, with a progress bar."""
    left, right = setup.left.description, setup.right.description
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task(setup.name, total=1.0)

        def tell(what: str, share: float) -> None:
            bar.update(task, description=f"{setup.name}: {what}", completed=share)

        return evaluate_arms(
            anatomy, left, right, setup.ports, seed=plan.seed, count=plan.points, progress=tell, pictures=pictures
        )


def scripted_episodes(setup: ArmSetup, plan: StudyPlan, console: Console) -> Episodes:
    """Episodes of the oracle script with a setup's arms, with a progress bar."""
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task("episodes", total=1.0)
        return run_episodes(
            plan.instruments,
            (setup.left, setup.right),
            range(plan.seed, plan.seed + plan.episodes),
            lambda what, share: bar.update(task, description=what, completed=share),
        )


def _write_ends(episodes: Episodes | None, folder: Path) -> list[Picture]:
    """Pictures of the last step of episodes."""
    shown = "Drawn with OpenGL: the lobe and both arms in the overview and through the endoscope; "
    shown += "the target is green, arrows are the tissue's force on each tool."
    given = {} if episodes is None else episodes.pictures
    written = write_given_pictures(given, folder, name="episode")
    return [replace(one, description=shown) for one in written]


def _summary(evaluation: ArmsEvaluation, plan: StudyPlan, ranking: Sequence[Ranked]) -> dict[str, Any]:
    """The evaluation's own summary, completed by inputs, versions, extremes and the ranking."""
    clearance, what = worst_clearance(evaluation)
    force = extreme(evaluation, "tip_force")
    versions = {
        "surgsim": package_version(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "scipy", "mujoco", "matplotlib")},
    }
    given = dict(evaluation.summary)
    return plain_json(
        {
            **given,
            "versions": {**_table(given, "versions"), **versions},
            "inputs": {
                **_table(given, "inputs"),
                "points": plan.points,
                "episodes": plan.episodes,
                **plan.inputs,
            },
            "seed": plan.seed,
            "worst_clearance": {
                "value_m": clearance.value,
                "arm": clearance.side,
                "from": what,
                "point": clearance.point,
            },
            "smallest_tip_force": {"value_N": force.value, "arm": force.side, "point": force.point},
            "compared": [vars(one) for one in ranking],
        },
        digits=12,
    )


def _table(summary: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = summary.get(name)
    return value if isinstance(value, Mapping) else {}


def _print_ranking(ranking: Sequence[Ranked], console: Console) -> None:
    for one in ranking:
        figures = (
            f"both {100.0 * one.both:.0f} %, median clearance {number_text(one.clearance, 1e3, 1, 'mm')}, "
            f"smallest tip force {number_text(one.force, 1.0, 2, 'N')}"
        )
        console.print(f"{one.place}. {one.name}: {figures}; {one.reasons}", highlight=False)
