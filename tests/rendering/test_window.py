"""The live window, on machines with a display."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.rendering import gl
from surgsim_env.rendering.episode_view import WindowContext

STILL = np.zeros(4, dtype=np.float32)


@pytest.fixture
def env():
    try:
        WindowContext("surgsim", 64, 48).free()
    except gl.NoGLError as error:
        pytest.skip(f"no window on this machine: {error}")
    env = gym.make("SurgSim/Palpate-v0", render_mode="human", show_lesion=True)
    yield env
    env.close()


def test_window_shows_the_picture_of_each_step(env):
    env.reset(seed=0)
    assert env.render() is None
    window = env.unwrapped._view.window
    env.step(STILL)
    renderer = env.unwrapped.renderer
    frame = renderer.rgb()
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 50
    renderer.present(frame)
    shown = np.zeros_like(frame)
    window._context.make_current()
    mujoco.mjr_readPixels(shown, None, mujoco.MjrRect(0, 0, 640, 480), renderer._stage.canvas.context)
    np.testing.assert_array_equal(shown[::-1], frame)


def test_keys_and_a_closed_window_that_stays_closed(env):
    import glfw

    env.reset(seed=0)
    window = env.unwrapped._view.window
    window._key(glfw.KEY_C, glfw.PRESS)
    assert window._camera_name == "endoscope"
    assert env.unwrapped.window is window
    window._key(glfw.KEY_ESCAPE, glfw.PRESS)
    env.step(STILL)
    assert window.closed
    env.step(STILL)
    env.reset(seed=1)
    assert env.unwrapped._view.window is window
