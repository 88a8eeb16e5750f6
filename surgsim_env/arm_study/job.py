"""A study of two arms on an organ: setups evaluated and ranked, episodes run; its report, data files and pictures."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from surgsim_env.arm_study.episodes import (
    MEASURES,
    Episodes,
    clause,
    median_of,
    plain_episodes,
    run_episodes,
    what_was_run,
)
from surgsim_env.arm_study.pictures import ArmMaps, write_given_pictures, write_pictures
from surgsim_env.arm_study.ports import Ports
from surgsim_env.arm_study.results import (
    DISTANCES,
    QUANTITIES,
    RANKING_RULE,
    REASONS,
    SHARE_DEFINITIONS,
    ArmsEvaluation,
    Ranked,
    columns,
    extreme,
    number_text,
    rank,
    share_text,
    sides,
    spread,
    values_of,
    verdict,
    worse_of_both,
    worst_clearance,
    write_points,
)
from surgsim_env.arm_study.study import Progress as Tell
from surgsim_env.arm_study.study import evaluate_arms
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.palpation.job import plain_json
from surgsim_env.reports.html_page import Picture, render_page
from surgsim_env.scene.anatomy import Anatomy

REPORT_NAME, POINTS_NAME, SUMMARY_NAME = "report.html", "points.csv", "summary.json"
Rows = list[tuple[str, ...]]


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
    ranking = rank([(s.name, s.what, one) for s, one in zip(setups, found, strict=True)]) if found[1:] else []
    episodes = scripted_episodes(setups[0], plan, console) if plan.episodes else None
    said = " ".join(filter(None, (verdict(first), clause(episodes, first.scene))))
    summary = {**_summary(first, plan, ranking), **plain_json(plain_episodes(episodes), digits=12), "verdict": said}
    first = replace(first, summary=summary)
    (folder / SUMMARY_NAME).write_text(
        json.dumps(summary, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    write_points(first, folder / POINTS_NAME)
    pictures = write_pictures(first, (setups[0].left, setups[0].right), folder)
    shown = "Drawn with OpenGL: the lobe and both arms in the overview and through the endoscope; "
    shown += "the target is green, arrows are the tissue's force on each tool."
    written = write_given_pictures({} if episodes is None else episodes.pictures, folder, name="episode")
    ends = [replace(one, description=shown) for one in written]
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
    with _progress(setup.name, console) as tell:
        return evaluate_arms(
            anatomy,
            left,
            right,
            setup.ports,
            seed=plan.seed,
            count=plan.points,
            progress=lambda what, share: tell(f"{setup.name}: {what}", share),
            pictures=pictures,
        )


def scripted_episodes(setup: ArmSetup, plan: StudyPlan, console: Console) -> Episodes:
    """Episodes of the oracle script with a setup's arms, with a progress bar."""
    seeds = range(plan.seed, plan.seed + plan.episodes)
    with _progress("episodes", console) as tell:
        return run_episodes(plan.instruments, (setup.left, setup.right), seeds, tell)


@contextmanager
def _progress(name: str, console: Console) -> Iterator[Tell]:
    """A progress bar, and what tells it the current work and its share."""
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


