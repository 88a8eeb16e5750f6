"""After an exception in a step, the organ and the counts of an episode agree, or the next step asks for a reset."""

import _thread
import sys
import time

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.envs.ids import PalpateEnv
from surgsim_env.envs.vector_env import vector_class

COUNT = 3
HAPTIC_STEPS = 50


class Interrupt(KeyboardInterrupt):
    """Ctrl-C at a chosen line."""


def lanes(**settings):
    return vector_class(PalpateEnv)(COUNT, scene="phantom_small", autoreset_mode="Disabled", **settings)


def step_interrupted(env, action, line):
    """A step with an interrupt at the n-th line of the package that it runs; True if it had that many."""
    left, before = line, sys.gettrace()

    def at_line(frame, event, _):
        nonlocal left
        left -= event == "line"
        if left == 0 and event == "line":
            raise Interrupt
        return at_line

    sys.settrace(lambda frame, *_: at_line if "/surgsim_env/" in frame.f_code.co_filename else None)
    try:
        env.step(action)
    except Interrupt:
        return True
    finally:
        sys.settrace(before)
    return False


@pytest.mark.parametrize(("make", "stride"), [(lambda: PalpateEnv(scene="phantom_small"), 23), (lanes, 97)])
def test_an_interrupt_anywhere_neither_repeats_nor_skips_physics(make, stride):
    env, line, refused = make(), 1, 0
    singles = getattr(env, "envs", [env])
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    env.reset(seed=1)
    while step_interrupted(env, still, line):
        try:
            env.step(still)
        except gym.error.ResetNeeded:
            refused += 1
            broken = [single for single in singles if single.halted]
            assert broken
            for single in broken:
                with pytest.raises(gym.error.ResetNeeded):
                    single.save_state()
        for single in singles:
            if not single.halted:
                assert single.simulation._step == single.task.step_count * HAPTIC_STEPS
        env.reset(seed=1)
        line += stride
    assert line > 5 * stride and refused


def test_a_lane_whose_task_raises_leaves_the_judged_ones_as_they_are(monkeypatch):
    """Lane 0 was judged and goes on; lanes 1 and 2 have moved and were not: they are loaded, paused or reset."""
    envs, whole = lanes(), lanes()
    still = np.zeros(envs.action_space.shape, dtype=np.float32)
    for each in (envs, whole):
        each.reset(seed=1)
    saved = envs.envs[2].save_state()
    with monkeypatch.context() as patch:
        patch.setattr(envs.envs[1].task, "update", lambda step: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            envs.step(still)
    with pytest.raises(gym.error.ResetNeeded, match=r"^lane 1, lane 2: "):
        envs.step(still)
    envs.envs[2].load_state(saved)
    envs.pause(np.array([False, True, False]))
    envs.step(still)
    whole.step(still)
    once = whole.envs[2].save_state()
    whole.step(still)
    assert envs.envs[0].save_state() == whole.envs[0].save_state() and envs.envs[2].save_state() == once
    envs.reset(seed=1, options={"reset_mask": np.array([False, True, False])})
    envs.step(still)


def test_an_interrupted_step_waits_for_its_threads(monkeypatch):
    envs, moved = lanes(), []
    envs.reset(seed=1)

    def advance(group, lanes):
        _thread.interrupt_main()
        time.sleep(0.3)
        moved.append(len(group))

    monkeypatch.setattr(envs.envs[0], "advance", advance)
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.zeros(envs.action_space.shape, dtype=np.float32))
    assert moved == [COUNT]
    monkeypatch.undo()
    envs.reset(seed=1)
    envs.step(np.zeros(envs.action_space.shape, dtype=np.float32))
    envs.close()


def test_a_state_whose_loading_was_interrupted_is_not_played(monkeypatch):
    env = PalpateEnv(scene="phantom_small")
    env.reset(seed=1)
    saved = env.save_state()
    with monkeypatch.context() as patch:
        patch.setattr(env.runtime, "set_state", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.load_state(saved)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4, dtype=np.float32))
    env.load_state(saved)
    env.step(np.zeros(4, dtype=np.float32))
