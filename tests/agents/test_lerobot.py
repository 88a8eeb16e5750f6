"""LeRobot's own class reads what is recorded here, and a policy is cloned through its loader."""

import json

import numpy as np
import pytest

from surgsim_env.rendering import gl

pytestmark = pytest.mark.lerobot
# LeRobot 0.3 is the last that reads format v2.1.
pytest.importorskip("lerobot", reason="needs LeRobot 0.3 (`make test-lerobot`)")
torch = pytest.importorskip("torch", reason="needs LeRobot 0.3 (`make test-lerobot`)")

STATE, ACTION, WRENCH = "observation.state", "action", "observation.meta.force_torque"


@pytest.fixture(autouse=True, scope="module")
def without_network(tmp_path_factory):
    """Everything lies on the disk; what LeRobot keeps beside it goes into a folder of the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("HF_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def record(folder, *more, arguments=None):
    from agents.record_demonstrations import main

    named = ["--format", "lerobot", "--dataset", str(folder), "--env-arguments", json.dumps(arguments or {})]
    main(["SurgSim/Palpate-v0", *named, *more])


def read(folder, **options):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("surgsim/palpate", root=folder, **options)


def stored(folder, index, name):
    """A column of an episode as pyarrow reads it."""
    import pyarrow.parquet as pq

    rows = pq.read_table(folder / f"data/chunk-000/episode_{index:06d}.parquet")[name].to_pylist()
    return np.array(rows, dtype=np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four oracle episodes of which two fail, as their time is short."""
    path = tmp_path_factory.mktemp("lerobot") / "palpate"
    short = {"max_episode_steps": 45}
    record(path, "--episodes", "4", "--first-seed", "3", "--keep-failures", arguments=short)
    return path


def test_lerobot_reads_every_byte(folder):
    dataset = read(folder)
    assert dataset.meta.info["codebase_version"] == "v2.1" and dataset.fps == 20
    assert dataset.num_episodes == 4 and dataset.meta.info["splits"]["failure"] == "2:4"
    assert list(dataset.meta.tasks.values()) == ["Find a hidden lesion by touch."]
    assert len(dataset) == dataset.meta.total_frames == sum(one["length"] for one in dataset.meta.episodes.values())
    for name in (STATE, ACTION, WRENCH):
        wanted = np.concatenate([stored(folder, index, name) for index in range(4)])
        found = np.stack([dataset[index][name].numpy() for index in range(len(dataset))])
        assert found.dtype == np.float32 and found.tobytes() == wanted.tobytes()
        np.testing.assert_allclose(dataset.meta.stats[name]["mean"], wanted.mean(axis=0), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(dataset.meta.stats[name]["std"], wanted.std(axis=0), rtol=1e-4, atol=1e-6)
    last = dataset[len(dataset) - 1]
    assert bool(last["next.done"]) and not bool(last["next.success"]) and last["task"].startswith("Find")


def test_a_split_and_several_times_are_read(folder):
    """The range of a split is a list of episodes; actions of the next steps come along, repeated at the end."""
    first, end = map(int, json.loads((folder / "meta/info.json").read_text())["splits"]["success"].split(":"))
    dataset = read(folder, episodes=list(range(first, end)), delta_timestamps={ACTION: [0.0, 0.05, 0.1]})
    actions = stored(folder, 0, ACTION)
    np.testing.assert_array_equal(dataset[0][ACTION].numpy(), actions[:3])
    last = dataset[len(actions) - 1]
    np.testing.assert_array_equal(last[ACTION].numpy(), actions[[-1, -1, -1]])
    assert last["action_is_pad"].tolist() == [False, True, True]
    assert dataset.num_episodes == 2


def test_pictures_are_read_at_the_times_of_their_frames(tmp_path):
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    import gymnasium as gym

    size = ["--image-size", "96", "64"]
    record(tmp_path / "seen", "--episodes", "2", "--images", "endoscope", *size)
    dataset = read(tmp_path / "seen", video_backend="pyav")
    env = gym.make("SurgSim/Palpate-v0", width=96, height=64, show_force=False)
    env.reset(seed=dataset.meta.episodes[0]["seed"])
    for index in range(dataset.meta.episodes[0]["length"]):
        frame = dataset[index]
        picture = frame["observation.images.endoscope"]
        assert picture.shape == (3, 64, 96)
        drawn = env.unwrapped.renderer.rgb("endoscope")
        # H.264 at constant quality 23 leaves a few of 255 grey levels.
        assert np.abs(picture.numpy().transpose(1, 2, 0) * 255.0 - drawn).mean() < 6.0
        env.step(frame[ACTION].numpy())
    env.close()


@pytest.mark.slow
def test_a_policy_is_cloned_through_the_loader(tmp_path):
    """A network from states to actions predicts the actions of the episodes better than their mean does."""
    record(tmp_path / "cloned", "--episodes", "12")
    dataset = read(tmp_path / "cloned")
    torch.manual_seed(0)
    torch.set_num_threads(1)
    stats = {name: [torch.tensor(dataset.meta.stats[name][part]).float() for part in ("mean", "std")] for name in
             (STATE, ACTION)}  # fmt: skip
    scaled = {name: (lambda batch, name=name, mean=mean, std=std: (batch[name] - mean) / std.clamp_min(1e-6))
              for name, (mean, std) in stats.items()}  # fmt: skip
    width = dataset.features[STATE]["shape"][0], dataset.features[ACTION]["shape"][0]
    network = torch.nn.Sequential(
        torch.nn.Linear(width[0], 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(),
        torch.nn.Linear(64, width[1]),
    )  # fmt: skip
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    # The last three episodes are held out.
    count = sum(dataset.meta.episodes[index]["length"] for index in range(9))
    learned = torch.utils.data.Subset(dataset, range(count))
    for _ in range(30):
        for batch in torch.utils.data.DataLoader(learned, batch_size=64, shuffle=True):
            loss = torch.nn.functional.mse_loss(network(scaled[STATE](batch)), scaled[ACTION](batch))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    for name, part, most in (("learned", range(count), 0.5), ("held out", range(count, len(dataset)), 1.0)):
        batch = next(iter(torch.utils.data.DataLoader(torch.utils.data.Subset(dataset, part), batch_size=len(part))))
        with torch.no_grad():
            wanted = scaled[ACTION](batch)
            error = torch.nn.functional.mse_loss(network(scaled[STATE](batch)), wanted).item()
        guess = (wanted - wanted.mean(dim=0)).square().mean().item()
        print(f"{name}: {len(part)} frames, mean squared error {error:.3f}, of their mean action {guess:.3f}")
        assert error < most * guess
