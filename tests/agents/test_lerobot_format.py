"""Episodes are recorded as LeRobot data sets: they come back to the bit, and a recording that was stopped goes on."""

import itertools
import json
import shutil
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401
from surgsim_env.rendering import gl
from surgsim_env.scene.load import scenes_folder

pytestmark = pytest.mark.agents
pytest.importorskip("tqdm", reason="needs the `agents` extra")
pytest.importorskip("minari", reason="needs the `demonstrations` extra")
pa = pytest.importorskip("pyarrow", reason="needs the `demonstrations` extra")
pq = pytest.importorskip("pyarrow.parquet")

ID = "SurgSim/Palpate-v0"
# The oracle solves seeds 4 and 5 within so many control steps, and not seeds 3 and 6.
SHORT = {"max_episode_steps": 45}
SEEDS = ["--first-seed", "3"]


def record(folder, *more, env_id=ID, arguments=SHORT):
    from agents.record_demonstrations import main

    named = ["--env-arguments", json.dumps(arguments), "--format", "lerobot", "--dataset", str(folder)]
    main([env_id, *named, *SEEDS, *more])


def info(folder):
    return json.loads((folder / "meta/info.json").read_text())


def lines(folder, name):
    return [json.loads(line) for line in (folder / f"meta/{name}.jsonl").read_text().splitlines()]


def table(folder, index):
    return pq.read_table(folder / f"data/chunk-000/episode_{index:06d}.parquet")


def column(read, name):
    """A column (n, size) or (n,) as its bytes lie in the file."""
    values = read[name].combine_chunks()
    if not isinstance(values, pa.FixedSizeListArray):
        return values.to_numpy(zero_copy_only=False)
    return values.flatten().to_numpy().reshape(len(values), -1)


