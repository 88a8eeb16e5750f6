"""Two arms on an organ that moves: still without amplitude, known losses, joint speeds, what the report says."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.arm_study.clearance import ClusteredSurface, Obstacles
from surgsim_env.arm_study.following import (
    STEPS,
    course,
    joints_per_signal,
    make_cycle,
    speeds_through_cycle,
)
from surgsim_env.arm_study.joint_search import Wanted, search_joints
from surgsim_env.arm_study.kinematics import BatchKinematics
from surgsim_env.arm_study.ports import EndoscopePort, PortPlace, Ports, Wall
from surgsim_env.arm_study.reach import Sites, evaluate_both, evaluate_reach
from surgsim_env.arm_study.results import columns, write_points
from surgsim_env.arm_study.study import evaluate_arms, write_report
from surgsim_env.arm_study.through_cycle import cycle_section, evaluate_cycle
from surgsim_env.coupling.motion_kernels import MotionDrive, signal_at
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.reports.step_progress import StepProgress
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion, Port
from tests.arm_study.made import made_cycle, made_evaluation
from tests.arm_study.pivot_arm import pivot, pivot_coordinates, write_pivot
from tests.arm_study.test_arm_report import Page

BREATH = CyclicMotion("breathing", (0.003, 0.0, -0.008), (4.0, 5.0), 0.33, 0.40, size=(0.6, 1.2))
BEAT = CyclicMotion("heartbeat", (0.0, 0.001, 0.0), (0.8, 1.0), 0.25, 0.35, size=(0.5, 1.0))


def moving(motions):
    return load_anatomy(replace(make_scene("phantom"), motions=tuple(motions)))


def test_the_course_is_the_simulations_and_its_rate_is_its():
    """Largest size, shortest period; the rate against central differences of the signal."""
    one, count = course(BREATH, 4001), 4001
    drive = MotionDrive(
        np.array([[0.0, 4.0]]),
        np.array([[1.2]]),
        np.array([0.33]),
        np.array([0.40]),
        np.zeros(1),
        1e-3,
        np.zeros(1, int),
    )
    signal = np.array([signal_at(drive, 0, time) for time in one.time[1:-1]])
    np.testing.assert_allclose(1.2 * one.level[1:-1], signal, atol=1e-12)
    # Errors of second order in the step of 1 ms: |s'''| / 6 dt^2.
    step = 4.0 / (count - 1)
    np.testing.assert_allclose(one.rate[1:-1], 1.2 * (one.level[2:] - one.level[:-2]) / (2 * step), atol=1e-4)


def test_positions_go_from_rest_to_the_top_and_end_with_all_at_the_top():
    cycle = make_cycle((BEAT, BREATH))
    assert cycle.main == 1 and cycle.others == (0,)
    np.testing.assert_allclose(cycle.signals[:6], np.outer(np.linspace(0.0, 1.0, 6), [0.0, 1.2]))
    np.testing.assert_allclose(cycle.signals[6:], [[1.0, 0.0], [1.0, 1.2]])
    assert cycle.before == (0, 0, 1, 2, 3, 4, 0, 5)
    assert make_cycle((BREATH,)).signals.shape == (6, 1)


def test_without_amplitude_the_numbers_are_those_of_a_still_organ(tmp_path):
    path = write_pivot(tmp_path)
    still = evaluate_arms(moving(()), path, path, count=12)
    held = [replace(one, size=(0.0, 0.0)) for one in (BREATH, BEAT)]
    found = evaluate_arms(moving(held), path, path, count=12)
    assert still.cycle is None
    cycle = found.cycle
    assert cycle is not None and len(cycle.level) == 8
    assert 0 < still.left.reachable.sum()
    for arm, follower in ((still.left, cycle.left), (still.right, cycle.right)):
        assert (follower.reachable == arm.reachable).all() and (follower.always == arm.reachable).all()
        assert (follower.follows == arm.reachable).all()
        good = arm.reachable
        gaps = np.minimum(arm.organ_clearance, arm.wall_clearance)
        for position in range(8):
            np.testing.assert_allclose(follower.joints[position, good], arm.joints[good], atol=1e-9)
            np.testing.assert_allclose(follower.clearance[position, good], gaps[good], atol=1e-9)
        assert (follower.speed[good] == 0.0).all()
    assert (cycle.both == still.both).all() and (cycle.travel == 0.0).all()
    assert found.summary == still.summary


def test_a_point_at_the_edge_of_reach_is_lost_where_the_organ_takes_it_out(tmp_path):
    """Depths of 190, 195 and 201.5 mm with steps of 1.6 mm: reach ends at 200 mm, and the tip may be 1 mm off."""
    arm = load_arm(pivot(tmp_path), Port((1.0, 1.0, 1.0)))
    down = replace(BREATH, displacement=(0.0, 0.0, -0.008), size=(1.0, 1.0))
    anatomy = moving((down,))
    depth = np.array([0.190, 0.195, 0.2015])
    points = np.array([1.0, 1.0, 1.0]) - depth[:, None] * np.array([0.0, 0.0, 1.0])
    sites = Sites(points, np.tile([0.0, 0.0, 1.0], (3, 1)), np.zeros(3, dtype=bool))
    ports = Ports(
        PortPlace((1.0, 1.0, 1.0), into=(0.0, 0.0, -1.0)),
        PortPlace((1.1, 1.0, 1.0), into=(0.0, 0.0, -1.0)),
        EndoscopePort((1.0, 1.1, 1.0), (1.0, 1.0, 0.8)),
        wall=Wall(plate=True, thickness=0.0, hole=10.0),
    )
    organ = ClusteredSurface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
    kinematics, around = BatchKinematics(arm), Obstacles(organ, ports, 0.0)
    reach = evaluate_reach(kinematics, sites, around)
    both = evaluate_both(reach, reach, points)
    follower = evaluate_cycle((reach, reach), both, sites, (around, around), anatomy, StepProgress()).left
    taken = depth + 0.0016 * np.arange(6)[:, None]
    assert follower.reachable.tolist() == (taken <= 0.201).tolist()
    assert follower.always.tolist() == follower.has_path.tolist() == follower.follows.tolist() == [True, False, False]
    np.testing.assert_allclose(follower.joints[:, 0, 2], taken[:, 0], atol=1e-7)
    # p' is at most 15/8: the slide goes straight down at 8 mm x 15/8 over the rise of 0.33 x 4 s, of its 0.2 m/s.
    assert follower.joint_share[0].argmax() == 2
    assert follower.joint_share[0, 2] == pytest.approx(0.008 * 1.875 / (0.33 * 4.0) / 0.2, rel=1e-3)


@pytest.mark.parametrize("name", ["psm_palpator", "six_axis"])
def test_joint_speeds_are_differences_of_the_inverse_kinematics(name):
    """The search from near joints changes them least: its differences are the weighted pseudoinverse, to first order.

    Central differences over a step h err by h^2; the search itself meets a point to 1e-8 m, 1e-3 of these steps.
    """
    kinematics = BatchKinematics(load_arm(name, Port()))
    arm = kinematics.arm
    home = kinematics.at(arm.home[None], shapes=False).tip
    tips = home + np.random.default_rng(3).uniform(-0.03, 0.03, (6, 3))
    joints = search_joints(kinematics, Wanted(tips), np.tile(arm.home, (6, 1))).joints
    shifts = np.stack([np.tile([0.008, -0.002, 0.003], (6, 1)), np.tile([0.0, 0.001, 0.002], (6, 1))])
    found = joints_per_signal(kinematics, joints, shifts)
    tips = kinematics.at(joints, shapes=False).tip
    step = 0.01
    for number, shift in enumerate(shifts):
        ahead, behind = (
            search_joints(kinematics, Wanted(tips + sign * step * shift), joints).joints for sign in (1.0, -1.0)
        )
        differences = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(found[:, number], differences, atol=5e-3 * np.abs(found).max())


def test_speeds_of_the_pivot_are_those_of_its_coordinates(tmp_path):
    """Yaw, pitch and depth of X + s(t) d in closed form, differentiated in time.

    Speeds are interpolated between positions 1.7 mm apart, 100 mm from the trocar: an error of (0.017)^2 / 8 of them.
    """
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    motion = replace(BREATH, size=(1.0, 1.0))
    point, shift = np.array([0.03, -0.02, -0.11]), np.array(motion.displacement)
    cycle = make_cycle((motion,))
    joints = np.array([[pivot_coordinates(point + level * shift)] for level in np.linspace(0.0, 1.0, STEPS + 1)])
    speed = speeds_through_cycle(kinematics, cycle, joints, shift[None, None])[:, 0]
    fine = course(motion, 12001)
    coordinates = np.array([pivot_coordinates(point + level * shift) for level in fine.level])
    velocity = np.gradient(coordinates, fine.time, axis=0)
    wanted = np.abs(velocity[::100])
    assert speed.shape == wanted.shape
    np.testing.assert_allclose(speed, wanted, atol=3e-3 * wanted.max())


def test_others_are_added_with_their_largest_rates(tmp_path):
    """A second motion along the first, of another period: the bound is the sum of both speeds."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    down, beat = (replace(one, displacement=(0.0, 0.0, -0.004), size=(1.0, 1.0)) for one in (BREATH, BEAT))
    cycle = make_cycle((down, replace(beat, displacement=(0.0, 0.0, -0.001))))
    depth = 0.1 + 0.004 * np.linspace(0.0, 1.0, STEPS + 1)
    joints = np.array([[[0.0, 0.0, one]] for one in depth])
    shifts = np.array([[[0.0, 0.0, -0.004]], [[0.0, 0.0, -0.001]]])
    speed = speeds_through_cycle(kinematics, cycle, joints, shifts)
    one = course(down)
    np.testing.assert_allclose(speed[:, 0, 2], 0.004 * np.abs(one.rate) + 0.001 * 1.875 / (0.25 * 0.8), rtol=1e-6)


