"""Positions and views of cameras, by geometry. Needs no OpenGL."""

import math

import numpy as np
import pytest

from surgsim_env.rendering.cameras import Camera, scene_cameras
from surgsim_env.rendering.options import CAMERAS
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, scene_from_table

pytestmark = pytest.mark.filterwarnings("ignore:scene")


@pytest.fixture(params=["phantom", "liver", "agarose_prism", "bovine_liver_block"])
def anatomy(request):
    return load_anatomy(make_scene(request.param))


def test_projection_is_a_pinholes():
    """From 2 m with a vertical view of 2 atan(1/2), 1 m beside the axis is the edge of a square picture."""
    up = np.array([0.0, 0.0, 1.0])
    camera = Camera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), up, math.degrees(2.0 * math.atan(0.5)))
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 2.0, -1.0]])
    pixels, depth = camera.project(places, 400, 400)
    np.testing.assert_allclose(pixels, [[200, 200], [400, 200], [200, 0], [200, 300]], atol=1e-9)
    np.testing.assert_allclose(depth, [2.0, 2.0, 2.0, 4.0], atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("size", [(640, 480), (84, 84), (480, 640), (1280, 320)])
@pytest.mark.parametrize("name", ["overview", "side", "above"])
def test_sees_the_whole_organ_and_not_much_else(anatomy, name, size):
    pixels, depth = scene_cameras(anatomy, size[0] / size[1])[name].project(anatomy.mesh.points, *size)
    assert (depth > 0.0).all()
    assert (pixels >= 0.0).all() and (pixels <= size).all()
    assert (np.ptp(pixels, axis=0) / size).max() > 0.5


def test_endoscope_looks_obliquely_at_the_palpable_face_from_near(anatomy):
    camera = scene_cameras(anatomy)["endoscope"]
    view = camera.target - camera.position
    assert 0.0999 <= np.linalg.norm(view) <= 0.2001
    assert 30.0 <= math.degrees(math.acos(view @ anatomy.face.approach / np.linalg.norm(view))) <= 45.0
    nearest, _ = anatomy.face.project(camera.target)
    np.testing.assert_allclose(nearest, camera.target, atol=1e-12)
    assert set(scene_cameras(anatomy)) == set(CAMERAS)


def with_endoscope(place):
    scene = make_scene("phantom")
    table = {
        "description": "",
        "mesh": {"block": {"size": [0.06, 0.06, 0.03], "cells": [12, 12, 6]}},
        "material": {"youngs_modulus": 5000, "density": 1060},
        "damping": {"alpha": 25.0, "beta": 0.0},
        "anchors": [{"name": "tray", "box": {"lower": [-1, -1, -0.001], "upper": [1, 1, 0.0001]}}],
        "contact": {"stiffness": 2e7, "damping": 100.0, "friction": 0.2},
        "instrument": {},
        "timing": {},
        "limits": {"soft_force": 0.5, "hard_force": 0.8},
        "sensor": {"noise": 0.0, "bias": 0.0, "range": 2.0},
        "palpation": {"press_depth": 0.004},
        "lesion": {"radius": [0.006, 0.01], "cover": [0.003, 0.006], "modulus_ratio": [4, 10]},
        "endoscope": place,
    }
    return scene_from_table(table, name="placed", folder=scene.folder)


def test_scene_may_place_the_endoscope():
    place = {"position": [0.03, -0.1, 0.1], "target": [0.03, 0.03, 0.03], "fov_deg": 45}
    camera = scene_cameras(load_anatomy(with_endoscope(place)))["endoscope"]
    np.testing.assert_array_equal(camera.position, place["position"])
    assert camera.fov == 45.0
    pixels, _ = camera.project(np.array([place["target"]]), 640, 480)
    np.testing.assert_allclose(pixels, [[320.0, 240.0]], atol=1e-9)