def contents(folder):
    """What a data set holds: the text of its description, and the values of its episodes; videos by name."""
    described = {name: (folder / f"meta/{name}").read_text() for name in ("info.json", "episodes.jsonl", "tasks.jsonl")}
    described["episodes_stats"] = lines(folder, "episodes_stats")
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    return described, names, [table(folder, index) for index in range(info(folder)["total_episodes"])]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Four oracle episodes, failures kept."""
    folder = tmp_path_factory.mktemp("lerobot") / "palpate"
    record(folder, "--episodes", "4", "--keep-failures")
    return folder


def test_states_actions_and_wrenches_come_back_to_the_bit(dataset):
    """The seed and the actions of each episode give its states and wrenches again, every byte of them."""
    from agents.recorded_features import tip_wrench

    env = gym.make(ID, **SHORT)
    pressed = 0.0
    for index, line in enumerate(lines(dataset, "episodes")):
        read = table(dataset, index)
        actions, states = column(read, "action"), column(read, "observation.state")
        wrenches = column(read, "observation.meta.force_torque")
        assert {array.dtype for array in (actions, states, wrenches)} == {np.dtype(np.float32)}
        env.reset(seed=line["seed"])
        for step, action in enumerate(actions):
            assert env.unwrapped.task_observation.tobytes() == states[step].tobytes()
            assert tip_wrench(env.unwrapped.simulation).tobytes() == wrenches[step].tobytes()
            _, reward, terminated, truncated, seen = env.step(action)
            assert np.float32(reward) == column(read, "next.reward")[step]
            assert column(read, "next.success")[step] == seen["success"]
            assert column(read, "next.done")[step] == (step == len(actions) - 1) == (terminated or truncated)
        assert seen["success"] == line["success"] and len(actions) == line["length"]
        pressed = max(pressed, np.linalg.norm(wrenches[:, :3], axis=1).max())
    assert pressed > 0.1, "the tip presses the tissue"


def test_the_layout_is_that_of_the_format(dataset):
    described = info(dataset)
    episodes, stats = lines(dataset, "episodes"), lines(dataset, "episodes_stats")
    lengths = [line["length"] for line in episodes]
    assert described["codebase_version"] == "v2.1" and described["fps"] == 20
    assert described["total_episodes"] == len(episodes) == len(stats) == 4
    assert described["total_frames"] == sum(lengths) and described["total_chunks"] == described["total_tasks"] == 1
    assert lines(dataset, "tasks") == [{"task_index": 0, "task": "Find a hidden lesion by touch."}]
    columns = {name: one for name, one in described["features"].items() if one["dtype"] != "video"}
    begin = 0
    for index, length in enumerate(lengths):
        read = table(dataset, index)
        assert read.column_names == list(columns) and read.num_rows == length
        assert (column(read, "episode_index") == index).all() and (column(read, "task_index") == 0).all()
        np.testing.assert_array_equal(column(read, "frame_index"), np.arange(length))
        np.testing.assert_array_equal(column(read, "index"), begin + np.arange(length))
        np.testing.assert_array_equal(column(read, "timestamp"), (np.arange(length) * 0.05).astype(np.float32))
        for name, one in columns.items():
            values = column(read, name)
            assert values.dtype == one["dtype"] and values.reshape(length, -1).shape[1:] == tuple(one["shape"])
            np.testing.assert_allclose(
                stats[index]["stats"][name]["mean"], values.reshape(length, -1).mean(axis=0), 1e-5
            )
            assert stats[index]["stats"][name]["count"] == [length]
        begin += length
    wrench = described["features"]["observation.meta.force_torque"]
    assert wrench["info"]["units"] == ["N"] * 3 + ["N m"] * 3 and wrench["info"]["frame"].startswith("world")
    assert "| `observation.meta.force_torque` | float32 | [6] |" in (dataset / "meta/README.md").read_text()


def test_successes_and_failures_are_ranges(dataset):
    described, episodes = info(dataset), lines(dataset, "episodes")
    solved = [line["success"] for line in episodes]
    assert solved == [True, True, False, False]
    assert described["splits"] == {"train": "0:2", "success": "0:2", "failure": "2:4"}
    assert [line["seed"] for line in episodes] == [4, 5, 3, 6]
    assert not (dataset / "failures").exists()


def test_the_state_is_in_si_units(dataset):
    """(value - origin) / scale is what the environment observes; full_command is what an entry of 1 commands."""
    features = info(dataset)["features"]
    state = features["observation.state"]["info"]
    env = gym.make(ID, **SHORT)
    observation, _ = env.reset(seed=lines(dataset, "episodes")[0]["seed"])
    first = column(table(dataset, 0), "observation.state")[0]
    np.testing.assert_allclose((first - state["origin"]) / state["scale"], observation, rtol=1e-6, atol=1e-6)
    assert features["observation.state"]["names"][:3] == ["tip_position_x", "tip_position_y", "tip_position_z"]
    np.testing.assert_allclose(first[:3], env.unwrapped.simulation.instrument.tip_position, rtol=1e-6)
    assert features["action"]["info"]["full_command"] == [0.02, 0.02, 0.02, 1.0]


def test_the_torque_is_about_the_tip():
    """T = sum_i (T_i + (c_i - tip) x F_i), with the levers of MuJoCo's bodies, while a jaw grasps and folds a lobe."""
    from agents.record_demonstrations import Recorder, play_oracle
    from agents.recorded_features import tip_wrench

    env = gym.make("SurgSim/Retract-v0")
    seen = []

    def read(env):
        simulation = env.unwrapped.simulation
        instrument = simulation.instrument
        force, torque = np.zeros(3), np.zeros(3)
        for name, wrench in zip(instrument.tool_names, simulation.contact_wrench, strict=True):
            centre = instrument.data.body(name).xipos
            force += wrench[:3]
            torque += wrench[3:] + np.cross(centre - instrument.tip_position, wrench[:3])
        seen.append((tip_wrench(simulation), np.concatenate([force, torque])))
        return np.zeros(1)

    play_oracle(Recorder(env, {"seen": read}), 0)
    found, wanted = (np.array(part) for part in zip(*seen))
    assert np.abs(wanted[:, 3:]).max() > 1e-3
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], rtol=1e-5, atol=1e-7)
    # Levers are of the start of the last haptic step of 1 ms: the tip moves at up to 0.05 m/s.
    slack = 0.05 * 0.001 * np.linalg.norm(wanted[:, :3], axis=1)
    assert (np.abs(found[:, 3:] - wanted[:, 3:]).max(axis=1) <= 2.0 * slack + 1e-7).all()


# What is recorded without a simulation: success and number of frames of the seeds from 0 on.
PLAYED = [(False, 3), (True, 2), (True, 4), (False, 1), (True, 3), (False, 2)]


