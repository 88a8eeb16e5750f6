"""Draw learning curves: the share of successful evaluation episodes over control steps, one line for each run.

    python -m agents.learning_curves agents/curves/palpate_phantom_small_scratch_seed*.csv --action-repeat 5 \\
        --out docs/images/learning_from_scratch.png

A curve is `evaluations.csv` of a run's folder, whose steps are decisions.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

from agents.command_line import one_line_errors

# Colours that people with any colour vision tell apart (Okabe & Ito 2008).
LINE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#000000")


def read_curve(file: Path, action_repeat: int) -> tuple[list[float], list[float]]:
    """Control steps in millions, and success in percent, of each evaluation in a file.

    Raises:
        ValueError: a file that cannot be read, or has no columns `steps` and `success`.
    """
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        return (
            [float(row["steps"]) * action_repeat / 1e6 for row in rows],
            [100.0 * float(row["success"]) for row in rows],
        )
    except OSError as error:
        raise ValueError(f"curve {file} cannot be read: {error.strerror}") from None
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"curve {file} needs columns steps and success of numbers, as evaluations.csv has") from None


def draw_curves(files: Sequence[Path], action_repeat: int, out: Path) -> None:
    """Draw the curves of some runs into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for number, file in enumerate(files):
        steps, success = read_curve(file, action_repeat)
        axes.plot(steps, success, "o-", label=file.stem, color=LINE_COLOURS[number % len(LINE_COLOURS)], markersize=4)
    axes.axhline(80.0, color="black", linewidth=0.8, linestyle="--")
    axes.set_xlabel("control steps [millions]")
    axes.set_ylabel("success [%]")
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("curves", type=Path, nargs="+", help="evaluations.csv of runs")
    parser.add_argument("--action-repeat", type=int, default=1, help="control steps of a decision")
    parser.add_argument("--out", type=Path, required=True, help="the picture, a PNG")
    given = parser.parse_args()
    draw_curves(given.curves, given.action_repeat, given.out)


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
