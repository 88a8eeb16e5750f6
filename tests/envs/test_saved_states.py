"""A state is restored to the bit, or refused and nothing changes."""

import io
import re

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401

SMALL = {"scene": "phantom_small"}
PALPATE, SITES = "SurgSim/Palpate-v0", "SurgSim/PalpateSites-v0"


def played(id: str, *, steps: int = 3, **settings):
    env = gym.make(id, **settings).unwrapped
    env.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(rng.uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32))
    return env


@pytest.fixture(scope="module")
def palpate():
    return played(PALPATE, memory=True, **SMALL)


@pytest.fixture
def saved(palpate) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(palpate.save_state()), allow_pickle=False) as archive:
        return dict(archive)


def pack(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def without(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key: value for key, value in arrays.items() if key != name}


BREAKS = [
    (lambda arrays: without(arrays, "random"), "entry 'random' is missing"),
    (lambda arrays: without(arrays, "organ_node_force"), "entry 'organ_node_force' is missing"),
    (lambda arrays: without(arrays, "made_by"), "not a saved state"),
    (lambda arrays: {**arrays, "another": np.zeros(3)}, "entry 'another' is unknown; the entries are organ_node"),
    (lambda arrays: {**arrays, "observation": arrays["observation"][:-1]}, "'observation' has shape .*; it must be"),
    (
        lambda arrays: {**arrays, "organ_node_position": arrays["organ_node_position"][:10]},
        r"'organ_node_position' has shape \(10, 3\); it must be \(\d+, 3\)",
    ),
    (
        lambda arrays: {**arrays, "made_by": np.array(f"{arrays['made_by']}1")},
        r"saved by .*version 21, this is .*version 2: use the same scene",
    ),
    (lambda arrays: {**arrays, "task": np.array([{}], dtype=object)}, "not a saved state.*allow_pickle=False"),
]


@pytest.mark.parametrize(("change", "message"), BREAKS, ids=range(len(BREAKS)))
def test_a_broken_state_changes_nothing(palpate, saved, change, message):
    before, data = palpate.save_state(), palpate.simulation.instrument.data
    poses = data.xpos.copy()
    with pytest.raises(ValueError) as error:
        palpate.load_state(pack(change(saved)))
    assert re.search(message, str(error.value)), error.value
    assert palpate.save_state() == before
    np.testing.assert_array_equal(data.xpos, poses)


def test_bytes_that_are_no_archive_are_refused(palpate, saved):
    state = pack(saved)
    flipped = bytearray(state)
    flipped[len(state) // 2] ^= 1
    for broken in (b"", b"garbage", state[: len(state) // 2], state[:-40], bytes(flipped), None):
        with pytest.raises(ValueError, match="not a saved state"):
            palpate.load_state(broken)


def test_an_environment_that_was_never_reset_is_loaded_or_stays_so(palpate, saved):
    env = gym.make(PALPATE, memory=True, **SMALL).unwrapped
    with pytest.raises(ValueError, match="'random' is missing"):
        env.load_state(pack(without(saved, "random")))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4, dtype=np.float32))
    env.load_state(pack(saved))
    assert env.save_state() == palpate.save_state()


def test_a_press_that_was_begun_outlives_a_refusal():
    env = played(SITES, steps=0, budget=5, **SMALL)
    other = played(SITES, steps=0, budget=5, **SMALL)
    action = np.full(2, 0.3)
    env.begin(action)
    with pytest.raises(ValueError, match="not a saved state"):
        env.load_state(b"")
    env.advance([env])
    result, expected = env.finish(), other.step(action)
    np.testing.assert_array_equal(result[0], expected[0])
    assert result[1:] == expected[1:]


def test_the_state_of_a_fault_is_loaded_although_it_is_not_finite():
    env = played(PALPATE, steps=0, memory=True, **SMALL)
    env.simulation.organ_state.node_velocity[40, 1] = np.nan
    *_, info = env.step(np.zeros(4, dtype=np.float32))
    assert "no longer finite" in info["sim_fault"]
    state = env.save_state()
    env.reset(seed=1)
    env.load_state(state)
    assert env.save_state() == state
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(4, dtype=np.float32))
