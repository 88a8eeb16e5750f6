"""report.html: what an evaluation of two arms found, in one file that any browser shows, prints and reads aloud."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from surgsim_env.evaluation.arm_maps import Picture
from surgsim_env.evaluation.arm_quantities import (
    DISTANCES,
    QUANTITIES,
    SHARE_DEFINITIONS,
    Quantity,
    median,
    number_text,
    share_text,
    sides,
    values_of,
    verdict,
    worse_of_both,
)
from surgsim_env.evaluation.arm_results import REASONS, ArmsEvaluation
from surgsim_env.evaluation.arm_table import RANKING_RULE, Ranked, columns
from surgsim_env.evaluation.episode_figures import FIGURES, Episodes, clause, median_of, what_was_run
from surgsim_env.html_page import POLICY as POLICY
from surgsim_env.html_page import html_page


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
        path: of the file; pictures and maps lie beside it, and are copied into it.
        pictures: of the arms in the patient.
        maps: heat maps.
        command: that makes this report.
        ranking: of several placements or robots; left out if there is none.
        episodes: run by a script; left out if there are none.
        episode_pictures: of how they ended.
    """
    said = " ".join(filter(None, (verdict(evaluation), clause(episodes, evaluation.scene))))
    title = f"Two arms on {evaluation.scene}: {evaluation.left.name} (left) and {evaluation.right.name} (right)"
    ends = _figures(path.parent, episode_pictures)
    sections = [
        ("ranking", "Ranking", _ranking(ranking)) if ranking else None,
        ("patient", "The arms in the patient", _figures(path.parent, pictures)),
        ("maps", "Maps on the organ", _legend(evaluation) + _figures(path.parent, maps)),
        ("numbers", "Numbers", _shares(evaluation) + _values(evaluation) + _pair(evaluation) + _reasons(evaluation)),
        ("episodes", "Scripted episodes", _episodes(episodes, evaluation.scene, ends)) if episodes else None,
        ("definitions", "What each figure means", _definitions()),
        ("columns", "Columns of points.csv", _columns(evaluation)),
        ("inputs", "Inputs, versions, seed", _inputs(evaluation.summary)),
        ("command", "The command that made this report", f"<pre><code>{escape(command)}</code></pre>"),
    ]
    shown = [section for section in sections if section is not None and section[2]]
    path.write_text(html_page(title, said, shown), encoding="utf-8", newline="\n")


def _figures(folder: Path, files: Sequence[Picture]) -> str:
    figures = []
    for one in files:
        data = base64.b64encode((folder / one.name).read_bytes()).decode("ascii")
        figures.append(
            f'<figure>\n<img src="data:image/png;base64,{data}" alt="{escape(f"{one.title}. {one.description}")}">\n'
            f"<figcaption><b>{escape(one.title)}</b> {escape(one.description)} "
            f"<code>{escape(one.name)}</code></figcaption>\n</figure>"
        )
    return "\n".join(figures)


def _legend(evaluation: ArmsEvaluation) -> str:
    ports = (
        " L, R and E in discs are the ports of the left arm, the right arm and the endoscope; dashed lines are the "
        "ways into the body."
        if evaluation.ports
        else ""
    )
    inner = " Diamonds are targets inside the organ." if evaluation.inner.any() else ""
    return (
        "<p>Each map shows the organ as the endoscope sees it, and from behind if points were tried there. Dots are "
        "the points that were tried; between them the colours are interpolated. Grey was not reached; on the palest "
        f"parts no points were tried.{inner}{escape(ports)}</p>\n"
    )


def _table(caption: str, head: str, rows: Iterable[str]) -> str:
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(caption)}"><table>\n'
        f"<caption>{escape(caption)}</caption>\n<thead>{head}</thead>\n<tbody>\n" + "\n".join(rows) + "\n</tbody>\n"
        "</table></div>\n"
    )


def _heads(*names: str, numbers_from: int = 1) -> str:
    cells = (
        f'<th scope="col"{" class=number" if index >= numbers_from else ""}>{escape(name)}</th>'
        for index, name in enumerate(names)
    )
    return f"<tr>{''.join(cells)}</tr>"


