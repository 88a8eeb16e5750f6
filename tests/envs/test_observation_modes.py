"""Observations as a vector or by the names of its channels, and refused arguments."""

import gymnasium as gym
import numpy as np
import pytest

SMALL = {"SurgSim/Palpate-v0": {"scene": "phantom_small", "memory": "summary"}, "SurgSim/Retract-v0": {}}


@pytest.mark.parametrize("id", SMALL)
def test_a_dictionary_has_the_entries_of_the_vector_by_name(id):
    plain, named = gym.make(id, **SMALL[id]), gym.make(id, obs_mode="dict", **SMALL[id])
    slices = {name: part for name, part in plain.unwrapped.observation_slices.items() if part.start < part.stop}
    assert set(named.observation_space) == set(slices)
    (vector, _), (table, _) = plain.reset(seed=3), named.reset(seed=3)
    for _ in range(3):
        assert named.observation_space.contains(table)
        for name, part in slices.items():
            np.testing.assert_array_equal(table[name], vector[part])
        action = plain.action_space.sample()
        vector, table = plain.step(action)[0], named.step(action)[0]
    assert gym.spaces.flatten_space(named.observation_space).shape == plain.observation_space.shape


def test_side_by_side_too():
    kwargs = {"num_envs": 2, "vectorization_mode": "vector_entry_point", "obs_mode": "dict", "scene": "phantom_small"}
    envs = gym.make_vec("SurgSim/Palpate-v0", **kwargs)
    table, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(table) and table["tip_depth"].shape == (2, 1)
    # Copies: the next step leaves them.
    before = table["tip_position"].copy()
    envs.step(np.full((2, 4), -1.0, dtype=np.float32))
    np.testing.assert_array_equal(table["tip_position"], before)


def test_a_wrong_argument_is_refused_with_all_that_there_are():
    with pytest.raises(ValueError, match=r"'scnee'.*scene, instrument.*level.*memory.*camera.*did you mean 'scene'"):
        gym.make("SurgSim/Palpate-v0", scnee="liver")
