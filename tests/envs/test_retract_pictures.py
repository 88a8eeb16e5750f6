"""SurgSim/Retract-v0 with pictures: what is seen and observed."""

import math

import numpy as np
import pytest

from surgsim_env.envs.ids import RetractEnv
from surgsim_env.rendering import gl
from surgsim_env.rendering.stage import LABELS
from tests.envs.retract_steps import act


@pytest.fixture(scope="module")
def opengl():
    try:
        gl.context()
    except gl.NoGLError as reason:
        pytest.skip(f"no OpenGL: {reason}")


def target_areas(env, camera, width, height):
    """For each pixel how much of the whole target it shows, from the camera's own rays; they sum to about 1.

    A pixel of depth z along the view covers an area of a plane in proportion to z^3.
    """
    disc, half = env.task.target, math.tan(math.radians(0.5 * camera.fov))
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = (column / width - 0.5) * 2.0 * half * width / height, (0.5 - row / height) * 2.0 * half
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ camera.rotation.T
    depth = (disc.centre[2] - camera.position[2]) / rays[..., 2]
    places = camera.position + depth[..., None] * rays
    area = np.where(np.linalg.norm(places - disc.centre, axis=-1) <= disc.radius, depth**3, 0.0)
    return area / area.sum()


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize(("width", "height", "tolerance"), [(640, 480, 0.015), (84, 84, 0.10)])
def test_what_is_seen_is_what_a_picture_shows(width, height, tolerance):
    """With the lobe half folded back; coarse pixels count the border to a pixel or so."""
    env = RetractEnv(render_mode="rgb_array", width=width, height=height, smooth_edges=False)
    env.reset(seed=6)
    nodes, rest = env.simulation.organ_state.node_position, env.simulation.organ_state.node_position.copy()
    compared, instrument = np.zeros(2, dtype=int), env.simulation.instrument
    # The lobe turned up about its held edge, as a plate on a hinge, the jaw far aside; then the jaw in the way.
    lifted = [(turn, 0.12) for turn in np.arange(0.24, 0.40, 0.02)]
    crossed = [(0.9, beside) for beside in np.arange(0.03, 0.08, 0.004)]
    for turn, beside in lifted + crossed:
        instrument.place(np.array([beside, 0.07, 0.006]))
        nodes[:, 1] = rest[:, 1] * math.cos(turn) - rest[:, 2] * math.sin(turn)
        nodes[:, 2] = rest[:, 1] * math.sin(turn) + rest[:, 2] * math.cos(turn)
        seen = env.task._look(env.simulation)
        labels = env.renderer.segmentation("endoscope")
        areas = target_areas(env, env.renderer.cameras["endoscope"], width, height)
        assert areas[labels == LABELS["target"]].sum() == pytest.approx(seen, abs=tolerance)
        compared[int(turn == 0.9)] += 0.02 < seen < 0.98
    assert (compared >= 2).all(), "some must be half covered to prove anything"
    env.close()


@pytest.mark.usefixtures("opengl")
def test_a_fault_shows_the_last_picture_before_it():
    """Not one of a lobe whose nodes are nowhere."""
    env = RetractEnv(obs_mode="rgb")
    env.reset(seed=6)
    before = act(env)[0]
    env.simulation.organ_state.node_velocity[100] = np.nan
    observation, _, terminated, _, info = act(env)
    assert terminated and "no longer finite" in info["sim_fault"]
    np.testing.assert_array_equal(observation, before)
    env.close()
