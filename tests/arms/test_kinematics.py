"""Kinematics and searches in arrays against MuJoCo's own, one set of joint values at a time."""

import numpy as np
import pytest

from surgsim_apps.arms.joint_search import Wanted, search_joints
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene.model import Port
from tests.instruments.joints import random_joints

PORT = Port((0.03, -0.02, 0.15), (0.3, 0.2, -0.9), 0.7)


@pytest.fixture(scope="module", params=["psm_palpator", "psm_grasper", "psm_retractor", "six_axis"])
def arm(request):
    return load_arm(request.param, PORT)


def test_chain_is_mujocos(arm):
    joints = random_joints(arm, 20)
    kinematics = BatchKinematics(arm)
    chain = kinematics.at(joints)
    linear, angular = kinematics.tip_jacobian(chain)
    for row, values in enumerate(joints):
        near, along = arm.shaft_line(values)
        assert chain.tip[row] == pytest.approx(arm.tip_pose(values).position, abs=1e-13)
        assert chain.direction[row] == pytest.approx(arm.tip_direction(values), abs=1e-13)
        assert chain.near[row] == pytest.approx(near, abs=1e-13)
        assert chain.along[row] == pytest.approx(along, abs=1e-13)
        assert chain.shape_ends[row] == pytest.approx(arm.shape_ends(values), abs=1e-13)
        assert np.vstack([linear[row], angular[row]]) == pytest.approx(arm.tip_jacobian(values), abs=1e-13)


def test_shaft_jacobian_moves_the_shaft(arm):
    """With the shaft in its trocar its nearest point moves across it as the Jacobian says: central differences."""
    kinematics = BatchKinematics(arm)
    chain = kinematics.at(arm.home[None])
    jacobian, step = kinematics.shaft_jacobian(chain)[0], 1e-6
    across = np.eye(3) - np.outer(chain.along[0], chain.along[0])
    for joint in range(arm.joint_count):
        aside = step * np.eye(arm.joint_count)[joint]
        moved = kinematics.at((arm.home + aside)[None]).near - kinematics.at((arm.home - aside)[None]).near
        assert across @ moved[0] / (2.0 * step) == pytest.approx(across @ jacobian[:, joint], abs=1e-7)


@pytest.mark.parametrize("name", ["psm_palpator", "psm_grasper"])
def test_search_finds_what_is_there(name):
    """Places and directions that joint values within the limits have are found again, and the limits are kept."""
    arm = load_arm(name, PORT)
    kinematics = BatchKinematics(arm)
    there = kinematics.at(random_joints(arm, 300, margin=0.1), shapes=False)
    placed = search_joints(kinematics, Wanted(there.tip), np.tile(arm.home, (300, 1)))
    assert (placed.position_error < 1e-7).mean() > 0.99
    turned = search_joints(kinematics, Wanted(there.tip, there.direction), placed.joints)
    pointing = kinematics.at(turned.joints, shapes=False).direction
    sine, cosine = np.linalg.norm(np.cross(pointing, there.direction), axis=1), (pointing * there.direction).sum(axis=1)
    angle = np.arctan2(sine, cosine)
    assert ((turned.position_error < 1e-7) & (angle < 1e-3)).mean() > 0.98
    for candidates in (placed, turned):
        assert (candidates.joints >= arm.lower).all() and (candidates.joints <= arm.upper).all()


def test_search_keeps_a_trocar_by_control():
    """Straight lines from the trocar: the six-axis arm goes there with its shaft on them."""
    arm = load_arm("six_axis", PORT)
    kinematics = BatchKinematics(arm)
    into = arm.port.rotation @ [0.0, 0.0, -1.0]
    rng = np.random.default_rng(0)
    aside = rng.normal(0.0, 0.25, (100, 3)) + into
    tips = arm.port.point + aside / np.linalg.norm(aside, axis=1)[:, None] * rng.uniform(0.05, 0.18, (100, 1))
    candidates = search_joints(kinematics, Wanted(tips), np.tile(arm.home, (100, 1)))
    assert (candidates.position_error < 1e-7).all()
    assert (candidates.trocar_error < 1e-7).all()
