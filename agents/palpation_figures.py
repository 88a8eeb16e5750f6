"""The figures of docs/palpation.md and the picture of a trained agent, from result files and one organ pressed.

python -m agents.palpation_figures
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

import surgsim_env  # noqa: F401  (registers the ids)
from agents.leaderboard import SITES, best_raster_alone
from agents.policy_video import PICTURE_SIZE, PRESS_PICTURES, draw_belief, episode_frames
from agents.results_files import Result, load_results
from agents.roster import POLICIES, WORDS, find_agent
from agents.site_agent import site_facts
from surgsim_env.evaluation.palpation import ERROR_LINE

matplotlib.use("Agg")
from matplotlib.figure import Figure

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
# An organ that no evaluation uses, with two lesions, and when it is shown.
SHOWN_SEED, SHOWN_PRESSES = 3_000_003, (4, 9, 16)
# The trained agent that is shown, an organ with two lesions that neither its training nor an evaluation uses, and when.
SHOWN_POLICY, AGENT_SEED, AGENT_PRESSES = "sites_ppo_seed0.zip", 4_000_009, (4, 12)


def draw_errors(results: list[Result], path: Path) -> None:
    """Median OSPA over organs with lesions after each press, one panel a place, one line a method."""
    places = sorted({result.place for result in results if result.env_id == SITES and result.method not in WORDS})
    figure = Figure(figsize=(5.2 * len(places), 4.0), dpi=110, layout="constrained")
    for axes, place in zip(np.atleast_1d(figure.subplots(1, len(places))), places, strict=True):
        rows = best_raster_alone([row for row in results if row.place == place and row.method not in WORDS])
        for row in sorted(rows, key=lambda row: row.method):
            errors = np.array(row.errors_mm)[np.array(row.lesion_counts) > 0]
            name = row.method.replace("raster_", "raster ")
            axes.plot(np.arange(1, errors.shape[1] + 1), np.median(errors, axis=0), label=name, linewidth=1.5)
        axes.axhline(1000.0 * ERROR_LINE, color="black", linewidth=0.8, linestyle="--")
        axes.set_title(place.removeprefix("PalpateSites_").replace("_", " "))
        axes.set_xlabel("press")
        axes.set_ylabel("median error (OSPA) [mm]")
        axes.set_ylim(0.0, 21.0)
        axes.legend(fontsize=8)
    figure.savefig(path)


def draw_search(path: Path) -> None:
    """What GP-UCB and the raster of 3 x 3 believe after a few presses of the same organ."""
    env = gym.make(SITES, scene="phantom", level="standard")
    figure = Figure(figsize=(11.0, 6.4), dpi=100, layout="constrained")
    grid = figure.subplots(2, len(SHOWN_PRESSES))
    for row, name in zip(grid, ("gp_ucb", "raster_3"), strict=True):
        agent = find_agent(name)()
        observation, _ = env.reset(seed=SHOWN_SEED)
        agent.reset(np.random.default_rng(SHOWN_SEED), site_facts(env))
        for press in range(1, max(SHOWN_PRESSES) + 1):
            observation, _, _, _, info = env.step(agent.act(observation))
            if press in SHOWN_PRESSES:
                axes: Any = row[SHOWN_PRESSES.index(press)]
                draw_belief(axes, env.unwrapped.task)  # type: ignore[attr-defined]
                axes.set_title(f"{name}, {press} presses: error {info['error_mm']:.1f} mm", fontsize=10)
    figure.savefig(path)


def draw_agent(path: Path) -> None:
    """Two frames of a trained policy's film: early, and when it has found what there is."""
    from PIL import Image

    from agents.training.policy_files import load_policy

    size = {"width": PICTURE_SIZE, "height": PICTURE_SIZE, "show_lesion": True}
    env = gym.make(SITES, scene="phantom", level="standard", render_mode="rgb_array", **size)
    frames = episode_frames(load_policy(POLICIES / SHOWN_POLICY), env, AGENT_SEED)
    env.close()
    Image.fromarray(np.concatenate([frames[(press - 1) * PRESS_PICTURES] for press in AGENT_PRESSES])).save(path)


def main() -> None:
    """Draw them."""
    draw_agent(IMAGES / "agent_at_work.png")
    draw_search(IMAGES / "palpation_search.png")
    draw_errors(load_results(), IMAGES / "palpation_errors.png")


if __name__ == "__main__":
    main()
