"""Compile what most tests run, in processes side by side; `make test` does it first.

    python -m tests.compile_kernels

Two workers of pytest would otherwise each compile the same functions at the same time. Where they are in numba's cache
already this takes some seconds.
"""

import gc
import subprocess
import sys
import time

import gymnasium as gym

import surgsim_env  # noqa: F401  (registers the ids)

SCENE = "phantom_small"


def alone() -> None:
    """One organ and its instrument."""
    step(gym.make("SurgSim/Palpate-v0", scene=SCENE))


def lanes(dtype: str) -> None:
    """Organs side by side."""
    step(
        gym.make_vec(
            "SurgSim/Palpate-v0",
            num_envs=2,
            vectorization_mode="vector_entry_point",
            scene=SCENE,
            dtype=dtype,
            threads=1,
        )
    )


def at_rest_each() -> None:
    """Organs side by side that each rest on supports in a shape of their own."""
    step(gym.make_vec("SurgSim/Retract-v0", num_envs=2, vectorization_mode="vector_entry_point", threads=1))


def float64() -> None:
    """Both kinds of lanes, which share most functions."""
    lanes("float64")
    at_rest_each()


def step(env: gym.Env | gym.vector.VectorEnv) -> None:
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


JOBS = {"alone": alone, "float64": float64, "float32": lambda: lanes("float32")}


def main() -> None:
    if len(sys.argv) > 1:
        # The compiler makes millions of objects that stay: looking for garbage among them takes its time.
        gc.disable()
        JOBS[sys.argv[1]]()
        return
    begin = time.perf_counter()
    running = [subprocess.Popen([sys.executable, "-m", "tests.compile_kernels", name]) for name in JOBS]
    ends = [process.wait() for process in running]
    if any(ends):
        sys.exit("compile_kernels: see above")
    print(f"compiled in {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
