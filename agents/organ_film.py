"""A film of one policy that palpates several organs: each under the probe, below it where the policy expects lesions.

The truth is shown when all presses are made. The policy reads the observation alone; its belief is the Gaussian process
over its presses that site policies read (`surgsim_env/training/site_agent.py`). Run it from a checkout:

    python -m agents.organ_film --out docs/images/three_organs.webp
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

import surgsim_env  # noqa: F401  (registers the ids)
from agents.command_line import one_line_errors
from surgsim_env.palpation.chart import MAP_SIDE
from surgsim_env.scoring.results import SITES
from surgsim_env.training.site_agent import SiteProcess, site_facts

matplotlib.use("Agg")
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

with one_line_errors(__name__, "agents"):
    from surgsim_env.scoring.evaluate import policies_folder
    from surgsim_env.training.policy_files import load_policy

# Organs, and an episode of each that neither a training nor an evaluation uses.
ORGANS: dict[str, tuple[dict[str, str], int]] = {
    "phantom": ({"scene": "phantom"}, 4_000_009),
    "liver, test split": ({"scene": "liver_family", "split": "test"}, 4_000_002),
    "kidney, test split": ({"scene": "kidney_family", "split": "test"}, 4_000_004),
}
PICTURE, SIZE, DPI = 360, (9.0, 6.2), 100  # [pixels], [in], [1/in]
MARGINS = {"left": 0.05, "right": 0.93, "bottom": 0.08, "top": 0.94, "wspace": 0.16, "hspace": 0.12}
# Time of a press, and of the truth at the end [ms].
PRESS_TIME, END_TIME = 500, 4000
# Excess of log contrast at the end of the colour scale.
EXCESS_MOST = 0.4


@dataclass
class Episode:
    """What a film shows of one organ.

    Fields:
        name: of the organ
        pictures: of each press (PICTURE, PICTURE, 3); the last shows the lesions
        beliefs: expected excess after each press over the map (n, n), not a number where the face ends
        borders: of the map: left, right, lower, upper, along the chart's sides [mm] (4,)
        places: of the presses, along the chart's sides [mm] (n_press, 2)
        extent: lengths of the chart's sides [mm] (2,)
        estimated: places of the lesions that the estimator reports at the end [mm] (k, 2)
        truth: places of the face nearest to the lesions, and their radii [mm] (n_lesion, 3)
        error_mm: of the estimate after each press
    """

    name: str
    pictures: list[NDArray[np.uint8]]
    beliefs: list[NDArray[np.float64]]
    borders: tuple[float, float, float, float]
    places: NDArray[np.float64]
    extent: NDArray[np.float64]
    estimated: NDArray[np.float64]
    truth: NDArray[np.float64]
    error_mm: list[float]


def play(policy: Any, name: str, settings: dict[str, str], seed: int, budget: int) -> Episode:
    """Play an episode and keep what is shown of it."""
    env = make_env(settings, budget)
    observation, _ = env.reset(seed=seed)
    task = env.unwrapped.task  # type: ignore[attr-defined]
    process = SiteProcess(site_facts(env))
    on_face = process.facts.map.pressable
    policy.reset(1)
    pictures, beliefs, errors = [], [], []
    for _ in track(range(budget), f"pressing {name}"):
        observation, _, _, _, info = env.step(policy.act(observation[None])[0])
        pictures.append(np.asarray(env.render()))
        excess = np.where(on_face, process.belief(observation).excess, np.nan)
        beliefs.append(excess.reshape(MAP_SIDE, MAP_SIDE))
        errors.append(float(info["error_mm"]))
    env.close()
    # The same organ at rest, translucent, with its lesions.
    opened = make_env(settings, budget, show_lesion=True)
    opened.reset(seed=seed)
    pictures.append(np.asarray(opened.render()))
    opened.close()
    extent = 1000.0 * task.charted.chart.extent
    truth = [
        [*(0.5 * (task.charted.chart.place(point) + 1.0) * extent), 1000.0 * one.radius]
        for one, point in zip(task.lesions, task.truth, strict=True)
    ]
    half = 0.5 * process.facts.map.cell
    return Episode(
        name,
        pictures,
        beliefs,
        borders=tuple(
            1000.0 * (axis[end] + way) for axis in process.facts.map.axes for end, way in ((0, -half), (-1, half))
        ),
        places=1000.0 * task.felt.places,
        extent=extent,
        estimated=1000.0 * task.estimate.points.reshape(-1, 2),
        truth=np.array(truth).reshape(-1, 3),
        error_mm=errors,
    )


def make_env(settings: dict[str, Any], budget: int, *, show_lesion: bool = False) -> gym.Env:
    """An environment of the film."""
    size = {"width": PICTURE, "height": PICTURE}
    shown: dict[str, Any] = {**size, **settings, "show_lesion": show_lesion}
    return gym.make(SITES, level="standard", budget=budget, render_mode="rgb_array", **shown)


def frame(episodes: Sequence[Episode], press: int) -> NDArray[np.uint8]:
    """The picture after a press, from 0; one more than there are presses shows the truth (620, 900, 3)."""
    figure = Figure(figsize=SIZE, dpi=DPI)
    grid = figure.add_gridspec(
        2, len(episodes) + 1, width_ratios=[*[1.0] * len(episodes), 0.05], height_ratios=(1.0, 0.9), **MARGINS
    )
    shown = None
    for column, episode in enumerate(episodes):
        above, below = (figure.add_subplot(grid[row, column]) for row in range(2))
        above.imshow(episode.pictures[press])
        above.set_axis_off()
        above.set_title(episode.name, fontsize=11)
        shown = _draw_belief(below, episode, press)
    assert shown is not None
    bar = figure.colorbar(shown, cax=figure.add_subplot(grid[1, -1]))
    bar.set_label("expected excess of log contrast", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_belief(axes: Any, episode: Episode, press: int) -> Any:
    """The belief after a press, or after all of them with the truth; what a colour bar needs."""
    count = len(episode.beliefs)
    last = min(press, count - 1)
    axes.set_facecolor("#dddddd")
    scale = {"origin": "lower", "extent": episode.borders, "vmin": 0.0, "vmax": EXCESS_MOST}
    shown = axes.imshow(episode.beliefs[last], **scale)
    axes.plot(*episode.places[: last + 1].T, ".", color="white", markersize=5)
    if press < count:
        axes.plot(*episode.places[last], "o", color="none", markeredgecolor="white", markersize=11)
        axes.set_title(f"press {press + 1} of {count}", fontsize=10)
    else:
        axes.plot(*episode.estimated.T, "x", color="red", markersize=9, markeredgewidth=2.5)
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        for x, y, radius in episode.truth:
            axes.plot(x + radius * np.cos(angle), y + radius * np.sin(angle), color="red", linewidth=1.5)
        hidden = f"{len(episode.truth)} lesion{'s' * (len(episode.truth) != 1)}"
        axes.set_title(f"{hidden}, error {episode.error_mm[-1]:.1f} mm", fontsize=10)
    axes.set_xlim(0.0, episode.extent[0])
    axes.set_ylim(0.0, episode.extent[1])
    axes.set_xlabel("[mm]", fontsize=8)
    axes.tick_params(labelsize=8)
    return shown


def write_film(episodes: Sequence[Episode], path: Path) -> None:
    """Write the film of episodes with equally many presses, as a webp that repeats."""
    from PIL import Image

    count = len(episodes[0].beliefs)
    frames = [Image.fromarray(frame(episodes, press)) for press in range(count + 1)]
    times = [PRESS_TIME] * count + [END_TIME]
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=70, method=4)


def main(arguments: Sequence[str] | None = None) -> None:
    """Play and write the film.

    Raises:
        ValueError: an --out that does not end in .webp.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=policies_folder() / "sites_evolved.safetensors")
    parser.add_argument("--organs", nargs="+", choices=list(ORGANS), default=list(ORGANS))
    parser.add_argument("--budget", type=int, default=20, help="presses of each organ")
    parser.add_argument("--out", type=Path, required=True, help="the film, NAME.webp")
    given = parser.parse_args(arguments)
    if given.out.suffix != ".webp":
        raise ValueError(f"--out is {given.out}; the film is a webp: let its name end in .webp")
    policy = load_policy(given.policy)
    episodes = [play(policy, name, *ORGANS[name], given.budget) for name in given.organs]
    write_film(episodes, given.out)
    print(f"written: {given.out}")
    for episode in episodes:
        print(f"{episode.name}: {len(episode.truth)} lesions, error {episode.error_mm[-1]:.1f} mm")


if __name__ == "__main__":
    with one_line_errors(__name__, "agents"):
        main()
