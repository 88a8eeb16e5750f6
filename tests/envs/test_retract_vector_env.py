"""SurgSim/Retract-v0 side by side: lobes of different sizes, held differently, each as it is alone, to the bit."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.envs.ids import RetractEnv
from surgsim_env.envs.vector_env import vector_class
from tests.envs.test_vector_env import assert_equal

ID = "SurgSim/Retract-v0"
COUNT = 3  # five lanes stay empty
# Draws whose lobes are held on different shares of their edge: their surfaces differ by some triangles.
SEED = 5


def side_by_side(**settings) -> gym.vector.VectorEnv:
    return gym.make_vec(ID, num_envs=COUNT, vectorization_mode="vector_entry_point", **settings)


def one_after_the_other(mode: str, **settings) -> gym.vector.VectorEnv:
    return gym.make_vec(
        ID, num_envs=COUNT, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **settings
    )


def goals(envs: gym.vector.VectorEnv) -> np.ndarray:
    """Each jaw's goal: over the target, deep enough over the edge [m] (n_env, 3)."""
    targets = np.array([env.unwrapped.task.target.centre for env in envs.envs])  # type: ignore[attr-defined]
    return np.column_stack([targets[:, 0], np.full(len(targets), 0.048), np.full(len(targets), 0.005)])


def action(observation: np.ndarray, goal: np.ndarray, *, grasp: bool, size: int) -> np.ndarray:
    """To the goal with the jaw open; then closed, up and out, which folds, slips or tears."""
    moves = np.zeros((len(observation), size), dtype=np.float32)
    away = np.array([0.0, 0.6, 0.8])
    moves[:, :3] = away if grasp else np.clip((goal - observation[:, :3]) / 0.001, -1.0, 1.0)
    moves[:, -1] = -1.0 if grasp else 1.0
    return moves


@pytest.mark.parametrize(
    ("mode", "instrument"),
    [
        pytest.param("NextStep", None, marks=pytest.mark.slow),
        pytest.param("SameStep", None, marks=pytest.mark.slow),
        pytest.param("SameStep", "psm_retractor", marks=pytest.mark.slow),
    ],
)
def test_equals_environments_one_after_the_other(mode: str, instrument: str | None):
    """Approach, grasp and pull, over an episode's end: observations, rewards, ends, infos, and all that is saved."""
    steps, closes = (75, 45) if instrument is None else (24, 8)
    settings = {"instrument": instrument, "max_episode_steps": steps - 5}
    together, apart = side_by_side(autoreset_mode=mode, **settings), one_after_the_other(mode, **settings)
    assert type(together) is vector_class(RetractEnv)
    assert together.observation_space == apart.observation_space and together.action_space == apart.action_space
    first = together.reset(seed=SEED)
    assert_equal(first, apart.reset(seed=SEED))
    observation, goal = first[0], goals(together)
    size, held, ends = together.single_action_space.shape[0], 0, 0  # type: ignore[index]
    for step in range(steps):
        moves = action(observation, goal, grasp=step >= closes, size=size)
        result, expected = together.step(moves), apart.step(moves)
        assert_equal(result[:4], expected[:4])
        assert_equal(result[4], expected[4])
        observation = result[0]
        held += int(result[4]["holds"].sum()) if "holds" in result[4] else 0
        ends += int((result[2] | result[3]).sum())
    assert ends >= COUNT
    assert held > 0 or instrument is not None, "the grasper grasps"
    for env, other in zip(together.envs, apart.envs, strict=True):  # type: ignore[attr-defined]
        assert env.unwrapped.save_state() == other.unwrapped.save_state()  # type: ignore[attr-defined]
    models = [env.unwrapped.simulation.organ_model for env in together.envs]  # type: ignore[attr-defined]
    assert len({float(model.node_rest_position.max()) for model in models}) == COUNT, "sizes differ"
    together.close()
    apart.close()


def test_lobes_on_moving_ground_equal_environments_one_after_the_other():
    """A ventilated patient: each lobe's nodes are carried from places of their own, by anchors of their own."""
    together, apart = side_by_side(motion="calm"), one_after_the_other("NextStep", motion="calm")
    assert_equal(together.reset(seed=SEED), apart.reset(seed=SEED))
    for _ in range(3):
        moves = np.full(together.action_space.shape, -0.3, dtype=np.float32)  # type: ignore[arg-type]
        assert_equal(together.step(moves), apart.step(moves))
    models = [env.unwrapped.simulation.organ_model for env in together.envs]  # type: ignore[attr-defined]
    assert len({len(model.motion_anchored_nodes) for model in models}) > 1, "held on different shares of their edge"
    together.close()
    apart.close()