@pytest.fixture(scope="module")
def evaluation():
    made = made_evaluation(pictures=False)
    return replace(made, cycle=made_cycle(made))


def test_the_report_shows_what_the_arrays_hold(evaluation, tmp_path):
    write_report(evaluation, tmp_path / "r.html", pictures=(), maps=(), command="surgsim arms")
    page, cycle, outer = Page((tmp_path / "r.html").read_text(encoding="utf-8")), evaluation.cycle, ~evaluation.inner
    shares = [f"{100 * value:.0f} %" for value in cycle.left.reachable[:, outer].mean(axis=1)]
    always, follows = (f"{100 * mask[outer].mean():.0f} %" for mask in (cycle.left.always, cycle.left.follows))
    assert page.row("left arm") == ["left arm", *shares, always, follows]
    row = page.row("left arm: clearance [mm]")
    assert row[1] == f"{1e3 * np.nanmin(cycle.left.clearance[:, outer]):.2f}"
    speed = np.nanmax(cycle.left.speed[:, 0])
    assert page.row("left arm: yaw")[1:3] == [f"{speed:.3f} rad/s", "2 rad/s"]


def test_the_table_of_points_holds_the_cycle(evaluation, tmp_path):
    write_points(evaluation, tmp_path / "points.csv")
    with (tmp_path / "points.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == columns(evaluation)
    cycle = evaluation.cycle
    for index, row in enumerate(rows):
        assert row["left_always"] == str(int(cycle.left.always[index]))
        assert row["both_always"] == str(int(cycle.both[:, index].all()))
        path = cycle.right.has_path[index]
        assert (row["right_speed_joint"] != "") == (row["right_path_clearance_worst_m"] != "") == path
        if path:
            worst = cycle.right.clearance[:, index].min()
            assert float(row["right_path_clearance_worst_m"]) == pytest.approx(worst, rel=1e-8)
            assert float(row["right_speed_share"]) == pytest.approx(cycle.right.joint_share[index].max(), rel=1e-8)


def test_an_arm_that_follows_nothing_is_said(evaluation, tmp_path):
    cycle = evaluation.cycle
    names = ("joints", "clearance", "speed")
    gone = {name: np.full_like(getattr(cycle.left, name), np.nan) for name in names}
    none = replace(cycle, left=replace(cycle.left, reachable=np.zeros_like(cycle.left.reachable), **gone))
    none = replace(none, both=np.zeros_like(none.both))
    lost = replace(evaluation, cycle=none)
    section = cycle_section(lost)
    assert section is not None and section["reach"][0] == ("left arm", *["0 %"] * 5)
    write_points(lost, tmp_path / "points.csv")