def _row(head: str, *cells: str, text: bool = False) -> str:
    kind = "<td>" if text else '<td class="number">'
    return (
        f'<tr><th scope="row">{escape(head)}</th>' + "".join(f"{kind}{escape(cell)}</td>" for cell in cells) + "</tr>"
    )


def _shares(evaluation: ArmsEvaluation) -> str:
    groups = [("on the surface", ~evaluation.inner), ("inside the organ", evaluation.inner)]
    masks = [evaluation.left.reachable, evaluation.right.reachable, evaluation.both]
    rows = [
        _row(f"{name} ({int(group.sum())} points)", *(share_text(mask[group]) for mask in masks))
        for name, group in groups
        if group.any()
    ]
    return _table("Share of points reachable", _heads("points", "left arm", "right arm", "both at once"), rows)


def _values(evaluation: ArmsEvaluation) -> str:
    """Least, median and greatest of each quantity for each arm, and for the worse arm where both reach at once."""
    groups = ("left arm", "right arm", "both at once, the worse arm")
    top = "".join(f'<th scope="colgroup" colspan="3" class="group">{name}</th>' for name in groups)
    names = '<th scope="col" class="number group">least</th><th scope="col" class="number">median</th>'
    names += '<th scope="col" class="number">greatest</th>'
    head = f'<tr><th scope="col" rowspan="2">figure</th>{top}</tr><tr>{names * 3}</tr>'
    rows = []
    for quantity in QUANTITIES:
        kinds = [values_of(arm, quantity) for _, arm in sides(evaluation)]
        kinds.append(worse_of_both(evaluation, quantity))
        cells = "".join(_spread_cells(values, quantity) for values in kinds)
        rows.append(f'<tr><th scope="row">{escape(quantity.label)}</th>{cells}</tr>')
    return _table("Figures over the points that are reached", head, rows)


def _spread_cells(values: np.ndarray, quantity: Quantity) -> str:
    known = values[np.isfinite(values)]
    least, most = (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)
    shown = (quantity.text(value, with_unit=False) for value in (least, median(values), most))
    kinds = ("number group", "number", "number")
    return "".join(f'<td class="{kind}">{text}</td>' for kind, text in zip(kinds, shown, strict=True))


def _pair(evaluation: ArmsEvaluation) -> str:
    rows = []
    for field, title, _ in DISTANCES:
        values = getattr(evaluation, field)
        known = values[np.isfinite(values)]
        least, most = (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)
        rows.append(_row(title, *(number_text(value, 1e3, 1) for value in (least, median(values), most))))
    return _table("Between the two arms, in mm", _heads("figure", "least", "median", "greatest"), rows)


def _reasons(evaluation: ArmsEvaluation) -> str:
    rows = []
    for index, reason in enumerate(REASONS):
        masks = [arm.reason == index for _, arm in sides(evaluation)]
        rows.append(_row(reason, *(f"{int(mask.sum())} ({share_text(mask)})" for mask in masks)))
    return _table("Why points are not reached", _heads("first obstacle", "left arm, points", "right arm, points"), rows)


def _ranking(ranking: Sequence[Ranked]) -> str:
    head = (
        '<tr><th scope="col">place</th><th scope="col">placement or robot</th><th scope="col" class="number">both</th>'
        '<th scope="col" class="number">left</th><th scope="col" class="number">right</th>'
        '<th scope="col" class="number">either</th><th scope="col" class="number">median clearance [mm]</th>'
        '<th scope="col" class="number">worst clearance [mm]</th>'
        '<th scope="col" class="number">smallest tip force [N]</th><th scope="col">reasons</th></tr>'
    )
    rows = []
    for one in ranking:
        shares = "".join(
            f'<td class="number">{100.0 * share:.0f} %</td>' for share in (one.both, one.left, one.right, one.either)
        )
        rows.append(
            f'<tr><td>{one.place}</td><th scope="row">{escape(one.name)}<br><small>{escape(one.what)}</small></th>'
            f"{shares}"
            f'<td class="number">{number_text(one.clearance, 1e3, 1)}</td>'
            f'<td class="number">{number_text(one.worst_clearance, 1e3, 1)}</td>'
            f'<td class="number">{number_text(one.force, 1.0, 2)}</td><td class="wide">{escape(one.reasons)}</td></tr>'
        )
    caption = "Placements and robots, the best first"
    return (
        f"<p>{escape(RANKING_RULE)} All else in this report is about the arms and ports of the command itself.</p>\n"
        + (_table(caption, head, rows))
    )


