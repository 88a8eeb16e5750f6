"""Inverse kinematics: poses come back, limits hold, a line is a line, the trocar comes first."""

import numpy as np
import pytest

from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.instruments.arm.inverse_kinematics import (
    KinematicTask,
    follow,
    prioritised_step,
    reach_pose,
    solve_pose,
)
from surgsim_env.scene.model import Port
from tests.instruments.joints import random_joints

STEP = 0.05


@pytest.fixture(scope="module")
def psm():
    return load_arm("psm_palpator")


@pytest.fixture(scope="module")
def six_axis():
    """With its base upright."""
    return load_arm("six_axis", Port(into=(-0.5, 0.0, -(0.75**0.5))))


def test_poses_within_the_limits_are_found(psm):
    """Every pose is that of some joint values, so that it can be reached; the way back need not be the same."""
    for joints in random_joints(psm, 60, margin=0.05):
        joints[2] = max(joints[2], 0.05)
        pose = psm.tip_pose(joints)
        for wanted in ({}, {"direction": psm.tip_direction(joints)}, {"rotation": pose.rotation}):
            solution = reach_pose(psm, pose.position, **wanted)
            assert solution.reached, (joints, wanted)
            assert np.linalg.norm(psm.tip_pose(solution.joints).position - pose.position) < 1e-8
            assert ((solution.joints >= psm.lower) & (solution.joints <= psm.upper)).all()
            if "rotation" in wanted:
                assert np.abs(psm.tip_pose(solution.joints).rotation - pose.rotation).max() < 1e-5


def test_what_is_out_of_reach_is_told_with_its_distance(psm):
    """The insertion ends at 0.24 m: straight down, 0.4 m is the rest too far."""
    longest = psm.tip_pose([0.0, 0.0, 0.24, 0.0, 0.0, 0.0]).position
    solution = solve_pose(psm, [0.0, 0.0, -0.4])
    assert not solution.reached
    assert solution.position_error == pytest.approx(0.4 + longest[2], abs=1e-4)


def test_a_pose_far_from_the_start_is_found_through_the_trocar(six_axis):
    trocar = np.array(six_axis.port.point)
    for offset in ([0.03, 0.02, -0.10], [-0.05, 0.0, -0.08], [0.0, -0.06, -0.12]):
        solution = solve_pose(six_axis, trocar + offset)
        assert solution.reached, solution
        assert six_axis.trocar_residual(solution.joints) < 1e-9


def test_a_held_joint_leaves_its_share_to_the_others():
    """x + y = 1 with x at most 0.2 is met by y = 0.8; the second task only gets what is left."""
    tasks = [KinematicTask(np.array([[1.0, 1.0]]), np.array([1.0]))]
    step = prioritised_step(tasks, np.array([-1.0, -1.0]), np.array([0.2, 1.0]), np.ones(2))
    for _ in range(60):  # damping takes part of each step
        left = np.array([1.0 - step.sum()])
        step = step + prioritised_step(
            [KinematicTask(tasks[0].jacobian, left)], -1.0 - step, [0.2, 1.0] - step, np.ones(2)
        )
    assert step == pytest.approx([0.2, 0.8], abs=1e-9)


def line(arm, start, velocity, count, direction=None):
    """Joint values along a line, and how far the tip is off it at control steps and in between [m]."""
    joints, begin = start, arm.tip_pose(start).position
    off, residual, limited = [], [], []
    along = velocity / np.linalg.norm(velocity)
    for _ in range(count):
        step = follow(arm, joints, arm.tip_pose(joints).position + velocity * STEP, direction, STEP)
        for share in (0.25, 0.5, 0.75, 1.0):
            there = joints + share * (step.joints - joints)
            away = arm.tip_pose(there).position - begin
            off.append(np.linalg.norm(away - (away @ along) * along))
            residual.append(arm.trocar_residual(there))
        assert (np.abs(step.joints - joints) <= arm.speed_limit * STEP * (1.0 + 1e-12)).all()
        joints = step.joints
        limited.append(step.limited)
    return joints, max(off), max(residual), limited


@pytest.mark.parametrize("velocity", [(0.02, 0.0, 0.0), (0.0, -0.02, 0.0), (0.01, 0.01, -0.014)])
def test_a_line_is_followed_without_drift(psm, velocity):
    """Steady joint speeds between points 1 mm apart bend the path by v^2 T^2 / (8 l) = 1.3 um at l = 0.1 m."""
    velocity = np.array(velocity)
    begin = psm.tip_pose(psm.home).position
    joints, off, _, limited = line(psm, psm.home, velocity, 60, np.array([0.0, 0.0, -1.0]))
    assert not any(limited)
    assert off < 5e-6
    assert np.linalg.norm(psm.tip_pose(joints).position - begin - velocity * 60 * STEP) < 1e-7
    assert psm.tip_direction(joints) == pytest.approx([0.0, 0.0, -1.0], abs=1e-4)


def test_the_trocar_is_kept_along_a_line(six_axis):
    """The hand, 0.44 m outside, moves 4.4 mm a step: on straight joint lines it strays (4.4 mm)^2 / (8 x 0.4 m)."""
    for velocity in ([0.02, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]):
        _, off, residual, limited = line(six_axis, six_axis.home, np.array(velocity), 20)
        assert not any(limited)
        assert off < 6e-6 and residual < 6e-6


def test_at_a_limit_the_tip_stops_on_its_line_and_says_so(psm):
    """Straight down the insertion ends at 0.24 m; there the tip stands, not a micrometre aside."""
    start = psm.home.copy()
    start[2] = 0.235
    joints, off, _, limited = line(psm, start, np.array([0.0, 0.0, -0.02]), 20)
    assert not limited[0] and limited[-1]
    assert off < 1e-6
    assert joints[2] <= 0.24 and joints[2] > 0.2385


def test_a_speed_beyond_the_joints_limits_is_cut_along_the_line(psm):
    """0.4 m/s of insertion: 1 m/s is cut to a quarter of the way, straight on."""
    start = psm.home
    joints, off, _, limited = line(psm, start, np.array([0.0, 0.0, -1.0]), 1)
    assert limited == [True] and off < 1e-6
    assert joints[2] - start[2] == pytest.approx(0.25 * STEP, abs=1e-6)


def test_the_tip_turns_no_faster_than_1_rad_per_second(psm):
    """Told to point 0.64 rad aside it gets there in 13 control steps of at most 0.05 rad, its place unmoved."""
    joints, place = np.add(psm.home, [0.0, 0.0, 0.0, 0.0, 0.1, 0.1]), None
    wanted = np.array([0.6, 0.0, -0.8])
    for _ in range(30):
        before = psm.tip_direction(joints)
        place = psm.tip_pose(joints).position if place is None else place
        joints = follow(psm, joints, place, wanted, STEP).joints
        turned = np.arccos(np.clip(before @ psm.tip_direction(joints), -1.0, 1.0))
        assert turned < 0.05 * 1.05
    assert psm.tip_pose(joints).position == pytest.approx(place, abs=1e-8)
    assert psm.tip_direction(joints) == pytest.approx(wanted, abs=1e-3)


def test_through_the_wrists_singularity_the_place_is_kept(psm):
    """With the wrist straight, roll and wrist cannot turn the tip any way; the place does not suffer."""
    _, off, _, limited = line(psm, psm.home, np.array([0.0, 0.02, 0.0]), 40, np.array([0.6, 0.0, -0.8]))
    assert off < 2e-5 and not any(limited)
