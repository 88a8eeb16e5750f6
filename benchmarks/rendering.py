"""Speed of rendering: frames a second of a pressed organ at 640 x 480, off screen, by option.

    python benchmarks/rendering.py --scene liver

Prints `name value unit` lines: the median over the frames, with the upload of the deformed surface and without the time
of the simulation. Without a graphics card Mesa draws on all cores (llvmpipe). `first` is the first picture, with
loading.
"""

import argparse
import statistics
import time

import gymnasium as gym
import numpy as np

import surgsim_env  # noqa: F401

CASES = {
    "rgb": {},
    "rgb_no_smooth_edges": {"smooth_edges": False},
    "rgb_show_lesion": {"show_lesion": True},
    "rgb_cut_away": {"cut_away": True},
}


def press(env: gym.Env, steps: int) -> None:
    """Press above the lesion for a number of control steps."""
    palpate = env.unwrapped
    point, outward = palpate.simulation.anatomy.face.project(palpate.task.lesion.centre)
    palpate.simulation.restart(point + outward * (palpate.scene.instrument.tip_radius + 0.001))
    for _ in range(steps):
        env.step(np.append(-0.6 * outward, 0.0).astype(np.float32))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="liver")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--style", default="endoscopic")
    arguments = parser.parse_args()
    for number, (name, options) in enumerate(CASES.items()):
        options |= {"scene": arguments.scene, "style": arguments.style}
        env = gym.make("SurgSim/Palpate-v0", render_mode="rgb_array", **options)
        env.reset(seed=5)
        press(env, 8)
        draw = {name: env.render}
        if number == 0:
            renderer = env.unwrapped.renderer
            draw |= {"depth": renderer.depth, "segmentation": renderer.segmentation}
            begin = time.perf_counter()
            env.render()
            print(f"first {(time.perf_counter() - begin) * 1e3:.0f} ms")
        for kind, function in draw.items():
            times = []
            for _ in range(arguments.frames):
                begin = time.perf_counter()
                function()
                times.append(time.perf_counter() - begin)
            print(f"{kind} {1.0 / statistics.median(times):.1f} 1/s")
        env.close()


if __name__ == "__main__":
    main()