def _episodes(episodes: Episodes, organ: str, ends: str) -> str:
    """What was run, a row an episode, the medians, and what the columns mean."""
    text = "".join(f"<p>{escape(said)}</p>\n" for said in what_was_run(episodes, organ))
    if not episodes.runs:
        return text
    failed = not all(one.success for one in episodes.runs)
    rows = []
    for one in episodes.runs:
        figures = [figure.text(getattr(one, figure.field)) for figure in FIGURES]
        rows.append(
            _episode_row(str(one.seed), "yes" if one.success else "no", figures, one.reason if failed else None)
        )
    count = f"{sum(one.success for one in episodes.runs)} of {len(episodes.runs)}"
    medians = [figure.text(median_of(episodes.runs, figure)) for figure in FIGURES]
    rows.append(_episode_row("medians", count, medians, "" if failed else None, kind=' class="total"'))
    numbers = "".join(f'<th scope="col" class="number">{escape(figure.title)}</th>' for figure in FIGURES)
    head = f'<tr><th scope="col">seed</th><th scope="col">success</th>{numbers}'
    head += '<th scope="col">why it failed</th></tr>' if failed else "</tr>"
    items = [f"<dt>{escape(one.title)}</dt><dd>{escape(one.definition)}</dd>" for one in FIGURES]
    return (
        text
        + _table("Episodes; the last row has how many succeeded and the medians of what was measured", head, rows)
        + ends
        + "\n<dl>\n"
        + "\n".join(items)
        + "\n</dl>"
    )


def _episode_row(seed: str, success: str, figures: Iterable[str], reason: str | None, *, kind: str = "") -> str:
    cells = "".join(f'<td class="number">{escape(text)}</td>' for text in figures)
    why = "" if reason is None else f'<td class="wide">{escape(reason)}</td>'
    return f'<tr{kind}><th scope="row">{escape(seed)}</th><td>{escape(success)}</td>{cells}{why}</tr>'


def _definitions() -> str:
    items = [("reachable", SHARE_DEFINITIONS[0][1]), ("both at once", SHARE_DEFINITIONS[1][1])]
    items += [(quantity.label, quantity.definition) for quantity in QUANTITIES]
    items += [(f"{title} [mm]", definition) for _, title, definition in DISTANCES]
    items.append(
        ("the worse arm", "At a point, the smaller of both arms' values where more is better, else the larger.")
    )
    return "<dl>\n" + "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in items) + "\n</dl>"


def _columns(evaluation: ArmsEvaluation) -> str:
    rows = [
        f'<tr><th scope="row"><code>{escape(one.name)}</code></th><td>{escape(one.meaning)}</td></tr>'
        for one in columns(evaluation)
    ]
    text = "<p>One line for each point, in SI units (m, N, rad); a cell is empty where there is no value.</p>\n"
    return text + _table("Columns", _heads("column", "meaning", numbers_from=2), rows)


def _inputs(summary: Mapping[str, Any]) -> str:
    tables = []
    for key, caption in (("inputs", "Inputs"), ("versions", "Versions")):
        rows = [
            f'<tr><th scope="row">{escape(name)}</th><td><code>{escape(value)}</code></td></tr>'
            for name, value in _flat(summary.get(key, {}))
        ]
        if rows:
            tables.append(_table(caption, _heads("what", "value", numbers_from=2), rows))
    seed = escape(str(summary.get("seed")))
    return f"<p>Seed: <code>{seed}</code>. Lengths of the inputs are metres, angles radians.</p>\n" + "".join(tables)


def _flat(value: Any, name: str = "") -> Iterable[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _flat(value[key], f"{name}, {key}" if name else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value, start=1):
            yield from _flat(item, f"{name} {number}")
    elif isinstance(value, list | tuple):
        yield name, ", ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in value) or "none"
    else:
        yield name, f"{value:g}" if isinstance(value, float) else str(value)
