"""Recorded presses of a ball on tissue, read from CSV files and checked.

A file is one set: one sample of tissue, one ball, sites pressed one after the other. Columns, in any order:

| column | unit | meaning |
|---|---|---|
| `site` | | whole number of the site; its samples stand in the order of the press |
| `depth_mm` | mm | travel of the ball along the surface normal since first contact |
| `normal_force_n` | N | force along the normal, positive in a press |
| `x_mm`, `y_mm`, `z_mm` | mm | optional, all three: place of the ball at first contact |
| `time_s` | s | optional: time of the sample, rising within a site |

Further columns are ignored.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdm_core.mesh import FloatArray
from msdm_core.mesh_files import checked_content

NEEDED = ("site", "depth_mm", "normal_force_n")
PLACE = ("x_mm", "y_mm", "z_mm")
TIME = "time_s"
# Beyond any press on tissue: a larger depth [mm] or force [N] is a wrong unit or a wrong column.
DEPTH_MOST, FORCE_MOST = 100.0, 1000.0
# Least share of the largest depth at full depth: robots hold a depth with noise.
FULL_DEPTH = 0.99


@dataclass(frozen=True, eq=False)
class SitePress:
    """Samples of a press, in their order.

    Fields:
        site: its number in the file
        place: of the ball at first contact [m], (3,); not finite if not in the file
        depth: travel along the normal since first contact [m], (n_sample,)
        force: along the normal [N], (n_sample,)
        time: [s], (n_sample,), or None
    """

    site: int
    place: FloatArray
    depth: FloatArray
    force: FloatArray
    time: FloatArray | None = None

    @property
    def loading(self) -> slice:
        """Samples up to the first at full depth, before the hold and the withdrawal."""
        return slice(0, int(np.argmax(self.depth >= FULL_DEPTH * self.depth.max())) + 1)


@dataclass(frozen=True, eq=False)
class Recording:
    """Set of recorded presses: its name and the press of each site."""

    name: str
    presses: tuple[SitePress, ...]

    @property
    def has_places(self) -> bool:
        """True if all sites have a place."""
        return all(np.isfinite(press.place).all() for press in self.presses)


def read_recording(path: Path) -> Recording:
    """Read a set from a CSV file with the columns of this module.

    Raises:
        ValueError: an unreadable file; a column or a number that is missing, wrong or beyond any press, with file,
            line, column, value and rule.
    """
    checked_content(path)
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream)
            header = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except OSError as error:
        raise ValueError(f"recording {path} cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"recording {path} is no CSV text: {error}") from None
    columns = _columns(path, header)
    if not rows:
        raise ValueError(f"recording {path} has no samples: give at least one line after the header")
    samples: dict[int, list[list[float]]] = {}
    for line, row in rows:
        numbers = [_number(path, line, name, row, place) for name, place in columns.items()]
        samples.setdefault(_site(path, line, numbers[0]), []).append(numbers[1:])
    names = list(columns)[1:]
    return Recording(path.stem, tuple(_press(path, site, names, rows) for site, rows in samples.items()))


def _columns(path: Path, header: Sequence[str]) -> dict[str, int]:
    """Places of the known columns, `site` first."""
    for name in NEEDED:
        if name not in header:
            raise ValueError(
                f"recording {path} has no column {name!r}; the needed ones are {', '.join(NEEDED)}, and it has "
                f"{', '.join(header) or 'none'}"
            )
    places = [name for name in PLACE if name in header]
    if places and len(places) < len(PLACE):
        raise ValueError(f"recording {path} has {', '.join(places)} of {', '.join(PLACE)}: give all three or none")
    known = (*NEEDED, *places, *([TIME] if TIME in header else []))
    return {name: header.index(name) for name in known}


def _number(path: Path, line: int, name: str, row: Sequence[str], place: int) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    most = {"depth_mm": DEPTH_MOST, "normal_force_n": FORCE_MOST}.get(name, math.inf)
    if not math.isfinite(number) or abs(number) > most:
        rule = "a finite number" + (f" of at most {most:g} in size" if most < math.inf else "")
        raise ValueError(f"recording {path}, line {line}: {name} is {text!r}; the rule is {rule}")
    return number


def _site(path: Path, line: int, number: float) -> int:
    if number != math.floor(number):
        raise ValueError(f"recording {path}, line {line}: site is {number:g}; the rule is a whole number")
    return int(number)


def _press(path: Path, site: int, names: Sequence[str], samples: Sequence[Sequence[float]]) -> SitePress:
    table: Mapping[str, FloatArray] = dict(zip(names, np.array(samples, dtype=np.float64).T))
    time = table.get(TIME)
    if time is not None and not (np.diff(time) > 0.0).all():
        first = int(np.argmin(np.diff(time) > 0.0)) + 1
        raise ValueError(
            f"recording {path}, site {site}: {TIME} is {time[first]:g} after {time[first - 1]:g}; the rule is that "
            "times rise within a site"
        )
    place = np.array([1e-3 * table[name][0] if name in table else math.nan for name in PLACE])
    return SitePress(site, place, 1e-3 * table["depth_mm"], table["normal_force_n"], time)
