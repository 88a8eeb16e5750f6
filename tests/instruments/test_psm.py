"""The PSM that MuJoCo computes against its modified Denavit-Hartenberg table, to 1e-9."""

import math

import numpy as np
import pytest

from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene.model import Port
from tests.instruments.joints import random_joints
from tests.instruments.psm_table import PSM_LINKS, TIP_ROTATION, psm_frames

TIP_LENGTH = {"psm_palpator": 0.020, "psm_grasper": 0.0102, "psm_retractor": 0.026}
PORT = Port((0.11, -0.02, 0.3), (0.3, 0.2, -1.0), 0.4)
EXACT = 1e-9


@pytest.fixture(scope="module", params=sorted(TIP_LENGTH))
def arm(request):
    return load_arm(request.param, PORT)


def in_port(position):
    """A point of the world in the port's frame."""
    return PORT.rotation.T @ (position - PORT.point)


def test_forward_kinematics_are_those_of_the_table(arm):
    for joints in random_joints(arm, 200):
        # The tip's frame in that of the last link, and the tip itself along its z.
        last = psm_frames(joints)[-1]
        rotation = last[:3, :3] @ TIP_ROTATION
        position = last[:3, 3] + TIP_LENGTH[arm.description.name] * rotation[:, 2]
        pose = arm.tip_pose(joints)
        assert np.abs(in_port(pose.position) - position).max() < EXACT
        assert np.abs(PORT.rotation.T @ pose.rotation - rotation).max() < EXACT


def test_joints_have_the_limits_of_the_table(arm):
    limits = [(link.lower, link.upper) for link in PSM_LINKS]
    np.testing.assert_allclose(np.column_stack([arm.lower, arm.upper]), limits, rtol=1e-15)


def test_a_pose_worked_out_by_hand(arm):
    """Joints 0, insertion 0.1 m: the tip is 0.1 - 0.0156 + 0.0091 m and its own length straight down from the port."""
    pose = arm.tip_pose([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    depth = 0.1 - 0.4318 + 0.4162 + 0.0091 + TIP_LENGTH[arm.description.name]
    assert np.abs(in_port(pose.position) - [0.0, 0.0, -depth]).max() < EXACT
    assert np.abs(arm.tip_direction([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) - PORT.rotation @ [0.0, 0.0, -1.0]).max() < EXACT
    # Yaw and pitch are the angles of spherical coordinates: |sine| of the pitch is the height over the yaw's plane.
    yaw, pitch = 0.7, -0.4
    tip = in_port(arm.tip_pose([yaw, pitch, 0.1, 0.0, 0.0, 0.0]).position)
    assert np.linalg.norm(tip) == pytest.approx(depth, abs=EXACT)
    assert abs(tip[1]) == pytest.approx(depth * math.sin(0.4), abs=EXACT)
    assert abs(tip[0]) == pytest.approx(depth * math.cos(0.4) * math.sin(0.7), abs=EXACT)


def test_the_shaft_meets_the_remote_centre_at_any_joint_values(arm):
    assert max(arm.trocar_residual(joints) for joints in random_joints(arm, 500)) < EXACT


def test_the_residual_is_a_distance_from_the_shafts_axis():
    """Moving the trocar by 3 mm across the shaft is missed by 3 mm, along the shaft by nothing."""
    arm = load_arm("psm_palpator")
    arm.trocar = np.array([0.003, 0.0, 0.05])
    assert arm.trocar_residual(arm.home) == pytest.approx(0.003, abs=EXACT)


def test_jacobian_is_the_derivative_of_the_pose(arm):
    """Central differences: h^2 / 6 times third derivatives below 1 m is 2e-11 at h = 1e-5, rounding 1e-11."""
    step = 1e-5
    for joints in random_joints(arm, 20):
        jacobian = arm.tip_jacobian(joints)
        for column in range(arm.joint_count):
            change = step * np.eye(arm.joint_count)[column]
            ahead, behind = arm.tip_pose(joints + change), arm.tip_pose(joints - change)
            linear = (ahead.position - behind.position) / (2.0 * step)
            spin = (ahead.rotation - behind.rotation) @ arm.tip_pose(joints).rotation.T / (2.0 * step)
            angular = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            assert np.abs(jacobian[:3, column] - linear).max() < 1e-9
            assert np.abs(jacobian[3:, column] - angular).max() < 1e-9


def test_jaw_opens_both_fingers_alike():
    """The tips of two fingers 9.2 mm long from the yaw axis move apart as the angle opens, alike on both sides."""
    arm = load_arm("psm_grasper")
    left, right = (arm.shape_names.index(name) for name in ("jaw_left", "jaw_right"))
    tip = arm.tip_pose(arm.home).position
    yaw_axis = psm_frames(arm.home)[5][:3, 3]
    for angle in (0.0, 0.4, 1.2):
        both = arm.shape_ends(arm.home, angle)[[left, right]]
        ends = both[[0, 1], np.linalg.norm(both - yaw_axis, axis=2).argmax(axis=1)]
        assert np.linalg.norm(ends[0] - tip) == pytest.approx(np.linalg.norm(ends[1] - tip), abs=1e-12)
        reach = ends - yaw_axis
        between = math.acos(reach[0] @ reach[1] / np.prod(np.linalg.norm(reach, axis=1)))
        closed = 2.0 * math.atan2(0.0011, 0.0102 - 0.001)
        assert between == pytest.approx(angle + closed, abs=1e-9)
