"""Environments side by side refuse at once in a forked child."""

import multiprocessing

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

ID = "SurgSim/Palpate-v0"
DOWN = np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32)
# Only a hang takes so long [s].
PATIENCE = 60.0


def in_a_fork(function):
    """A function's result in a forked child, or the exception that it raises there."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)

    def work():
        try:
            theirs.send(function())
        except Exception as error:
            theirs.send(error)

    child = context.Process(target=work)
    child.start()
    try:
        assert ours.poll(PATIENCE), "the child hangs"
        result = ours.recv()
        child.join(PATIENCE)
        assert child.exitcode == 0, "the child hangs at its end, or died"
        return result
    finally:
        child.kill()


@pytest.fixture(scope="module")
def lanes():
    envs = gym.make_vec(ID, num_envs=2, vectorization_mode="vector_entry_point", scene="phantom_small")
    envs.reset(seed=1)
    # The threads start with the first step.
    envs.step(np.stack([DOWN, DOWN]))
    yield envs
    envs.close()


@pytest.mark.parametrize("call", [lambda envs: envs.step(np.stack([DOWN, DOWN])), lambda envs: envs.reset(seed=1)])
def test_side_by_side_they_name_both_processes_and_the_way_out(lanes, call):
    error = in_a_fork(lambda: call(lanes))
    assert isinstance(error, RuntimeError) and "\n" not in str(error)
    assert "PalpateVectorEnv of 2 environments was made in process" in str(error)
    assert "make it in the child process" in str(error) and '"spawn"' in str(error)
    assert in_a_fork(lanes.close) is None
    # The parent's go on.
    assert np.isfinite(lanes.step(np.stack([DOWN, DOWN]))[0]).all()
