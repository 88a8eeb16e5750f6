"""Environments side by side give what each would give alone: held against gymnasium's SyncVectorEnv, to the bit."""

import copy
import pickle
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.coupling import exchange, simulation
from surgsim_env.envs.ids import PalpateEnv
from surgsim_env.envs.surgical_env import SurgicalEnv
from surgsim_env.envs.vector_env import vector_class

ID = "SurgSim/Palpate-v0"
COUNT = 3  # five lanes stay empty
DOWN = np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32)


def side_by_side(**settings) -> gym.vector.VectorEnv:
    return gym.make_vec(ID, num_envs=COUNT, vectorization_mode="vector_entry_point", **settings)


def one_after_the_other(mode: str, **settings) -> gym.vector.VectorEnv:
    kwargs = {"autoreset_mode": mode}
    return gym.make_vec(ID, num_envs=COUNT, vectorization_mode="sync", vector_kwargs=kwargs, **settings)


def actions(step: int) -> np.ndarray:
    """Down and about, so that episodes end at the hard limit at different times; the last one declares now and then."""
    random = np.random.default_rng(step)
    moves = np.clip(0.4 * random.normal(size=(COUNT, 4)) + [0.0, 0.0, -0.4, 0.0], -1.0, 1.0)
    moves[:, 3] = [0.0, 0.0, float(step % 11 > 6)]
    return moves.astype(np.float32)


def assert_equal(value: object, other: object) -> None:
    """Nested infos, arrays, numbers and strings, to the bit."""
    if isinstance(value, dict) and isinstance(other, dict):
        assert value.keys() == other.keys()
        for key in value:
            assert_equal(value[key], other[key])
    elif isinstance(value, tuple) or (isinstance(value, np.ndarray) and value.dtype == object):
        for left, right in zip(value, other, strict=True):
            assert_equal(left, right)
    else:
        np.testing.assert_array_equal(value, other)


@pytest.mark.parametrize(
    ("mode", "instrument"),
    [
        ("NextStep", "probe"),
        pytest.param("SameStep", "probe", marks=pytest.mark.slow),
        pytest.param("SameStep", "psm_palpator", marks=pytest.mark.slow),
    ],
)
def test_equals_environments_one_after_the_other(mode: str, instrument: str):
    """Observations, rewards, ends and infos of 45 control steps with several episodes each, and all that is saved."""
    together = side_by_side(autoreset_mode=mode, instrument=instrument)
    apart = one_after_the_other(mode, instrument=instrument)
    assert type(together) is vector_class(PalpateEnv)
    assert together.observation_space == apart.observation_space and together.action_space == apart.action_space
    assert_equal(together.reset(seed=11), apart.reset(seed=11))
    ends = 0
    for step in range(45):
        result, expected = together.step(actions(step)), apart.step(actions(step))
        assert_equal(result[:4], expected[:4])
        assert_equal(result[4], expected[4])
        ends += int((result[2] | result[3]).sum())
    assert ends >= 3
    for env, other in zip(together.envs, apart.envs, strict=True):  # type: ignore[attr-defined]
        assert env.unwrapped.save_state() == other.unwrapped.save_state()
    together.close()
    apart.close()


def test_disabled_resets_those_that_the_mask_names():
    together, apart = side_by_side(autoreset_mode="Disabled"), one_after_the_other("Disabled")
    assert_equal(together.reset(seed=2), apart.reset(seed=2))
    for step in range(3):
        assert_equal(together.step(actions(step)), apart.step(actions(step)))
    mask = np.array([False, True, False])
    assert_equal(
        together.reset(seed=[0, 7, 0], options={"reset_mask": mask}),
        apart.reset(seed=[0, 7, 0], options={"reset_mask": mask.copy()}),
    )
    for step in range(3, 6):
        assert_equal(together.step(actions(step)), apart.step(actions(step)))


