"""Time from a fresh interpreter to the first step, cold and warm; time of a reset; memory of a further environment."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from surgsim_apps.bench.measurement import Effort, spread
from surgsim_apps.bench.report import Figure, Section, absent

SCENE = "phantom"
# Longest time of a process [s].
LIMIT = 600.0
METHOD = f"""Start is from the first import to the end of the first `step` of `SurgSim/Palpate-v0` on `{SCENE}`; cold
is with an empty numba cache, warm with a full one; reset is the median of seven. Memory is the growth of the process
(resident set) per environment made and reset after the first two."""
START = f"""
import time; begin = time.perf_counter()
import gymnasium as gym
env = gym.make("surgsim_env:SurgSim/Palpate-v0", scene="{SCENE}")
env.reset(seed=0); env.step(env.action_space.sample())
print(time.perf_counter() - begin)
"""
RESET = f"""
import statistics, time
import gymnasium as gym
env = gym.make("surgsim_env:SurgSim/Palpate-v0", scene="{SCENE}")
def seconds(seed):
    begin = time.perf_counter(); env.reset(seed=seed)
    return time.perf_counter() - begin
print(statistics.median([seconds(seed) for seed in range(8)][1:]))
"""
GROWTH = f"""
import gc, os
import gymnasium as gym
def resident():
    gc.collect()
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
def more(count):
    for seed in range(count):
        env = gym.make("surgsim_env:SurgSim/Palpate-v0", scene="{SCENE}")
        env.reset(seed=seed); env.step(env.action_space.sample())
        envs.append(env)
envs = []
more(2); before = resident(); more({{count}})
print((resident() - before) / {{count}})
"""


def printed_number(code: str, environment: dict[str, str] | None = None) -> float:
    """The number that a fresh interpreter prints last."""
    # Python looks for modules in the folder where `-c` begins: that of the packages that run here.
    folder = Path(__file__).resolve().parents[2]
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env={**os.environ, **(environment or {})}, capture_output=True,
        text=True, timeout=LIMIT, check=True,
    )  # fmt: skip
    return float(run.stdout.split()[-1])


def measure(effort: Effort) -> Section:
    """Cold and warm start, reset, memory per environment."""
    section = Section("start", "Start and memory", METHOD)
    with tempfile.TemporaryDirectory() as cache:
        environment = {"NUMBA_CACHE_DIR": cache}
        section.figures.append(Figure("start", "cold", printed_number(START, environment), "s"))
        warm = [printed_number(START, environment) for _ in range(effort.starts)]
    section.figures.append(Figure("start", "warm", median(warm), "s", f"warm: {spread(warm)}"))
    section.figures.append(Figure("start", "reset", printed_number(RESET), "s"))
    section.figures.append(_memory(effort.memory_envs))
    return section


def _memory(count: int) -> Figure:
    case, quantity = "memory", "per further env"
    if not Path("/proc/self/statm").is_file():
        return absent(case, quantity, "MB", "only measured where /proc has the resident set (Linux)")
    growth = printed_number(GROWTH.format(count=count))
    return Figure(case, quantity, 1e-6 * growth, "MB", f"mean of {count}")