def _summary(evaluation: ArmsEvaluation, plan: StudyPlan, ranking: Sequence[Ranked]) -> dict[str, Any]:
    """The evaluation's own summary, completed by inputs, extremes and the ranking."""
    clearance, what = worst_clearance(evaluation)
    force = extreme(evaluation, "tip_force")
    given = dict(evaluation.summary)
    return plain_json(
        {
            **given,
            "inputs": {**given.get("inputs", {}), "points": plan.points, "episodes": plan.episodes, **plan.inputs},
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


def _print_ranking(ranking: Sequence[Ranked], console: Console) -> None:
    for one in ranking:
        figures = (
            f"both {100.0 * one.both:.0f} %, median clearance {number_text(one.clearance, 1e3, 1, 'mm')}, "
            f"smallest tip force {number_text(one.force, 1.0, 2, 'N')}"
        )
        console.print(f"{one.place}. {one.name}: {figures}; {one.reasons}", highlight=False)


def write_report(
    evaluation: ArmsEvaluation,
    path: Path,
    *,
    pictures: Sequence[Picture],
    maps: Sequence[Picture],
    command: str,
    ranking: Sequence[Ranked] = (),
    episodes: Episodes | None = None,
    episode_pictures: Sequence[Picture] = (),
) -> None:
    """Write the report.

    Args:
        evaluation: what was found.
        path: of the file.
        pictures: of the arms in the patient.
        maps: heat maps.
        command: the command that makes this report.
        ranking: of several placements or robots; left out if there is none.
        episodes: run by a script; left out if there are none.
        episode_pictures: the ends of episodes.
    """
    summary = evaluation.summary
    page = render_page(
        "arms.html.j2",
        title=f"Two arms on {evaluation.scene}: {evaluation.left.name} (left) and {evaluation.right.name} (right)",
        verdict=" ".join(filter(None, (verdict(evaluation), clause(episodes, evaluation.scene)))),
        ranking=ranking,
        ranking_rule=RANKING_RULE,
        number_text=number_text,
        pictures=pictures,
        maps=maps,
        has_targets=evaluation.inner.any(),
        has_ports=bool(evaluation.ports),
        shares=_shares(evaluation),
        values=_values(evaluation),
        distances=[(title, *spread(getattr(evaluation, field)).texts(1e3, 1)) for field, title, _ in DISTANCES],
        reasons=_reasons(evaluation),
        episodes=episodes and _episodes(episodes, evaluation.scene, episode_pictures),
        definitions=_definitions(),
        columns=columns(evaluation),
        inputs=[(name.capitalize(), list(_flat(summary.get(name, {})))) for name in ("inputs", "versions")],
        seed=summary.get("seed"),
        command=command,
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def _shares(evaluation: ArmsEvaluation) -> Rows:
    """Shares of points that the left arm, the right arm and both at once reach."""
    groups = [("on the surface", ~evaluation.inner), ("inside the organ", evaluation.inner)]
    masks = [evaluation.left.reachable, evaluation.right.reachable, evaluation.both]
    return [
        (f"{name} ({int(group.sum())} points)", *(share_text(mask[group]) for mask in masks))
        for name, group in groups
        if group.any()
    ]


def _values(evaluation: ArmsEvaluation) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """Least, median and greatest of each quantity for each arm, and for the worse arm where both reach at once."""
    rows = []
    for quantity in QUANTITIES:
        groups = [values_of(arm, quantity) for _, arm in sides(evaluation)]
        groups.append(worse_of_both(evaluation, quantity))
        rows.append((quantity.label, [spread(values).texts(quantity.scale, quantity.digits) for values in groups]))
    return rows


def _reasons(evaluation: ArmsEvaluation) -> Rows:
    """Numbers and shares of points by their reason, for both arms."""
    rows = []
    for index, reason in enumerate(REASONS):
        masks = [arm.reason == index for _, arm in sides(evaluation)]
        rows.append((reason, *(f"{int(mask.sum())} ({share_text(mask)})" for mask in masks)))
    return rows


def _episodes(episodes: Episodes, organ: str, pictures: Sequence[Picture]) -> dict[str, Any]:
    """What was run; a row for each episode (seed, success, measures, reason) and one of medians; the definitions."""
    rows = [
        (str(one.seed), "yes" if one.success else "no", [measure.text_of(one) for measure in MEASURES], one.reason)
        for one in episodes.runs
    ]
    succeeded = sum(one.success for one in episodes.runs)
    if rows:
        medians = [measure.text(median_of(episodes.runs, measure)) for measure in MEASURES]
        rows.append(("medians", f"{succeeded} of {len(episodes.runs)}", medians, ""))
    return {
        "paragraphs": what_was_run(episodes, organ),
        "measures": MEASURES,
        "rows": rows,
        "failed": succeeded < len(episodes.runs),
        "pictures": pictures,
        "definitions": [(measure.title, measure.definition) for measure in MEASURES],
    }


def _definitions() -> list[tuple[str, str]]:
    """Names of all figures of an evaluation and what they mean."""
    return [
        ("reachable", SHARE_DEFINITIONS[0][1]),
        ("both at once", SHARE_DEFINITIONS[1][1]),
        *((quantity.label, quantity.definition) for quantity in QUANTITIES),
        *((f"{title} [mm]", definition) for _, title, definition in DISTANCES),
        ("the worse arm", "At a point, the smaller of both arms' values where more is better, else the larger."),
    ]


def _flat(value: Any, name: str = "") -> Iterable[tuple[str, str]]:
    """Nested tables and lists as rows of a name and a text."""
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _flat(value[key], f"{name}, {key}" if name else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value, start=1):
            yield from _flat(item, f"{name} {number}")
    elif isinstance(value, list | tuple):
        yield name, ", ".join(map(_text, value)) or "none"
    else:
        yield name, _text(value)


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