def test_a_paused_environment_stays_as_it_is_until_it_is_reset():
    """The others go on as without it, to the bit; its own actions are not read."""
    paused, whole = side_by_side(autoreset_mode="Disabled"), side_by_side(autoreset_mode="Disabled")
    for envs in (paused, whole):
        envs.reset(seed=4)
        envs.step(actions(0))
    seen = paused.step(actions(1))[0][1]
    whole.step(actions(1))
    state = paused.envs[1].unwrapped.save_state()
    paused.pause(np.array([False, True, False]))
    for step in range(2, 5):
        given = actions(step)
        expected = whole.step(given)
        given[1] = np.nan
        result = paused.step(given)
        for lane in (0, 2):
            assert_equal(tuple(part[lane] for part in result[:4]), tuple(part[lane] for part in expected[:4]))
        np.testing.assert_array_equal(result[0][1], seen)
        assert (result[1][1], result[2][1], result[3][1]) == (0.0, False, False)
        assert not result[4]["_force_peak"][1] and result[4]["_force_peak"][0]
    assert paused.envs[1].unwrapped.save_state() == state
    paused.reset(seed=[0, 7, 0], options={"reset_mask": np.array([False, True, False])})
    paused.step(actions(5))
    assert paused.envs[1].unwrapped.simulation.time > 0.0


def test_an_environment_whose_episode_is_over_can_be_paused():
    """Gymnasium asks for a reset there; if all are paused, nothing at all is computed."""
    envs = side_by_side(autoreset_mode="Disabled", max_episode_steps=2)
    envs.reset(seed=0)
    still = np.zeros((COUNT, 4), dtype=np.float32)
    assert not envs.step(still)[3].any() and envs.step(still)[3].all()
    envs.pause(np.ones(COUNT, dtype=np.bool_))
    times = [env.unwrapped.simulation.time for env in envs.envs]
    _, rewards, terminated, truncated, infos = envs.step(still)
    assert not (rewards.any() or terminated.any() or truncated.any() or infos)
    assert [env.unwrapped.simulation.time for env in envs.envs] == times


def test_a_fault_leaves_the_neighbours_untouched():
    """A node of the middle organ is not a number any more: its episode ends, the others' bits are as without it."""
    spoilt, whole = side_by_side(autoreset_mode="SameStep"), side_by_side(autoreset_mode="SameStep")
    for envs in (spoilt, whole):
        envs.reset(seed=4)
        for step in range(4):
            envs.step(actions(step))
    spoilt.envs[1].unwrapped.simulation.organ_state.node_velocity[40, 1] = np.nan
    for step in range(4, 9):
        result, expected = spoilt.step(actions(step)), whole.step(actions(step))
        if step == 4:
            assert result[2][1] and "no longer finite" in result[4]["final_info"]["sim_fault"][1]
            assert np.isfinite(result[4]["final_obs"][1]).all() and np.isfinite(result[0]).all()
        for lane in (0, 2):
            np.testing.assert_array_equal(result[0][lane], expected[0][lane])
            assert result[1][lane] == expected[1][lane]


def test_states_are_saved_and_loaded_as_alone():
    """A state saved alone goes on in a lane, and the other way round."""
    envs, single = side_by_side(), gym.make(ID)
    envs.reset(seed=8)
    single.reset(seed=9)
    for step in range(5):
        envs.step(actions(step))
        single.step(actions(step)[1])
    state = envs.envs[1].unwrapped.save_state()
    assert state == single.unwrapped.save_state() == envs.call("save_state")[1]
    assert envs.get_attr("scaled") == (True,) * COUNT
    ahead = envs.step(actions(5))[0][1]
    envs.envs[0].unwrapped.load_state(state)
    np.testing.assert_array_equal(envs.step(np.tile(actions(5)[1], (COUNT, 1)))[0][0], ahead)


@pytest.mark.slow
def test_threads_and_the_number_of_environments_change_nothing():
    """Ten environments in two groups, on one thread and on two, against the first three alone."""
    runs = []
    for count, threads in ((10, 1), (10, 2), (COUNT, 1)):
        envs = vector_class(PalpateEnv)(count, threads=threads)
        envs.reset(seed=1)
        rows = [
            envs.step(np.concatenate([actions(step), np.tile(DOWN, (count - COUNT, 1))]))[0][:COUNT]
            for step in range(6)
        ]
        runs.append(np.array(rows))
        envs.close()
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_a_bad_action_is_refused_before_any_lane_is_commanded():
    """The message has the lane and its way out; what is saved, commands of the other lanes included, is as before."""
    envs = side_by_side()
    envs.reset(seed=0)
    before = [env.save_state() for env in envs.envs]
    bad = np.full((COUNT, 4), 0.5, dtype=np.float32)
    bad[2, 1] = 1.5
    with pytest.raises(ValueError, match=r"lane 2: action\[1\] is 1\.5.*gymnasium\.wrappers\.vector\.ClipAction"):
        envs.step(bad)
    with pytest.raises(ValueError, match=r"actions have shape \(2, 4\); the rule is \(3, 4\)"):
        envs.step(bad[:2])
    assert [env.save_state() for env in envs.envs] == before
    gym.wrappers.vector.ClipAction(envs).step(bad)


