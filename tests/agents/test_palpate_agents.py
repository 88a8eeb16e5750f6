"""Agents for Palpate-v0 on blocks: the expert, the surrogate with a force formula, the shipped policy."""

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_apps.scoring.evaluate import policies_folder

pytestmark = pytest.mark.agents
pytest.importorskip("torch", reason="needs the `agents` extra")

ID = "SurgSim/Palpate-v0"
SMALL = {"scene": "phantom_small", "memory": True}


def surrogate(count: int):
    from surgsim_apps.training.palpate_surrogate import PalpateSurrogate

    return PalpateSurrogate(count)


# ---- the stand-in ---------------------------------------------------------------------------------------------------


def test_the_formula_presses_as_the_organ_does():
    """Down to 3.5 mm, away from the lesion: within 15 % or 15 mN, where the sensor's noise is 10 mN (standard)."""
    env = gym.make(ID, scene="phantom_small", scaled=False).unwrapped
    made = surrogate(1)
    made.reset(seed=0)
    compared = 0
    for seed in range(120):
        observation, _ = env.reset(seed=seed)
        task = env.task
        if np.linalg.norm(observation[:2] - task.lesion.centre[:2]) < 0.022 or compared == 2:
            continue
        while observation[2] > made.surface - 0.0035:
            observation, *_ = env.step(np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32))
        made.tip[0], made.excess[0] = observation[:3], 0.0
        felt, formula = env.simulation.contact_force[2], made.normal_force()[0]
        assert abs(felt - formula) < max(0.15 * felt, 0.015), (seed, felt, formula)
        compared += 1
    assert compared == 2


def test_its_memory_is_the_environments():
    """The observation's memory, recomputed from its first ten entries by `TouchMemory` itself."""
    from surgsim_apps.scoring.expert_palpate import PalpateExpert

    envs = surrogate(2)
    env = envs.envs[0]
    memory, expert = env.task.memory, PalpateExpert(env)
    memory.forget()
    observation, _ = envs.reset(seed=4)
    for _ in range(200):
        observation, _, terminated, truncated, _ = envs.step(expert.act(observation))
        assert not (terminated | truncated)[0]
        tip = envs.tip[0]
        surface, normal = env.task.anatomy.face.project(tip)
        depth = memory.indenter.radius - (tip - surface) @ normal
        seen = env.si_values(observation[0])
        memory.feel(memory.chart.place(surface), depth, float(seen[8]))
    assert memory.visited.sum() > 30
    slices = env.observation_slices
    np.testing.assert_allclose(seen[slices["contrast"]], memory.contrast, rtol=1e-4)
    np.testing.assert_array_equal(seen[slices["visited"]], memory.visited)
    np.testing.assert_allclose(seen[slices["stiffest"]], memory.stiffest(), rtol=1e-4)


def test_its_spaces_rewards_and_ends_are_the_environments():
    from surgsim_apps.scoring.expert_palpate import PalpateExpert

    envs = surrogate(16)
    assert envs.single_observation_space == gym.make(ID, **SMALL).observation_space
    expert = PalpateExpert(envs.envs[0])
    observation, _ = envs.reset(seed=0)
    total, steps, ends = np.zeros(16), np.zeros(16), []
    for _ in range(400):
        assert envs.single_observation_space.contains(observation[3])
        observation, reward, terminated, truncated, info = envs.step(expert.act(observation))
        total, steps = total + reward, steps + 1
        for index in np.flatnonzero(terminated | truncated):
            ends.append((info["final_info"]["success"][index], total[index], steps[index]))
            total[index] = steps[index] = 0.0
    assert len(ends) >= 16 and all(success for success, _, _ in ends)
    for _, value, length in ends:
        assert value == pytest.approx(10.0 - 0.005 * length)


def test_pressing_on_is_a_safety_stop_that_pays_least():
    envs = surrogate(4)
    envs.reset(seed=0)
    down = np.tile(np.array([0.0, 0.0, -1.0, 0.0], dtype=np.float32), (4, 1))
    step, terminated = 0, np.zeros(4, dtype=bool)
    while not terminated.any():
        _, reward, terminated, _, info = envs.step(down)
        step += 1
    index = int(np.flatnonzero(terminated)[0])
    assert info["final_info"]["hard_limit"][index] and not info["final_info"]["success"][index]
    # -5, the forgone steps, this step and its force beyond the soft limit.
    assert reward[index] == pytest.approx(-5.0 - 0.015 * (600 - step) - 0.005 - 0.010)


# ---- the expert -----------------------------------------------------------------------------------------------------


def test_the_expert_finds_the_lesion_gently_on_the_organ():
    from surgsim_apps.scoring.expert_palpate import PalpateExpert

    env = gym.make(ID, scene="phantom_small", level="standard", memory=True)
    expert = PalpateExpert(env)
    observation, _ = env.reset(seed=3)
    forces, over = [], False
    while not over:
        observation, _, terminated, truncated, info = env.step(expert.act(observation[None])[0])
        forces.append(info["force_peak"])
        over = terminated or truncated
    assert info["success"] and len(forces) < 300
    assert max(forces) < env.unwrapped.scene.limits.soft_force


def test_the_expert_refuses_what_it_cannot_do():
    from surgsim_apps.scoring.expert_palpate import PalpateExpert

    with pytest.raises(ValueError, match="make the environment with memory=True"):
        PalpateExpert(gym.make(ID))
    with pytest.raises(ValueError, match="'liver' is not a block: use phantom"):
        PalpateExpert(gym.make(ID, scene="liver", memory=True))


# ---- the shipped policy ---------------------------------------------------------------------------------------------


def test_the_shipped_policy_searches_as_it_was_taught():
    """By formula, which is quick: four of five find their lesion."""
    from surgsim_apps.training.policy_files import load_policy

    policy, envs = load_policy(policies_folder() / "palpate_phantom_small_scratch.json"), surrogate(32)
    observation, _ = envs.reset(seed=11)
    begins, first = np.ones(32, dtype=bool), np.full(32, np.nan)
    policy.reset(32)
    for _ in range(600):
        observation, _, terminated, truncated, info = envs.step(policy.act(observation, begins))
        begins = terminated | truncated
        for index in np.flatnonzero(begins & np.isnan(first)):
            first[index] = info["final_info"]["success"][index]
        if not np.isnan(first).any():
            break
    assert np.nan_to_num(first).mean() >= 0.8
