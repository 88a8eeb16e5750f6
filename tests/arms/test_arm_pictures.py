"""The picture of the arms shows what it is to show; without OpenGL there is none, and a word."""

import io

import numpy as np
import pytest
from rich.console import Console

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