def test_an_ended_episode_is_refused_in_mode_disabled():
    envs = side_by_side(autoreset_mode="Disabled", max_episode_steps=1)
    envs.reset(seed=0)
    still = np.zeros((COUNT, 4), dtype=np.float32)
    assert envs.step(still)[3].all()
    with pytest.raises(gym.error.ResetNeeded, match="lane 0, lane 1, lane 2: the episode is over"):
        envs.step(still)
    envs.reset(options={"reset_mask": np.array([True, False, False])})
    with pytest.raises(gym.error.ResetNeeded, match=r"^lane 1, lane 2: the episode is over"):
        envs.step(still)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seed": [1, 2]}, "2 seeds are given for 3 environments"),
        (
            {"options": {"reset_mask": np.ones(2, dtype=np.bool_)}},
            r"reset_mask is bool \(2,\); the rule is bool \(3,\)",
        ),
        ({"options": {"reset_mask": np.ones(3)}}, r"reset_mask is float64 \(3,\)"),
        ({"options": {"other": 1}}, "reset option 'other' is unknown"),
    ],
)
def test_a_reset_that_does_not_fit_is_refused(given: dict, message: str):
    with pytest.raises(ValueError, match=message):
        side_by_side().reset(**given)


def test_an_environment_without_an_episode_is_named():
    envs = side_by_side()
    with pytest.raises(gym.error.ResetNeeded, match="lane 1"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})


def test_last_observations_of_tables_are_those_of_environments_one_after_the_other():
    settings = {"obs_mode": "rgb_force", "max_episode_steps": 1}
    results = []
    for envs in (side_by_side(autoreset_mode="SameStep", **settings), one_after_the_other("SameStep", **settings)):
        envs.reset(seed=5)
        results.append(envs.step(actions(0)))
    assert_equal(*results)


def test_a_pause_that_does_not_fit_is_refused():
    for mask in (np.ones(2, dtype=np.bool_), np.ones(3)):
        with pytest.raises(ValueError, match="mask is "):
            side_by_side().pause(mask)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("num_envs", value) for value in (0, -1, "4", 2.0, None)),
        *(("threads", value) for value in (0, 1.5, "2")),
        *(("max_episode_steps", value) for value in (0, 1.5, "3")),
        *(("dtype", value) for value in ("FLOAT64", "float16", None)),
        *(("autoreset_mode", value) for value in ("foo", None, 1)),
    ],
)
def test_wrong_arguments_are_named(name: str, value: object):
    with pytest.raises(ValueError) as error:
        vector_class(PalpateEnv)(**{"num_envs": 2, "scene": "phantom_small", name: value})
    assert name in str(error.value) and repr(value) in str(error.value)


@pytest.mark.parametrize("duplicate", [pickle.dumps, copy.deepcopy])
def test_a_vector_environment_refuses_a_copy_and_its_environments_give_one(duplicate):
    envs = side_by_side()
    with pytest.raises(TypeError, match="PalpateVectorEnv"):
        duplicate(envs)
    duplicate(envs.envs)


def test_compiled_code_is_three_calls_below_step(monkeypatch: pytest.MonkeyPatch):
    """Python frames from `step`, itself included, to the call of the compiled loop."""
    counts = []

    def haptic_loop(*, compiled: bool):
        def advance(*arguments):
            frame: Any = sys._getframe(1)
            count = 1
            while frame.f_code is not SurgicalEnv.step.__code__:
                frame, count = frame.f_back, count + 1
            counts.append(count)
            return loop(*arguments)

        loop = exchange.haptic_loop(compiled=compiled)
        return advance

    monkeypatch.setattr(simulation, "haptic_loop", haptic_loop)
    env = PalpateEnv(scene="phantom_small")
    env.reset(seed=0)
    env.step(DOWN)
    assert counts == [3]
