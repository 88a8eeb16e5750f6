"""Pictures of the arms show what they are to show; without OpenGL there are none, and a word."""

import io

import numpy as np
import pytest
from rich.console import Console

from surgsim_env.arm_study.study import evaluate_arms
from surgsim_env.rendering import gl
from surgsim_env.reports.step_progress import StepProgress


def evaluate():
    """Pictures, and what is said while they are made."""
    told = io.StringIO()
    progress = StepProgress(Console(file=told, width=200))
    found = evaluate_arms("phantom", "psm_grasper", "psm_grasper", count=4, pictures=True, progress=progress)
    return found.pictures, told.getvalue()


def test_pictures_show_organ_and_arms():
    pictures, told = evaluate()
    if "no pictures" in told:
        pytest.skip(told[told.index("no pictures") :])
    assert list(pictures) == ["The arms at their ports", "Through the endoscope"]
    for frame in pictures.values():
        assert frame.shape == (720, 960, 3) and frame.dtype == np.uint8
        red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
        assert ((red > green + 40) & (red > blue + 40)).sum() > 500  # the organ
        assert ((red < 70) & (green < 70) & (blue < 70)).sum() > 500  # the shafts
    assert "the left arm at 4 points ..." in told


def test_without_opengl_no_picture_and_a_word(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr(gl, "_first_context", gl._first_context.__wrapped__)
    pictures, told = evaluate()
    assert pictures == {}
    assert "no pictures: MUJOCO_GL is 'off', which switches OpenGL off" in told