def play_into(folder, count, pictures=False):
    """Record the seeds below `count` that the folder does not hold yet; seed 5 is played and not kept."""
    from agents.lerobot_format import Feature, LeRobotFolder

    features = [Feature("action", "float32", (2,), ("along", "across"))]
    features += [Feature("observation.images.side", "video", (16, 16, 3))] if pictures else []
    stated = {"frame_rate": 20, "robot": "probe", "task": "Wait.", "recorded": {"by": "nobody"}, "first_seed": 0}
    writer = LeRobotFolder(folder, features, **stated)
    try:
        while (seed := writer.next_seed) < count:
            success, length = PLAYED[seed]
            values = {"action": np.full((length, 2), seed, dtype=np.float32)}
            if pictures:
                values["observation.images.side"] = np.full((length, 16, 16, 3), 40 * seed, dtype=np.uint8)
            if seed == 5:
                writer.skip(seed)
            else:
                writer.add(seed, values, success=success)
        writer.finish()
    finally:
        writer.close()


class Killed(Exception):
    """Stands for a process that was killed."""


def kill_at(patch, count, how=Killed):
    """Let the recording end, by raising `how`, where it is about to put a file in its place for the `count`-th time."""
    real, made = Path.replace, [0]

    def replace(self, target):
        made[0] += 1
        if made[0] == count:
            raise how
        return real(self, target)

    patch.setattr(Path, "replace", replace)


@pytest.mark.parametrize("pictures", [False, True])
def test_a_recording_that_was_killed_goes_on(tmp_path, monkeypatch, pictures):
    """Killed between any two files and started again, it holds the same as one that ran through."""
    play_into(tmp_path / "whole", 6, pictures)
    whole = contents(tmp_path / "whole")
    assert whole[0]["info.json"].count('"0:3"') == 2 and '"failure": "3:5"' in whole[0]["info.json"]
    assert [column(read, "action")[0, 0] for read in whole[2]] == [1, 2, 4, 0, 3]
    for count in itertools.count(1, 3 if pictures else 1):
        folder = tmp_path / str(count)
        try:
            with monkeypatch.context() as patch:
                kill_at(patch, count)
                play_into(folder, 6, pictures)
        except Killed:
            play_into(folder, 6, pictures)
            assert contents(folder) == whole, count
        else:
            assert count > 15
            break


def test_a_finished_recording_is_made_longer(tmp_path, monkeypatch):
    """Failures that were appended make room for the successes that follow, wherever that was killed."""
    play_into(tmp_path / "whole", 6)
    whole = contents(tmp_path / "whole")
    play_into(tmp_path / "short", 4)
    short = contents(tmp_path / "short")
    assert '"failure": "2:4"' in short[0]["info.json"]
    play_into(tmp_path / "short", 4)
    assert contents(tmp_path / "short") == short, "the same command again has nothing to do"
    for count in itertools.count(1):
        folder = tmp_path / str(count)
        shutil.copytree(tmp_path / "short", folder)
        try:
            with monkeypatch.context() as patch:
                kill_at(patch, count)
                play_into(folder, 6)
        except Killed:
            play_into(folder, 6)
            assert contents(folder) == whole, count
        else:
            assert contents(folder) == whole
            assert count > 10
            break


def test_a_simulation_that_was_stopped_goes_on(dataset, tmp_path):
    """Two commands, the second of which goes on, give the same bytes as one."""
    folder = tmp_path / "stopped"
    for count in ("1", "4"):
        record(folder, "--episodes", count, "--keep-failures")
    assert contents(folder) == contents(dataset)


def test_a_recording_that_is_interrupted_while_it_writes_goes_on(dataset, tmp_path, monkeypatch):
    folder = tmp_path / "interrupted"
    with monkeypatch.context() as patch:
        kill_at(patch, 7, KeyboardInterrupt)
        with pytest.raises(SystemExit, match="stopped while an episode was written"):
            record(folder, "--episodes", "4", "--keep-failures")
    record(folder, "--episodes", "4", "--keep-failures")
    assert contents(folder) == contents(dataset)


def test_episodes_of_a_sampled_policy_are_those_of_their_seeds():
    pytest.importorskip("stable_baselines3", reason="needs the `agents` extra")
    from agents.record_demonstrations import Recorder, player
    from surgsim_env.scoring.episodes import agent_generator
    from surgsim_env.scoring.evaluate import policies_folder
    from surgsim_env.training.policy_files import load_policy

    env = gym.make("SurgSim/Retract-v0", max_episode_steps=6)
    recorder = Recorder(env)
    path = policies_folder() / "retract_scratch.safetensors"
    play, policy = player(str(path), env, {}), load_policy(path)
    for seed in (3, 4, 3):
        play(recorder, seed)
        # As `surgsim evaluate` plays it.
        policy.reset(1)
        policy.begin(0, env, agent_generator(seed))
        recorded = recorder.all_episodes[-1]
        np.testing.assert_array_equal(policy.act(recorded.observations[0][None])[0], recorded.actions[0])
    first, _, again = (np.array(one.actions) for one in recorder.all_episodes)
    np.testing.assert_array_equal(first, again)


