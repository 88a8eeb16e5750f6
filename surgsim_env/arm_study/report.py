"""report.html: what an evaluation of two arms found, in one file that any browser shows, prints and reads aloud."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from surgsim_env.arm_study.episodes import MEASURES, Episodes, clause, median_of, what_was_run
from surgsim_env.arm_study.results import (
    DISTANCES,
    QUANTITIES,
    REASONS,
    SHARE_DEFINITIONS,
    ArmsEvaluation,
    number_text,
    share_text,
    sides,
    spread,
    values_of,
    verdict,
    worse_of_both,
)
from surgsim_env.arm_study.table import RANKING_RULE, Ranked, columns
from surgsim_env.reports.html_page import Picture, render_page

Rows = list[tuple[str, ...]]


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
