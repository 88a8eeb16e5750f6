"""Pictures of the arms show what they are to show; without OpenGL there are none, and a word."""

import numpy as np
import pytest

from surgsim_env.arm_study.study import evaluate_arms
from surgsim_env.rendering import gl


def evaluate(told):
    return evaluate_arms(
        "phantom", "psm_grasper", "psm_grasper", count=4, pictures=True, progress=lambda what, _share: told.append(what)
    )


def test_pictures_show_organ_and_arms():
    told = []
    pictures = evaluate(told).pictures
    reasons = [what for what in told if what.startswith("no pictures")]
    if reasons:
        pytest.skip(reasons[0])
    assert list(pictures) == ["The arms at their ports", "Through the endoscope"]
    for frame in pictures.values():
        assert frame.shape == (720, 960, 3) and frame.dtype == np.uint8
        red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
        assert ((red > green + 40) & (red > blue + 40)).sum() > 500  # the organ
        assert ((red < 70) & (green < 70) & (blue < 70)).sum() > 500  # the shafts
    assert told[-1] == "done"


def test_without_opengl_no_picture_and_a_word(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr(gl, "_first_context", gl._first_context.__wrapped__)
    told = []
    assert evaluate(told).pictures == {}
    assert any(word.startswith("no pictures: MUJOCO_GL is 'off', which switches OpenGL off") for word in told)
