"""Draw learning curves from agents/curves: python docs/make_curve_pictures.py, a second."""

import csv
from pathlib import Path

import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
CURVES, IMAGES = ROOT / "agents" / "curves", ROOT / "docs" / "images"
COLOURS = ("#2b5f8a", "#c9821f", "#3d8a5f", "#b5322a", "#777777")


def draw(name: str, lines: dict[str, str], column: str, share: float, axes: tuple[str, str]) -> None:
    """One line for each file: `column` times `share` over steps."""
    figure, plot = plt.subplots(figsize=(6.4, 3.4), dpi=110, layout="constrained")
    for colour, (file, label) in zip(COLOURS, lines.items(), strict=False):
        with (CURVES / f"{file}.csv").open(newline="", encoding="utf-8") as table:
            rows = list(csv.DictReader(table))
        steps = [float(row["steps"]) / 1000.0 for row in rows]
        plot.plot(steps, [share * float(row[column]) for row in rows], color=colour, label=label)
    plot.set(xlabel=axes[0], ylabel=axes[1])
    plot.set_ylim(bottom=0.0)
    plot.grid(alpha=0.25)
    plot.legend(frameon=False)
    figure.savefig(IMAGES / f"{name}.png")


seeds = {f"palpate_ppo_seed{seed}": f"seed {seed}" for seed in range(3)}
draw("palpate_ppo", seeds, "success", 100.0, ("decisions [thousands]", "success of the last 100 episodes [%]"))
slides = {f"slide_learned_seed{seed}": f"seed {seed}" for seed in range(3)}
slides |= {"slide_learned_without_taxels": "without taxels", "slide_learned_without_memory": "without memory"}
draw("slide_learned", slides, "score", 1.0, ("updates [thousands]", "score of the maps, validation organs"))
