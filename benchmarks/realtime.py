"""Speed of a scene: simulated over wall-clock time of Palpate-v0 in contact, reset, cold and warm start.

    python benchmarks/realtime.py --scene phantom

Prints `name value unit` lines; medians of repeated runs, one process, one core. Cold means an empty numba cache.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

START = """
import time; begin = time.perf_counter()
import gymnasium as gym
env = gym.make("surgsim_env:SurgSim/Palpate-v0", scene="{scene}")
env.reset(seed=0); env.step(env.action_space.sample())
print(time.perf_counter() - begin)
"""


def start_time(scene: str, cache: str) -> float:
    """Seconds from a fresh interpreter's first import to the end of the first step."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    run = subprocess.run(
        [sys.executable, "-c", START.format(scene=scene)], env=environment, check=True, capture_output=True, text=True
    )
    return float(run.stdout)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        print(f"start_cold {start_time(arguments.scene, cache):.2f} s")
        warm = statistics.median(start_time(arguments.scene, cache) for _ in range(3))
        print(f"start_warm {warm:.2f} s")

    import gymnasium as gym
    import numpy as np

    import surgsim_env  # noqa: F401

    env = gym.make("SurgSim/Palpate-v0", scene=arguments.scene).unwrapped
    env.reset(seed=0)
    resets, factors = [], []
    for seed in range(arguments.rounds):
        begin = time.perf_counter()
        env.reset(seed=seed)
        resets.append(time.perf_counter() - begin)
        palpation, radius = env.scene.palpation, env.scene.instrument.tip_radius
        point, normal = env.simulation.anatomy.face.random_point(np.random.default_rng(seed), palpation.face_margin)
        env.simulation.restart(point + normal * radius)
        begin = time.perf_counter()
        for step in range(20):
            # Pressed in at 13 mm/s for six steps, then moved back and forth: contact and friction at every haptic step.
            direction = np.roll(normal, 1) * 0.25 * (-1) ** step if step >= 6 else -0.66 * normal
            env.step(np.append(direction, 0.0).astype(np.float32))
        factors.append(env.simulation.time / (time.perf_counter() - begin))
    print(f"reset {statistics.median(resets) * 1000:.1f} ms")
    print(f"real_time_factor {statistics.median(factors):.2f} 1")
    print(f"control_steps {statistics.median(factors) / env.scene.timing.control_step:.1f} 1/s")


if __name__ == "__main__":
    main()
