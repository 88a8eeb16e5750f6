"""Learning from scratch: a curriculum of rewards, a new policy's first actions, sampled policies, the touch summary."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.agents
pytest.importorskip("sb3_contrib", reason="needs the `agents` extra")

PALPATION = {"id": "SurgSim/Palpate-v0", "kind": "surrogate", "count": 3}
SMALL = {"scene": "phantom_small", "memory": True}
HYPERPARAMETERS = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}


def environments(stage: dict | None, **changes):
    """Environments with the rewards of a stage, or bare ones."""
    from surgsim_env.training.config import EnvironmentSettings, Stage
    from surgsim_env.training.environments import StagedRewards, make_environments

    bare = make_environments(EnvironmentSettings(**{**PALPATION, "kwargs": SMALL, **changes}))
    return bare if stage is None else StagedRewards(bare, Stage(**stage))


def pressed_down(stage: dict | None, **changes):
    """Rewards and sites felt, (n_step, n_env) each, and the last infos, of a way straight down to the hard limit."""
    envs = environments(stage, **changes)
    envs.seed(3)
    envs.reset()
    visited = envs.get_attr("unwrapped", indices=[0])[0].task.observation_slices["visited"]
    rewards, felt, last = [], [], [{}] * envs.num_envs
    down = np.tile(np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32), (envs.num_envs, 1))
    for _ in range(60):
        observation, reward, done, infos = envs.step(down)
        rewards.append(reward)
        felt.append(np.asarray(observation)[:, visited].sum(axis=1))
        last = [info if over else old for info, over, old in zip(infos, done, last, strict=True)]
        if all(last):
            break
    return np.array(rewards), np.array(felt), last


def test_a_stage_pays_its_share_of_a_failure_and_nothing_else():
    bare, _, ends = pressed_down(None)
    full, _, _ = pressed_down({})
    none, _, _ = pressed_down({"failure": 0.0})
    some, _, _ = pressed_down({"failure": 0.25})
    assert all(end["hard_limit"] for end in ends)
    np.testing.assert_array_equal(full, bare)
    # A failure costs 5 and 0.015 for each control step left; what remains are time and force, at most 0.015 a step.
    assert bare.min() < -12.0 and none.min() >= -0.0151
    np.testing.assert_allclose(some, none + 0.25 * (bare - none), atol=1e-5)
    assert (none[bare > -1.0] == bare[bare > -1.0]).all()


def test_each_site_pays_once_in_an_episode():
    bare, felt, _ = pressed_down(None)
    paid, _, _ = pressed_down({"novelty": 0.5})
    before = np.vstack([np.zeros(felt.shape[1]), felt[:-1]])
    ended = bare < -1.0
    new = np.where(ended, 0.0, felt - before)
    assert new.sum() == felt.shape[1]  # straight down: one site each
    np.testing.assert_allclose(paid - bare, 0.5 * new, atol=1e-6)


@pytest.mark.parametrize(("near", "paid_as_right"), [(0.0, False), (0.05, True)])
def test_a_near_declaration_is_paid_as_a_right_one(near: float, paid_as_right: bool):
    envs = environments({"failure": 0.5, "near": near})
    bare = environments(None)
    rewards, ends = [], []
    for one in (envs, bare):
        one.seed(4)
        one.reset()
        # Down into the tissue, and the lesion declared at once: on 30 mm no place is 50 mm away.
        act = np.tile(np.array([0.0, 0.0, -0.5, 1.0], dtype=np.float32), (3, 1))
        seen = [one.step(act) for _ in range(20)]
        rewards.append(np.array([reward for _, reward, _, _ in seen]))
        ends.append([(done, infos) for _, _, done, infos in seen])
    wrong = 0
    for step, (done, infos) in enumerate(ends[0]):
        for index in np.flatnonzero(done):
            assert infos[index]["declared"]
            if infos[index]["success"]:
                continue
            wrong += 1
            cost = infos[index]["reward_wrong"] + infos[index]["reward_forgone"]
            # A right declaration pays 10 and costs nothing; a wrong one costs half here.
            added = 10.0 - cost if paid_as_right else -0.5 * cost
            assert cost < -5.0 and rewards[0][step, index] == pytest.approx(rewards[1][step, index] + added, abs=1e-4)
    assert wrong


def test_novelty_needs_a_touch_map():
    with pytest.raises(ValueError, match=r"pays 0.5 .* no touch map.*memory: true"):
        environments({"novelty": 0.5}, kwargs={"scene": "phantom_small", "memory": False})
    envs = environments({}, kwargs={"scene": "phantom_small", "memory": False})
    from surgsim_env.training.config import Stage

    with pytest.raises(ValueError, match="no touch map"):
        envs.stage = Stage(novelty=0.1)


# ---- configurations and runs -----------------------------------------------------------------------------------


def config(**changes):
    from surgsim_env.scene.load import fill
    from surgsim_env.training.config import TrainingConfig

    table = {
        "name": "tiny",
        "algorithm": "PPO",
        "environment": {**PALPATION, "kwargs": SMALL, "action_repeat": 5, "normalize_observation": False},
        "total_steps": 96,
        "hyperparameters": {**HYPERPARAMETERS, "policy_kwargs": {"features_extractor_class": "TouchSummary"}},
        "evaluation": {"every": 0},
        "checkpoint": {"every": 48},
    }
    return fill(TrainingConfig, table | changes, "test")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stages": [{"failure": 1.5}]}, "stage.failure is 1.5; it is a share"),
        ({"stages": [{"novelty": -0.1}]}, "stage.novelty is -0.1"),
        ({"stages": [{"near": -0.01}]}, "stage.near is -0.01; it is a distance in m"),
        ({"stages": [{"begin": 5}]}, r"stages begin at \[5\]; the first begins at 0"),
        ({"stages": [{}, {"begin": 9}, {"begin": 9}]}, r"stages begin at \[0, 9, 9\]"),
        ({"stages": [{"novlty": 0.1}]}, "did you mean 'novelty'"),
        ({"initial_spread": [0.5, 0.0]}, r"initial_spread is \[0.5, 0.0\]; standard deviations are above 0"),
        ({"initial_spread": [0.5], "warm_start": "x.safetensors"}, "warm_start names a trained one"),
        ({"initial_action": [0.5], "warm_start": "x.safetensors"}, "initial_action is of a new policy"),
    ],
)
def test_wrong_entries_are_refused(change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        config(**change)


def test_a_run_goes_through_its_stages_also_when_it_is_resumed(tmp_path: Path):
    from surgsim_env.training.config import Stage
    from surgsim_env.training.run import BetweenRollouts, Run, train

    stages = [{"failure": 0.0, "novelty": 0.1}, {"begin": 48, "failure": 0.5}, {"begin": 96}]
    settings = config(stages=stages)
    run = Run(settings, tmp_path)
    assert run.staged is not None and run.staged.stage == Stage(0, 0.0, 0.1)
    run.model.learn(96, BetweenRollouts(run))
    assert run.staged.stage == Stage(48, 0.5, 0.0)
    run.save()
    run.bare.close()
    resumed = Run(replace(settings, total_steps=144), tmp_path)
    assert resumed.resumed_from is not None and resumed.staged is not None
    resumed.between_rollouts()
    assert resumed.staged.stage == Stage(96)
    resumed.bare.close()
    assert train(replace(settings, total_steps=144), tmp_path) == 144


def test_a_new_policy_begins_with_the_actions_of_the_configuration(tmp_path: Path):
    from surgsim_env.training.run import Run

    given = {"initial_action": [0.0, 0.1, 0.2, -0.4], "initial_spread": [0.8, 0.7, 0.4, 0.5]}
    run = Run(config(**given), tmp_path / "ppo")
    policy = run.model.policy
    np.testing.assert_allclose(policy.log_std.detach().exp(), given["initial_spread"], rtol=1e-6)
    # Orthogonal weights of gain 0.01 on 64 features in [-1, 1]: means lie near the bias.
    action = policy.predict(np.asarray(run.bare.reset()), deterministic=True)[0]
    np.testing.assert_allclose(action, np.tile(given["initial_action"], (3, 1)), atol=0.08)
    run.bare.close()
    with pytest.raises(ValueError, match="initial_spread has 3 values; an action has 4 entries"):
        Run(config(initial_spread=[0.1, 0.1, 0.1]), tmp_path / "three")
    with pytest.raises(ValueError, match="initial_action: the actions of SAC are not Gaussian with one standard"):
        Run(config(algorithm="SAC", hyperparameters={}, initial_action=[0.0] * 4), tmp_path / "sac")


def test_a_sampled_policy_repeats_its_draws_and_leaves_torchs_alone(tmp_path: Path):
    import torch

    from surgsim_env.training.policy_files import TrainedPolicy, load_policy, save_policy
    from surgsim_env.training.run import Run

    run = Run(config(evaluation={"every": 0, "sampled": True}), tmp_path / "run")
    seen = np.asarray(run.bare.reset())
    save_policy(run.model.policy, run.description(), tmp_path / "policy.safetensors")
    policy = load_policy(tmp_path / "policy.safetensors")
    assert policy.description.sampled
    once = TrainedPolicy(policy.networks, replace(policy.description, action_repeat=1))
    mean = TrainedPolicy(policy.networks, replace(policy.description, action_repeat=1, sampled=False))
    state = torch.get_rng_state()
    rows = []
    for _ in range(2):
        once.reset(3)
        rows.append(np.array([once.act(seen) for _ in range(400)]))
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(rows[0], rows[1])
    mean.reset(3)
    # 400 draws of a unit normal, cut to [-1, 1]: variance 0.516, so that a mean is off by 3 x 0.72 / 20 at most.
    assert rows[0].std(axis=0).min() > 0.6
    np.testing.assert_allclose(rows[0].mean(axis=0), mean.act(seen), atol=0.15)
    run.bare.close()


# ---- the touch summary ------------------------------------------------------------------------------------------


def test_the_touch_summary_is_what_it_says():
    import torch

    from surgsim_env.training.extractors import TouchSummary

    envs = environments(None, count=8, kind="surrogate")
    envs.seed(5)
    observation = np.asarray(envs.reset())
    rng = np.random.default_rng(0)
    extractor = TouchSummary(envs.observation_space)
    assert (extractor(torch.tensor(observation))[:, 8:10] == 0.0).all()
    for step in range(40):
        way = np.column_stack([rng.uniform(-1.0, 1.0, (8, 2)), np.full(8, -0.3 if step < 25 else 0.0), np.zeros(8)])
        observation = np.asarray(envs.step(way.astype(np.float32))[0])
    features = extractor(torch.tensor(observation)).numpy()
    assert features.shape == (8, extractor.features_dim) == (8, 16)
    env = envs.get_attr("unwrapped", indices=[0])[0]
    channel = {name: env.si_values(observation)[:, part] for name, part in env.task.observation_slices.items()}
    felt = channel["visited"].sum(axis=1)
    assert (felt > 0).any()
    for row in np.flatnonzero(felt):
        sites = channel["visited"][row] > 0.5
        mean, most = channel["contrast"][row][sites].mean(), channel["stiffest"][row, 2]
        share = felt[row] / channel["face"][row].sum()
        np.testing.assert_allclose(features[row, 8:11], [share, 1.0, mean], rtol=1e-4)
        np.testing.assert_allclose(features[row, 11], np.clip(4.0 * (most / max(mean, 0.1) - 1.0), -4, 4), atol=1e-3)
        # The outermost sites lie up to half a cell, 2 mm, nearer to the middle than the summary takes them to be.
        place = env.task.memory.chart.plane_point(channel["stiffest"][row, :2])
        np.testing.assert_allclose(features[row, 12:14], (place - channel["tip_position"][row, :2]) / 0.01, atol=0.21)
        # The mean way to sites not felt, of the touch map's own sites.
        sites = env.task.memory.chart.plane_point(env.task.memory.map.places)
        tip = channel["tip_position"][row, :2]
        unfelt = channel["face"][row] * (1.0 - channel["visited"][row])
        unfelt = unfelt * np.exp(-0.5 * ((sites - tip) ** 2).sum(axis=1) / 0.008**2)
        np.testing.assert_allclose(features[row, 14:], (unfelt @ sites / unfelt.sum() - tip) / 0.01, atol=0.21)
    np.testing.assert_allclose(features[:, 3], 4.0 * channel["contact_force"][:, 2] / 0.5, rtol=1e-4, atol=1e-4)
    assert np.abs(features).max() < 8.0


def test_the_touch_summary_refuses_an_observation_without_memory():
    from surgsim_env.training.extractors import TouchSummary

    envs = environments(None, kwargs={"scene": "phantom_small", "memory": False})
    with pytest.raises(ValueError, match="not that of Palpate-v0 with memory=True"):
        TouchSummary(envs.observation_space)


# ---- curves -----------------------------------------------------------------------------------------------------


def test_curves_are_drawn_over_control_steps(tmp_path: Path, monkeypatch):
    from matplotlib.image import imread

    from agents import learning_curves

    curve, out = tmp_path / "seed0.csv", tmp_path / "deeper" / "curve.png"
    curve.write_text("steps,return,success\n20000,-1.5,0.25\n40000,3,0.875\n")
    assert learning_curves.read_curve(curve, 5) == ([0.1, 0.2], [25.0, 87.5])
    monkeypatch.setattr("sys.argv", ["learning_curves", str(curve), "--action-repeat", "5", "--out", str(out)])
    learning_curves.main()
    assert len(np.unique(imread(out).reshape(-1, 4), axis=0)) > 10
    for wrong in ("steps,return\n1,2\n", "steps,success\n1,x\n"):
        curve.write_text(wrong)
        with pytest.raises(ValueError, match="needs columns steps and success"):
            learning_curves.read_curve(curve, 5)
    with pytest.raises(ValueError, match="cannot be read"):
        learning_curves.read_curve(tmp_path / "none.csv", 5)
