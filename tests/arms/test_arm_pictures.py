"""The picture of an arm shows arm and trocar; the camera is as near as its points allow."""

import numpy as np
import pytest

from surgsim_apps.arms.arm_picture import draw_arm, filling_camera
from surgsim_env.instruments import load_arm
from surgsim_env.rendering import NoGLError


def test_the_picture_shows_arm_and_trocar():
    arm = load_arm("psm_grasper")
    try:
        frame = draw_arm(arm, arm.home)
    except NoGLError as error:
        pytest.skip(str(error))
    assert frame.shape == (1200, 1600, 3) and frame.dtype == np.uint8
    red, green, blue = (frame[..., channel].astype(int) for channel in range(3))
    assert ((red > blue + 80) & (green > blue + 40)).sum() > 100  # the trocar
    assert ((red < 90) & (green < 90) & (blue < 90)).sum() > 500  # the shaft


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