def test_a_control_step_without_a_whole_rate_is_refused(tmp_path):
    text = (scenes_folder() / "organs" / "phantom_small.toml").read_text(encoding="utf-8")
    assert "haptic_steps_per_control = 50" in text
    for steps in (30, 100):
        scene = tmp_path / f"steps_{steps}.toml"
        scene.write_text(text.replace("haptic_steps_per_control = 50", f"haptic_steps_per_control = {steps}"))
        with pytest.raises(
            ValueError, match=r"a whole number of frames a second, at least 20: set timing.haptic_steps"
        ):
            record(tmp_path / "never", arguments={"scene": str(scene)})


def test_hours_are_of_simulated_time(tmp_path, monkeypatch):
    """0.0013 h are 94 frames of 0.05 s; an episode has 45 at most. Failures are left out, two that are not in a row."""
    from agents import record_demonstrations

    monkeypatch.setattr(record_demonstrations, "FAILURES_MOST", 2)
    folder = tmp_path / "hours"
    record(folder, "--hours", "0.0013")
    assert 94 <= info(folder)["total_frames"] < 94 + 45 and info(folder)["surgsim"]["next_seed"] > 7
    assert set(info(folder)["splits"]) == {"train", "success"}
    assert all(line["success"] for line in lines(folder, "episodes"))


def test_pictures_are_videos(tmp_path):
    """The mp4's picture at k / fps is the endoscope's of frame k."""
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    folder, name = tmp_path / "pictures", "observation.images.endoscope"
    record(folder, "--episodes", "1", "--keep-failures", "--images", "endoscope", "--image-size", "96", "64")
    described = info(folder)
    assert described["features"][name]["shape"] == [64, 96, 3] and described["total_videos"] == 1
    reader = imageio_ffmpeg.read_frames(folder / f"videos/chunk-000/{name}/episode_000000.mp4")
    about = next(reader)
    assert about["fps"] == 20 and about["size"] == (96, 64) and about["codec"] == "h264"
    pictures = [np.frombuffer(frame, np.uint8).reshape(64, 96, 3).astype(float) for frame in reader]
    actions = column(table(folder, 0), "action")
    assert len(pictures) == len(actions)
    env = gym.make(ID, width=96, height=64, show_force=False, **SHORT)
    env.reset(seed=lines(folder, "episodes")[0]["seed"])
    for picture, action in zip(pictures, actions):
        drawn = env.unwrapped.renderer.rgb("endoscope")
        # H.264 at constant quality 23 leaves a few grey levels.
        assert np.abs(picture - drawn).mean() < 6.0
        env.step(action)
    stats = lines(folder, "episodes_stats")[0]["stats"][name]
    assert np.shape(stats["mean"]) == (3, 1, 1) and np.allclose(
        np.ravel(stats["mean"]), np.mean(pictures, (0, 1, 2)) / 255, atol=0.03
    )
    env.close()


class Told:
    """Commands nothing, and keeps what it was told."""

    facts: ClassVar[list] = []

    def reset(self, rng, facts):
        self.facts.append(facts)

    def act(self, observation):
        return np.zeros(self.facts[-1].action_size, dtype=np.float32)


def test_an_agent_is_told_the_environments_arguments_and_not_the_recordings(tmp_path):
    """Size and looks of the recorded pictures are no arguments of the environment: scored, it is told none."""
    try:
        gl.context()
    except gl.NoGLError as error:
        pytest.skip(f"no pictures on this machine: {error}")
    pytest.importorskip("imageio_ffmpeg")
    arguments = {"scene": "phantom_small", "max_episode_steps": 2}
    more = ["--episodes", "1", "--keep-failures", "--images", "side", "--image-size", "32", "32"]
    record(tmp_path / "told", "--by", f"{__name__}:Told", *more, arguments=arguments)
    (facts,) = Told.facts
    assert facts.env_kwargs == arguments


