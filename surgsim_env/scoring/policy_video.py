"""Films of a policy: organ and probe, forces, and the excess map or the tip's path, in one frame."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
from numpy.typing import NDArray

from surgsim_env.scoring.episodes import agent_generator
from surgsim_env.scoring.results import SITES
from surgsim_env.scripting.observations import stacked_observations

matplotlib.use("Agg")
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

PICTURE_SIZE = 480
DPI = 100
# Frames per second; frames per press; control steps per frame.
RATE, PRESS_PICTURES, STEPS_A_PICTURE = 10, 4, 2


def film(policy: Any, env_kwargs: dict[str, Any], seeds: Sequence[int], path: Path) -> None:
    """Play an episode of each seed and write an mp4 file.

    Raises:
        ValueError: moviepy is missing.
    """
    try:
        from moviepy import ImageSequenceClip  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("films need moviepy: pip install 'surgsim[video]'") from None
    size = {"width": PICTURE_SIZE, "height": PICTURE_SIZE, "show_lesion": True}
    env = gym.make(policy.description.env_id, render_mode="rgb_array", **size, **env_kwargs)
    frames = [frame for seed in seeds for frame in episode_frames(policy, env, seed)]
    env.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    ImageSequenceClip(frames, fps=RATE).write_videofile(str(path), logger=None)


def episode_frames(policy: Any, env: gym.Env, seed: int) -> list[NDArray[np.uint8]]:
    """Frames of one episode, each (480, 960, 3)."""
    presses = policy.description.env_id == SITES
    observation, _ = env.reset(seed=int(seed))
    policy.reset(1)
    policy.begin(0, env, agent_generator(int(seed)))
    over, steps = False, 0
    forces: list[float] = []
    tips: list[NDArray[np.float64]] = []
    frames: list[NDArray[np.uint8]] = []
    while not over:
        seen = stacked_observations(env.observation_space, [observation])
        observation, _, terminated, truncated, info = env.step(policy.act(seen)[0])
        over, steps = terminated or truncated, steps + 1
        forces.append(float(info["force_peak"]))
        tips.append(env.unwrapped.simulation.instrument.tip_position.copy())  # type: ignore[attr-defined]
        if presses or over or steps % STEPS_A_PICTURE == 0:
            side = _panel(env.unwrapped, forces, tips, info, presses)
            frame = np.concatenate([np.asarray(env.render()), side], axis=1)
            frames += [frame] * (PRESS_PICTURES if presses else 1)
    # The last frame is held for a second.
    return frames + [frames[-1]] * RATE


def _panel(
    env: Any, forces: Sequence[float], tips: Sequence[NDArray[np.float64]], info: dict[str, Any], presses: bool
) -> NDArray[np.uint8]:
    """The right half of a frame: forces above, excess map or the tip's path below."""
    figure = Figure(figsize=(PICTURE_SIZE / DPI, PICTURE_SIZE / DPI), dpi=DPI, layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(1, 2))
    _draw_forces(above, env, forces, presses)
    if presses:
        draw_belief(below, env.task)
        below.set_title(f"press {len(forces)} of {env.task.budget}: error {info['error_mm']:.1f} mm", fontsize=9)
    else:
        _draw_way(below, env, tips)
        below.set_title(f"{len(forces) * env.scene.timing.control_step:.1f} s", fontsize=9)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_forces(axes: Any, env: Any, forces: Sequence[float], presses: bool) -> None:
    limits, step = env.scene.limits, 1.0 if presses else env.scene.timing.control_step
    axes.plot(np.arange(1, len(forces) + 1) * step, forces, "o-" if presses else "-", markersize=3, color="tab:blue")
    axes.axhline(limits.soft_force, color="tab:orange", linewidth=1)
    axes.axhline(limits.hard_force, color="tab:red", linewidth=1)
    axes.set_ylim(0.0, 1.1 * limits.hard_force)
    axes.set_xlim(0.0, max(env.task.budget if presses else 30.0, len(forces) * step))
    axes.set_xlabel("press" if presses else "time [s]", fontsize=8)
    axes.set_ylabel("peak force [N]", fontsize=8)
    axes.tick_params(labelsize=7)


def draw_belief(axes: Any, task: Any) -> None:
    """The estimator's excess map with presses (dots), estimates (crosses) and true lesions (circles), in mm.

    Circles are about the points of the face nearest to the lesions' centres, of which the error is the distance.
    """
    estimate, chart = task.estimate, task.charted.chart
    extent = 1000.0 * chart.extent
    shown = axes.imshow(
        estimate.excess, origin="lower", extent=(0.0, extent[0], 0.0, extent[1]), vmin=0.0, vmax=0.5, cmap="viridis"
    )
    places = 1000.0 * task.felt.places
    axes.plot(*places.T, ".", color="white", markersize=4)
    axes.plot(*(1000.0 * estimate.points).T, "x", color="red", markersize=9, markeredgewidth=2)
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    for lesion, point in zip(task.lesions, task.truth, strict=True):
        x, y = 0.5 * (chart.place(point) + 1.0) * extent
        radius = 1000.0 * lesion.radius
        axes.plot(x + radius * np.cos(angle), y + radius * np.sin(angle), "--", color="white", linewidth=1)
    axes.set_xlim(0.0, extent[0])
    axes.set_ylim(0.0, extent[1])
    axes.set_xlabel("[mm]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.figure.colorbar(shown, ax=axes, label="excess of log contrast")


def _draw_way(axes: Any, env: Any, tips: Sequence[NDArray[np.float64]]) -> None:
    """The tip's path: on the face, over the remembered contrast, if the observation has a memory; else from above."""
    memory = getattr(env.task, "memory", None)
    if memory is None:
        way = 1000.0 * np.array(tips)[:, :2]
        lesions = [1000.0 * lesion.centre[:2] for lesion in env.task.lesions]
        seen = np.concatenate([1000.0 * env.simulation.anatomy.mesh.points[:, :2], way])
        lower, upper = seen.min(axis=0) - 5.0, seen.max(axis=0) + 5.0
    else:
        chart, touched = memory.chart, memory.map
        extent = 1000.0 * chart.extent
        way = 0.5 * (chart.place(np.array(tips)) + 1.0) * extent
        # The points of the face nearest to their centres, of which the error is the distance.
        nearest = [env.task.anatomy.face.project(lesion.centre)[0] for lesion in env.task.lesions]
        lesions = [0.5 * (chart.place(point) + 1.0) * extent for point in nearest]
        contrast = np.where(memory.visited > 0.0, memory.contrast, np.nan)
        columns, rows = (1000.0 * axis for axis in touched.axes)
        cells = contrast.reshape(len(rows), len(columns))
        shown = axes.pcolormesh(columns, rows, cells, shading="nearest", cmap="viridis", vmin=0.5, vmax=2.5)
        axes.figure.colorbar(shown, ax=axes, label="contrast felt")
        lower, upper = np.minimum(way.min(axis=0), 0.0) - 5.0, np.maximum(way.max(axis=0), extent) + 5.0
    axes.plot(way[:, 0], way[:, 1], "-", color="tab:gray", linewidth=1)
    axes.plot(*way[-1], "o", color="tab:blue")
    for place in lesions:
        axes.plot(*place, "x", color="red")
    axes.set_xlim(lower[0], upper[0])
    axes.set_ylim(lower[1], upper[1])
    axes.set_aspect("equal")
    where = "from above" if memory is None else "on the face"
    axes.set_xlabel(f"the tip's path, {where} [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
