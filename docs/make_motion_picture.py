"""Make the picture of docs/motion.md: python docs/make_motion_picture.py (half a minute, once kernels are compiled)."""

from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.coupling import SurfaceTracker, draw_drive, signals
from surgsim_env.scene import make_scene, with_motion
from surgsim_env.scripting import Hold, PressUntil, Tracked, run_script

IMAGES = Path(__file__).parent / "images"
COLOURS = {"calm": "#0072B2", "free": "#D55E00"}
SECONDS, SEED = 20.0, 11
FORCE, HELD = 0.2, 9.0

FloatArray = NDArray[np.float64]


def displacement(name: str, time: FloatArray) -> FloatArray:
    """Ground displacement at the liver's upper end in an episode of a preset [m], (n_time,)."""
    scene = with_motion(make_scene("liver"), name)
    drive = draw_drive(scene.motions, scene.timing.haptic_step, np.random.default_rng(SEED))
    ways = np.array([motion.displacement for motion in scene.motions])
    return np.array([np.linalg.norm(signals(drive, moment) @ ways) for moment in time])


def held_force(*, tracks: bool) -> tuple[FloatArray, FloatArray]:
    """Time [s] and force [N] of a press that is held on a calm patient's block."""
    env = gym.make("SurgSim/Palpate-v0", scene="phantom_small", motion="calm")
    env.reset(seed=SEED)
    simulation = env.unwrapped.simulation  # type: ignore[attr-defined]
    steps = [PressUntil(FORCE, 0.01, name="press"), Hold(HELD, name="hold")]
    if tracks:
        tracker = SurfaceTracker(simulation, np.unique(simulation.anatomy.face.triangles))
        steps = [Tracked(step, tracker) for step in steps]
    trace = run_script(env, steps)
    return trace.haptic_time, np.linalg.norm(trace.wrench[:, :, :3].sum(axis=1), axis=1)


def main() -> None:
    """Two panels: displacement over time, and the force of a press that is held."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.4, 3.6), dpi=110, layout="constrained")
    time = np.arange(0.0, SECONDS, 0.01)
    for name, colour in COLOURS.items():
        left.plot(time, 1e3 * displacement(name, time), color=colour, label=name)
    left.set(xlabel="time [s]", ylabel="displacement [mm]", title="the upper end of the liver", xlim=(0.0, SECONDS))
    left.set_ylim(0.0, 18.0)
    left.legend()
    for tracks, colour in ((False, "#999999"), (True, "#009E73")):
        time, force = held_force(tracks=tracks)
        right.plot(time, force, color=colour, label="tip goes with the surface" if tracks else "tip holds still")
    right.set(xlabel="time [s]", ylabel="force [N]", title="a press that is held, calm patient", xlim=(0.0, HELD))
    right.set_ylim(bottom=0.0)
    right.legend()
    for axes in (left, right):
        axes.grid(alpha=0.25)
    figure.savefig(IMAGES / "motion.png")


if __name__ == "__main__":
    main()
