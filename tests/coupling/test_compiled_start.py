"""The compiled control step makes no object, holds no lock, and starts from the cache."""

import os
import subprocess
import sys
import threading
import time
import warnings

import gymnasium as gym
import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import FAULT_NONE
from surgsim_env.coupling import mujoco_library
from surgsim_env.coupling.exchange import haptic_steps, step_outcome
from surgsim_env.coupling.haptic_kernels import StepPlan, advance_haptic_steps
from tests.allocations import allocations
from tests.coupling.test_compiled_step import DOWN, on_phantom, pair
from tests.coupling.test_exchange import LAW, free_ball, free_organ


def steps_of(env, count):
    """A call of the compiled loop, ready to be made."""
    sim = env.simulation
    decay, tools = float(np.exp(-sim.organ_model.alpha * sim.substep_dt)), sim.instrument.views(compiled=True)
    shapes, response, outcome = sim.instrument.shapes, sim.instrument.response, step_outcome(1, 1)
    plan = StepPlan(sim.substep_dt, decay, sim.substep_count, count, np.inf, np.inf)

    def call():
        advance_haptic_steps(
            sim.organ_model, sim.organ_state, sim.contact, shapes, response, tools, sim.drive, plan, outcome
        )
        return outcome.step_count[0], outcome.fault[0]

    return call


def test_nothing_is_allocated_within_the_loop():
    call, results = steps_of(on_phantom(gap=-0.001)[0], 30), []
    assert allocations(lambda: results.append(call())) == 0
    assert results == [(30, FAULT_NONE)]


def test_other_threads_run_meanwhile():
    """With Python's own switching put off for good, another thread advances only where a call gives up the lock."""
    call = steps_of(on_phantom()[0], 100)
    call()
    count, taken, done = 0, [], threading.Event()

    def work():
        # A busy machine may leave the other thread without a turn during a call.
        while not any(taken) and len(taken) < 1000:
            before = count
            call()
            taken.append(count - before)
        done.set()

    interval = sys.getswitchinterval()
    worker = threading.Thread(target=work)
    try:
        sys.setswitchinterval(1000.0)
        worker.start()
        while not done.is_set():
            count += 1
            time.sleep(0.0005)
    finally:
        sys.setswitchinterval(interval)
    worker.join()
    assert any(taken)


# ---- where it cannot be had ----------------------------------------------------------------------------------------


def test_numbas_own_switch_runs_the_loop_in_python_with_the_same_bits():
    code = """
import gymnasium as gym, hashlib, numba, numpy as np, surgsim_env
own = numba.njit(lambda x: x)
env = gym.make("SurgSim/Palpate-v0", scene="phantom_small").unwrapped
env.reset(seed=1)
for _ in range(3):
    env.step(np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32))
print(hasattr(own, "py_func"), env.simulation.compiled, hashlib.sha256(env.save_state()).hexdigest())
"""
    printed = []
    for disabled in ("1", "0"):
        settings = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        printed.append(subprocess.check_output([sys.executable, "-c", code], env=settings, text=True).split())
    assert [entries[:2] for entries in printed] == [["False", "False"], ["True", "True"]]
    assert printed[0][2] == printed[1][2]


def test_a_missing_library_has_a_reason(tmp_path):
    assert "no library of MuJoCo" in mujoco_library.load_library(tmp_path)
    (tmp_path / "libmujoco.so.9").write_text("no library")
    assert "cannot be loaded" in mujoco_library.load_library(tmp_path)
    assert mujoco_library.missing() == ""


def test_without_the_library_the_plain_loop_runs_and_says_so_once(monkeypatch):
    reason = "no library of MuJoCo in /nowhere"
    monkeypatch.setattr(mujoco_library, "_missing", reason)
    mujoco_library._warn_of_missing_library.cache_clear()
    with pytest.warns(RuntimeWarning, match=f"plain Python loop, more slowly: {reason}"):
        env = gym.make("SurgSim/Palpate-v0").unwrapped
    assert env.simulation.compiled is False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gym.make("SurgSim/Palpate-v0").unwrapped.simulation.compiled is False
    plain = pair("phantom")[1]
    for environment in (env, plain):
        environment.reset(seed=6)
        environment.step(DOWN)
    assert env.save_state() == plain.save_state()
    model, state = free_organ()
    with pytest.raises(RuntimeError, match=reason):
        haptic_steps(model, state, free_ball(), LAW, 2e-4, 5, np.zeros((1, 6)), compiled=True)


FRESH = """
import gymnasium as gym, numpy as np
import surgsim_env
from surgsim_env.coupling.haptic_kernels import advance_haptic_steps
env = gym.make("SurgSim/Palpate-v0").unwrapped
env.reset(seed=9)
env.step(np.array([0.1, 0.2, -0.9, 0.0], dtype=np.float32))
hits, misses = advance_haptic_steps.stats.cache_hits, advance_haptic_steps.stats.cache_misses
print(sum(hits.values()), sum(misses.values()), env.simulation.get_state()["organ_node_position"].tobytes().hex()[:400])
print(env.simulation.instrument.data.qpos.tobytes().hex())
"""


def test_a_fresh_process_runs_what_the_cache_holds():
    """Machine code from disk calls MuJoCo by address: the library must be there before."""
    env = pair("phantom")[0]
    env.reset(seed=9)
    env.step(np.array([0.1, 0.2, -0.9, 0.0], dtype=np.float32))
    done = subprocess.run([sys.executable, "-c", FRESH], env=dict(os.environ), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    hits, misses, nodes, place = done.stdout.split()
    assert (hits, misses) == ("1", "0")
    assert nodes == env.simulation.organ_state.node_position.tobytes().hex()[:400]
    assert place == env.simulation.instrument.data.qpos.tobytes().hex()