def test_two_arms_have_two_wrenches():
    from agents.recorded_features import features

    found = {one.name: one for one in features(gym.make("SurgSim/BimanualRetract-v0"))}
    wrench = found["observation.meta.force_torque"]
    assert wrench.shape == (12,) and wrench.names[0] == "left_force_x" and wrench.names[-1] == "right_torque_z"
    assert found["action"].shape == (13,) and len(found["action"].names) == len(set(found["action"].names)) == 13


def test_what_cannot_go_on_is_refused(dataset, tmp_path):
    with pytest.raises(
        ValueError, match=r"episodes whose env_arguments is .*45.*, not .*44.*: give the same arguments"
    ):
        record(dataset, "--keep-failures", arguments={"max_episode_steps": 44})
    with pytest.raises(ValueError, match="episodes whose failures_kept is true, not false"):
        record(dataset)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"holds files and no meta/info\.json: name an empty folder"):
        record(tmp_path)
    with pytest.raises(ValueError, match="a whole press, and frames of a data set are one control step apart"):
        record(tmp_path / "sites", env_id="SurgSim/PalpateSites-v0", arguments={})
    with pytest.raises(ValueError, match="seed 1000000 is reserved for scores"):
        record(tmp_path / "kept", "--first-seed", "1000000")
    with pytest.raises(ValueError, match=r"--image-size is 95 64; H\.264 takes even numbers"):
        record(tmp_path / "odd", "--images", "side", "--image-size", "95", "64")
    with pytest.raises(ValueError, match="--hours and --images are for --format lerobot"):
        record(tmp_path / "minari", "--format", "minari", "--hours", "1")


def test_one_process_at_a_time_writes(dataset, tmp_path):
    from agents.lerobot_format import Feature, LeRobotFolder

    stated = {"frame_rate": 20, "robot": "probe", "task": "Wait.", "recorded": {}, "first_seed": 0}
    features = [Feature("action", "float32", (1,))]
    first = LeRobotFolder(tmp_path, features, **stated)
    with pytest.raises(ValueError, match="another process writes into"):
        LeRobotFolder(tmp_path, features, **stated)
    with pytest.raises(ValueError, match="seed 1 is not the next to be recorded, which is 0"):
        first.skip(1)
    with pytest.raises(ValueError, match=r"action is float64 of shape \(2,\); the rule is float32"):
        first.add(0, {"action": np.zeros(2)}, success=True)
    first.close()
    LeRobotFolder(tmp_path, features, **stated).close()


class Idle:
    """Commands nothing, and so never succeeds."""

    def reset(self, rng, facts):
        self.size = facts.action_size

    def act(self, observation):
        return np.zeros(self.size, dtype=np.float32)


def test_hours_end_where_every_episode_fails(tmp_path, monkeypatch):
    from agents import record_demonstrations

    monkeypatch.setattr(record_demonstrations, "FAILURES_MOST", 2)
    idle = {"arguments": {"max_episode_steps": 3}}
    said = r"last 2 episodes, up to seed 4, all failed, and 0\.000 of 9 h are recorded: .* or with --keep-failures$"
    with pytest.raises(ValueError, match=said):
        record(tmp_path / "set", "--by", f"{__name__}:Idle", "--hours", "9", **idle)
    assert info(tmp_path / "set")["total_episodes"] == 0
    # The same command goes on, and --episodes limits the seeds.
    record(tmp_path / "set", "--by", f"{__name__}:Idle", "--hours", "9", "--episodes", "5", **idle)
    assert info(tmp_path / "set")["surgsim"]["next_seed"] == 8
    # Failures that are kept count as recorded time: 0.0002 h are 14.4 frames.
    record(tmp_path / "kept", "--by", f"{__name__}:Idle", "--hours", "0.0002", "--keep-failures", **idle)
    assert info(tmp_path / "kept")["splits"]["failure"] == "0:5"


def test_hours_end_where_no_episode_has_a_step(tmp_path, monkeypatch):
    from agents import record_demonstrations
    from agents.lerobot_format import Feature, LeRobotFolder

    monkeypatch.setattr(record_demonstrations, "FAILURES_MOST", 2)
    stated = {"frame_rate": 20, "robot": "probe", "task": "Wait.", "recorded": {}, "first_seed": 0}
    folder = LeRobotFolder(tmp_path, [Feature("action", "float32", (4,))], **stated)
    with pytest.raises(ValueError, match=r"up to seed 1, all had no step, .* with another --by$"):
        record_demonstrations.record_into(
            folder, gym.make(ID), lambda env, seed: env.reset(seed=seed), hours=1.0, keep_failures=True
        )
    folder.close()
