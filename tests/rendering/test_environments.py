"""Pictures through Gymnasium: vector environments, videos; the simulation is not touched."""

import pickle
from itertools import islice

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.rendering import gl, stage
from tests.envs.walks import walk

PALPATE = "SurgSim/Palpate-v0"
IDS = sorted(env_id for env_id in gym.registry if env_id.startswith("SurgSim/"))
needs_opengl = pytest.mark.usefixtures("opengl")


@pytest.fixture(params=IDS)
def env_id(request):
    return request.param


# Pictures go the same way for every id: one is enough where many are drawn.
EACH_ID = pytest.mark.parametrize(
    "env_id", [pytest.param(name, marks=[pytest.mark.slow] * (name != PALPATE)) for name in IDS], indirect=True
)


@EACH_ID
@needs_opengl
def test_pictures_change_no_bit_of_an_episode(env_id):
    """Observations, rewards, infos and saved states with a picture of each kind after each step, and without any."""
    plain, drawn = gym.make(env_id).unwrapped, gym.make(env_id, render_mode="rgb_array", show_lesion=True).unwrapped
    start = [env.reset(seed=3) for env in (plain, drawn)]
    assert start[0][0].tobytes() == start[1][0].tobytes()
    touched = False
    for action in islice(walk(plain, np.random.default_rng(7)), 40):
        plain_step, other = plain.step(action), drawn.step(action)
        drawn.render()
        drawn.renderer.depth("side")
        drawn.renderer.segmentation("endoscope")
        assert plain_step[0].tobytes() == other[0].tobytes() and plain_step[1:] == other[1:]
        assert plain.save_state() == drawn.save_state()
        touched |= bool(drawn.simulation.contact_force.any())
        if plain_step[2]:
            break
    assert touched, "the walk must touch the organ to prove anything"
    drawn.close()


def test_window_without_a_display_says_what_to_do(env_id, monkeypatch):
    for name in gl.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(gl.NoGLError, match=r'no display .*use render_mode="rgb_array"'):
        gym.make(env_id, render_mode="human")


@needs_opengl
@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_vector_environments_give_a_frame_for_each(mode):
    """Frames equal those of single environments, and all are drawn by one stage."""
    held = len(stage._stages)
    envs = gym.make_vec(PALPATE, num_envs=3, vectorization_mode=mode, render_mode="rgb_array", width=160, height=120)
    assert envs.render_mode == "rgb_array" and envs.metadata["render_fps"] == 20
    envs.reset(seed=[3, 4, 5])
    envs.step(np.tile(np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32), (3, 1)))
    frames = envs.render()
    assert isinstance(frames, tuple) and len(frames) == 3
    assert len(stage._stages) == held + 1
    alone = gym.make(PALPATE, render_mode="rgb_array", width=160, height=120)
    alone.reset(seed=4)
    alone.step(np.array([0.0, 0.0, -0.5, 0.0], dtype=np.float32))
    assert alone.render().tobytes() == frames[1].tobytes() != frames[2].tobytes()
    alone.close()
    envs.close()
    assert len(stage._stages) == held


@needs_opengl
def test_drawn_environment_can_be_pickled_with_its_renderer(env_id):
    env = gym.make(env_id, render_mode="rgb_array", width=64, height=48).unwrapped
    env.reset(seed=1)
    frame = env.render()
    options = pickle.loads(pickle.dumps(env.renderer.options))
    assert options == env.renderer.options and env.render().tobytes() == frame.tobytes()
    env.close()
    # A closed environment may be drawn again.
    assert env.render().tobytes() == frame.tobytes()
    env.close()


@pytest.mark.agents
@needs_opengl
def test_videos_are_recorded(env_id, tmp_path):
    pytest.importorskip("moviepy", reason="needs the `video` extra")
    env = gym.wrappers.RecordVideo(gym.make(env_id, render_mode="rgb_array"), str(tmp_path / "videos"))
    env.reset(seed=0)
    for action in islice(walk(env, np.random.default_rng(7)), 5):
        env.step(action)
    env.close()
    (video,) = (tmp_path / "videos").glob("*.mp4")
    assert video.stat().st_size > 1000


@needs_opengl
def test_pictures_follow_the_member_of_the_episode():
    """Each episode of a family plays another organ: pictures are those of an environment made for it alone."""
    settings = {"scene": "kidney_family", "render_mode": "rgb_array", "width": 120, "height": 90, "show_lesion": True}
    env, frames = gym.make(PALPATE, **settings), {}
    for seed in range(3):
        _, info = env.reset(seed=seed)
        frames[info["member"]] = np.asarray(env.render())
        alone = gym.make(PALPATE, **settings)
        alone.reset(seed=seed)
        np.testing.assert_array_equal(frames[info["member"]], alone.render())
        alone.close()
    assert len(frames) > 1 and len({frame.tobytes() for frame in frames.values()}) == len(frames)
    kinds = env.unwrapped.renderer.segmentation()
    assert {int(kind) for kind in np.unique(kinds)} >= {stage.LABELS["organ"], stage.LABELS["lesion"]}
    env.close()
    assert not stage._stages, "stages of members that were played are given back"
