"""The picture of the arms shows what it is to show; without OpenGL there is none, and a word."""

import io

import numpy as np
import pytest
from rich.console import Console

from surgsim_apps.arms.arm_picture import filling_camera
from surgsim_apps.arms.study import evaluate_arms
from surgsim_env.rendering import gl
from surgsim_env.step_progress import StepProgress


def evaluate():
    """The picture, and what is said while it is made."""
    output = io.StringIO()
    progress = StepProgress(Console(file=output, width=200))
    evaluation = evaluate_arms("phantom", "psm_grasper", "psm_grasper", count=4, picture=True, progress=progress)
    return evaluation.picture, output.getvalue()


def test_the_picture_shows_organ_and_arms():
    frame, output = evaluate()
    if frame is None:
        pytest.skip(output[output.index("no picture") :])
    assert frame.shape == (720, 960, 3) and frame.dtype == np.uint8
    red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
    assert ((red > green + 40) & (red > blue + 40)).sum() > 500  # the organ
    assert ((red < 70) & (green < 70) & (blue < 70)).sum() > 500  # the shafts
    assert "the left arm at 4 points ..." in output


def test_without_opengl_no_picture_and_a_word(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr(gl, "_first_context", gl._first_context.__wrapped__)
    picture, output = evaluate()
    assert picture is None
    assert "no picture: MUJOCO_GL is 'off', which switches OpenGL off" in output


@pytest.mark.parametrize("size", [(640, 480), (300, 600)])
def test_a_filled_picture_has_all_points_and_no_more_room(size):
    """Points touch both edges of its middle share along one axis."""
    places = np.random.default_rng(3).normal(size=(60, 3)) * [1.0, 0.3, 0.5] + [4.0, -1.0, 2.0]
    camera = filling_camera(places, np.array([1.0, 2.0, 0.5]), np.array([0.0, 0.0, 1.0]), 30.0, size[0] / size[1], 0.9)
    pixels, depth = camera.project(places, *size)
    assert (depth > 0.0).all()
    at = 2.0 * pixels / size - 1.0
    assert np.abs(at).max() == pytest.approx(0.9, abs=1e-9)
    wide = int(np.argmax(np.ptp(at, axis=0)))
    assert (at[:, wide].min(), at[:, wide].max()) == pytest.approx((-0.9, 0.9), abs=1e-9)
