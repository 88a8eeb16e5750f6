"""The figures of docs/palpation.md and the picture of a trained agent, from result files and one organ pressed.

python -m agents.palpation_figures
"""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from agents.leaderboard_tables import best_raster_alone
from surgsim_env.palpation.scores import ERROR_LINE
from surgsim_env.scoring.episodes import agent_generator
from surgsim_env.scoring.policy_video import PICTURE_SIZE, PRESS_PICTURES, draw_belief, episode_frames
from surgsim_env.scoring.results import SITES, Result, family, load_results, shipped_results
from surgsim_env.scoring.site_search import BOUNDS
from surgsim_env.training.site_agent import site_facts

matplotlib.use("Agg")
from matplotlib.figure import Figure

with one_line_errors(__name__, "agents"):
    from surgsim_env.scoring.evaluate import find_agent, policies_folder

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
# Colours of the methods in alphabetical order (Okabe & Ito 2008, with a darker yellow).
LINE_COLOURS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#999999", "#0072B2", "#D55E00", "#CC79A7")
# An organ with two lesions that no evaluation uses, and the presses after which it is shown.
SHOWN_SEED, SHOWN_PRESSES = 3_000_003, (4, 9, 16)
# The trained agent, an organ with two lesions that neither its training nor an evaluation uses, and the presses shown.
SHOWN_POLICY, AGENT_SEED, AGENT_PRESSES = "sites_evolved.safetensors", 4_000_009, (4, 12)


def draw_errors(results: list[Result], path: Path) -> None:
    """Median OSPA over organs with lesions after each press: one panel per scene and level, one line per method."""
    rows = [row for row in results if row.env_id == SITES and row.method not in BOUNDS and not row.motion]
    places = sorted({row.place for row in rows}, key=lambda place: ("standard" not in place, place))
    methods = sorted({label(row.method) for row in rows})
    figure = Figure(figsize=(10.4, 3.6 * math.ceil(len(places) / 2)), dpi=110, layout="constrained")
    panels = np.atleast_1d(figure.subplots(math.ceil(len(places) / 2), 2, squeeze=False)).ravel()
    for axes, place in zip(panels, places, strict=False):
        shown = best_raster_alone([row for row in rows if row.place == place])
        for method in {label(row.method) for row in shown}:
            # Over the organs with lesions after each press, one row for each seed; their mean as a line, all as a band.
            medians = np.array(
                [
                    np.median(np.array(row.errors_mm)[np.array(row.lesion_counts) > 0], axis=0)
                    for row in shown
                    if label(row.method) == method
                ]
            )
            presses = np.arange(1, medians.shape[1] + 1)
            colour = LINE_COLOURS[methods.index(method) % len(LINE_COLOURS)]
            axes.plot(presses, medians.mean(axis=0), label=method, color=colour, linewidth=1.6)
            if len(medians) > 1:
                band = {"color": colour, "alpha": 0.25, "linewidth": 0.0}
                axes.fill_between(presses, medians.min(axis=0), medians.max(axis=0), **band)
        axes.axhline(1000.0 * ERROR_LINE, color="black", linewidth=0.8, linestyle="--")
        scene, _, level = place.removeprefix("PalpateSites_").rpartition("_")
        axes.set_title(f"{scene}, {level}")
        axes.set_xlabel("press")
        axes.set_ylabel("median error (OSPA) [mm]")
        axes.set_ylim(0.0, 21.0)
        axes.grid(alpha=0.25)
    for axes in panels[len(places) :]:
        axes.remove()
    lines = {str(line.get_label()): line for axes in panels[: len(places)] for line in axes.get_lines()[:-1]}
    names = sorted(lines)
    figure.legend([lines[name] for name in names], names, loc="outside lower center", ncols=len(names), frameon=False)
    figure.savefig(path)


def label(method: str) -> str:
    """Label of a line: seeds of one policy, and rasters of all sides, share one."""
    return "best raster" if method.startswith("raster_") else family(method)


def draw_search(path: Path) -> None:
    """Excess maps of GP-UCB and the raster of 3 x 3 after a few presses on the same organ."""
    env = gym.make(SITES, scene="phantom", level="standard")
    figure = Figure(figsize=(11.0, 6.4), dpi=100, layout="constrained")
    grid = figure.subplots(2, len(SHOWN_PRESSES))
    for row, name in zip(grid, ("gp_ucb", "raster_3"), strict=True):
        agent = find_agent(name)()
        observation, _ = env.reset(seed=SHOWN_SEED)
        agent.reset(agent_generator(SHOWN_SEED), site_facts(env))
        for press in range(1, max(SHOWN_PRESSES) + 1):
            observation, _, _, _, info = env.step(agent.act(observation))
            if press in SHOWN_PRESSES:
                axes: Any = row[SHOWN_PRESSES.index(press)]
                draw_belief(axes, env.unwrapped.task)  # type: ignore[attr-defined]
                axes.set_title(f"{name}, {press} presses: error {info['error_mm']:.1f} mm", fontsize=10)
    figure.savefig(path)


def draw_agent(path: Path) -> None:
    """Two frames of a trained policy's film: early, and after it has found the lesions."""
    from PIL import Image

    from surgsim_env.training.policy_files import load_policy

    size = {"width": PICTURE_SIZE, "height": PICTURE_SIZE, "show_lesion": True}
    env = gym.make(SITES, scene="phantom", level="standard", render_mode="rgb_array", **size)
    frames = episode_frames(load_policy(policies_folder() / SHOWN_POLICY), env, AGENT_SEED)
    env.close()
    Image.fromarray(np.concatenate([frames[(press - 1) * PRESS_PICTURES] for press in AGENT_PRESSES])).save(path)


def main() -> None:
    """Draw all figures."""
    draw_agent(IMAGES / "agent_at_work.png")
    draw_search(IMAGES / "palpation_search.png")
    draw_errors(load_results(shipped_results()), IMAGES / "palpation_errors.png")


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
