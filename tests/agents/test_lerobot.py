"""LeRobot writes what is recorded here, reads it back, and plays the environments."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from surgsim_env.rendering import gl

pytestmark = pytest.mark.lerobot
pytest.importorskip("lerobot", reason="needs LeRobot 0.6 (`make test-lerobot`)")
torch = pytest.importorskip("torch", reason="needs LeRobot 0.6 (`make test-lerobot`)")

ID = "SurgSim/Palpate-v0"
STATE, ACTION, WRENCH = "observation.state", "action", "observation.meta.force_torque"
ENV_FILE = Path(__file__).resolve().parents[2] / "agents" / "envhub" / "env.py"


@pytest.fixture(autouse=True, scope="module")
def without_network(tmp_path_factory):
    """Everything lies on the disk; what LeRobot keeps beside it goes into a folder of the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("HF_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def with_pictures():
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")


def record(folder, *more, arguments=None, env_id=ID):
    from agents.record_demonstrations import main

    named = ["--format", "lerobot", "--dataset", str(folder), "--env-arguments", json.dumps(arguments or {})]
    main([env_id, *named, *more])


def read(folder):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("surgsim/palpate", root=folder)


def test_states_actions_and_wrenches_come_back_to_the_bit(tmp_path):
    """Two oracle episodes of which one fails, as its time is short; seed and actions give the frames again."""
    short = {"max_episode_steps": 45}
    record(tmp_path / "set", "--episodes", "2", "--first-seed", "3", "--keep-failures", arguments=short)
    dataset = read(tmp_path / "set")
    made = json.loads((tmp_path / "set/meta/surgsim.json").read_text())
    assert dataset.meta.info.codebase_version == "v3.0" and dataset.fps == 20
    assert made["seeds"] == [3, 4] and made["env_id"] == ID and made["physics_version"] == 1
    env, frames, solved = gym.make(ID, **short), iter(dataset), []
    for seed in made["seeds"]:
        env.reset(seed=seed)
        ended = False
        while not ended:
            frame = next(frames)
            assert frame["task"] == "Find a hidden lesion by touch."
            assert frame[STATE].numpy().tobytes() == env.unwrapped.task_observation.tobytes()
            assert frame[WRENCH].shape == (6,)
            _, reward, terminated, truncated, info = env.step(frame[ACTION].numpy())
            ended = terminated or truncated
            assert np.float32(reward) == frame["next.reward"].numpy() and bool(frame["next.done"]) == ended
            assert bool(frame["next.success"]) == info["success"]
        solved.append(info["success"])
    assert next(frames, None) is None and solved == [False, True]
    assert np.stack(dataset.hf_dataset[WRENCH])[:, :3].max() > 0.1, "the tip presses the tissue"


def test_the_state_is_in_si_units():
    """(value - origin) / scale is what the environment observes; full_command is what an entry of 1 commands."""
    from agents.lerobot_dataset import features

    env = gym.make(ID)
    observation, _ = env.reset(seed=3)
    described = features(env)
    state, seen = described[STATE], env.unwrapped.task_observation
    scaled = (seen - np.array(state["origin"])) / np.array(state["scale"])
    np.testing.assert_allclose(scaled, observation, rtol=1e-6, atol=1e-6)
    assert state["names"][:3] == ["tip_position_x", "tip_position_y", "tip_position_z"]
    assert described[ACTION]["full_command"] == [0.02, 0.02, 0.02, 1.0]
    wrench = features(gym.make("SurgSim/BimanualRetract-v0"))[WRENCH]
    assert wrench["shape"] == (12,) and wrench["names"][0] == "left_force_x"


def test_pictures_are_read_at_the_times_of_their_frames(tmp_path):
    with_pictures()
    record(tmp_path / "seen", "--episodes", "1", "--images", "endoscope", "--image-size", "96", "64")
    dataset = read(tmp_path / "seen")
    env = gym.make(ID, width=96, height=64, show_force=False)
    env.reset(seed=0)
    for frame in dataset:
        picture = frame["observation.images.endoscope"]
        assert picture.shape == (3, 64, 96)
        drawn = env.unwrapped.renderer.rgb("endoscope")
        # LeRobot's AV1 leaves some of 255 grey levels.
        assert np.abs(picture.numpy().transpose(1, 2, 0) * 255.0 - drawn).mean() < 10.0
        env.step(frame[ACTION].numpy())
    env.close()


def test_what_cannot_be_recorded_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is there already: name a new folder"):
        record(tmp_path)
    with pytest.raises(ValueError, match="a whole press, and frames of a data set are one control step apart"):
        record(tmp_path / "sites", env_id="SurgSim/PalpateSites-v0")
    with pytest.raises(ValueError, match="--images is for --format lerobot"):
        record(tmp_path / "minari", "--images", "side", "--format", "minari")


class Idle(torch.nn.Module):
    """A policy that commands more than is allowed, and keeps what it saw."""

    def reset(self):
        self.seen = []

    def select_action(self, batch):
        self.seen.append({name: part.shape for name, part in batch.items() if isinstance(part, torch.Tensor)})
        return torch.full((len(batch[STATE]), 4), 2.0)


def test_lerobot_plays_what_its_hub_gives(monkeypatch):
    """`make_env` of a repository's env.py, here from the disk, and a roll-out as `lerobot-eval` makes it."""
    from lerobot.envs import factory
    from lerobot.envs.configs import EnvConfig
    from lerobot.scripts.lerobot_eval import rollout

    # Other tests import the file as a plugin, in this process.
    monkeypatch.setattr(EnvConfig, "_choice_registry", {})
    hub_file = ("surgsim/envs", "env.py", str(ENV_FILE), None)
    monkeypatch.setattr(factory, "_download_hub_file", lambda *given: hub_file)
    envs = factory.make_env("surgsim/envs", n_envs=2, trust_remote_code=True)
    assert list(envs) == ["SurgSim/Palpate-v0", "SurgSim/Retract-v0", "SurgSim/BimanualRetract-v0"]
    policy, same = Idle(), lambda value: value
    played = rollout(envs[ID][0], policy, same, same, same, same, seeds=[3, 4])
    assert bool(played["done"].any(dim=1).all()) and played["success"].shape[0] == 2
    assert policy.seen[0][WRENCH] == (2, 6) and len(policy.seen[0][STATE]) == 2


def test_lerobot_eval_plays_an_id(tmp_path, monkeypatch):
    """The command, with an untrained policy on pictures."""
    with_pictures()
    from lerobot.scripts.lerobot_eval import main

    arguments = ["--env.discover_packages_path=agents.envhub", "--env.type=surgsim", f"--env.task={ID}"]
    arguments += ["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--eval.batch_size=1"]
    arguments += [
        "--eval.n_episodes=1",
        "--policy.pretrained_backbone_weights=null",
        "--env.cameras=[endoscope]",
        f"--output_dir={tmp_path}",
    ]
    arguments += ['--env.arguments={"max_episode_steps": 3, "width": 96, "height": 64}']
    monkeypatch.setattr("sys.argv", ["lerobot-eval", *arguments])
    main()
    assert (tmp_path / "eval_info.json").is_file()
