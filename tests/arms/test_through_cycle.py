"""Two arms on an organ that moves: still without amplitude, known losses, what the report says."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.arms.clearance import ClusteredSurface, Obstacles
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.points_file import columns, write_points
from surgsim_apps.arms.ports import EndoscopePort, PortPlace, Ports, Wall
from surgsim_apps.arms.reach import Sites, evaluate_both, evaluate_reach
from surgsim_apps.arms.report import cycle_section, write_report
from surgsim_apps.arms.study import evaluate_arms
from surgsim_apps.arms.through_cycle import evaluate_cycle, make_cycle
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion, Port
from surgsim_env.step_progress import StepProgress
from tests.arms.made import made_cycle, made_evaluation
from tests.arms.pivot_arm import pivot, write_pivot
from tests.arms.test_arm_report import Page

BREATH = CyclicMotion("breathing", (0.003, 0.0, -0.008), (4.0, 5.0), 0.33, 0.40, size=(0.6, 1.2))
BEAT = CyclicMotion("heartbeat", (0.0, 0.001, 0.0), (0.8, 1.0), 0.25, 0.35, size=(0.5, 1.0))


def moving(motions):
    return load_anatomy(replace(make_scene("phantom"), motions=tuple(motions)))


def test_positions_go_from_rest_to_the_top_and_end_with_all_at_the_top():
    cycle = make_cycle((BEAT, BREATH))
    assert cycle.main == 1
    np.testing.assert_allclose(cycle.signals[:6], np.outer(np.linspace(0.0, 1.0, 6), [0.0, 1.2]))
    np.testing.assert_allclose(cycle.signals[6:], [[1.0, 0.0], [1.0, 1.2]])
    assert cycle.before == (0, 0, 1, 2, 3, 4, 0, 5)
    assert make_cycle((BREATH,)).signals.shape == (6, 1)


def test_without_amplitude_the_numbers_are_those_of_a_still_organ(tmp_path):
    path = write_pivot(tmp_path)
    still = evaluate_arms(moving(()), path, path, count=12)
    held = [replace(motion, size=(0.0, 0.0)) for motion in (BREATH, BEAT)]
    moved = evaluate_arms(moving(held), path, path, count=12)
    assert still.cycle is None
    cycle = moved.cycle
    assert cycle is not None and len(cycle.both) == 8
    assert 0 < still.left.reachable.sum()
    for arm, follower in ((still.left, cycle.left), (still.right, cycle.right)):
        assert (follower.reachable == arm.reachable).all() and (follower.always == arm.reachable).all()
        assert (follower.has_path == arm.reachable).all()
        good = arm.reachable
        gaps = np.minimum(arm.organ_clearance, arm.wall_clearance)
        for position in range(8):
            np.testing.assert_allclose(follower.joints[position, good], arm.joints[good], atol=1e-9)
            np.testing.assert_allclose(follower.clearance[position, good], gaps[good], atol=1e-9)
    assert (cycle.both == still.both).all() and (cycle.travel == 0.0).all()


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
    assert follower.always.tolist() == follower.has_path.tolist() == [True, False, False]
    np.testing.assert_allclose(follower.joints[:, 0, 2], taken[:, 0], atol=1e-7)


@pytest.fixture(scope="module")
def evaluation():
    made = made_evaluation()
    return replace(made, cycle=made_cycle(made))


def test_the_report_shows_what_the_arrays_hold(evaluation, tmp_path):
    write_report(evaluation, tmp_path / "r.html", maps=(), command="surgsim arms")
    page, cycle, outer = Page((tmp_path / "r.html").read_text(encoding="utf-8")), evaluation.cycle, ~evaluation.inner
    shares = [f"{100 * value:.0f} %" for value in cycle.left.reachable[:, outer].mean(axis=1)]
    always, path = (f"{100 * mask[outer].mean():.0f} %" for mask in (cycle.left.always, cycle.left.has_path))
    assert page.row("left arm", 1) == ["left arm", *shares, always, path]
    row = page.row("left arm: clearance [mm]")
    assert row[1] == f"{1e3 * np.nanmin(cycle.left.clearance[:, outer]):.2f}"


def test_the_table_of_points_holds_the_cycle(evaluation, tmp_path):
    write_points(evaluation, tmp_path / "points.csv")
    with (tmp_path / "points.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == list(columns(evaluation))
    cycle = evaluation.cycle
    for index, row in enumerate(rows):
        assert row["left_always"] == str(int(cycle.left.always[index]))
        assert row["both_always"] == str(int(cycle.both[:, index].all()))
        path = cycle.right.has_path[index]
        assert (row["right_has_path"] == "1") == (row["right_path_clearance_worst_m"] != "") == path
        if path:
            worst = cycle.right.clearance[:, index].min()
            assert float(row["right_path_clearance_worst_m"]) == pytest.approx(worst, rel=1e-8)


def test_an_arm_that_follows_nothing_is_said(evaluation, tmp_path):
    cycle = evaluation.cycle
    names = ("joints", "clearance")
    gone = {name: np.full_like(getattr(cycle.left, name), np.nan) for name in names}
    none = replace(cycle, left=replace(cycle.left, reachable=np.zeros_like(cycle.left.reachable), **gone))
    none = replace(none, both=np.zeros_like(none.both))
    lost = replace(evaluation, cycle=none)
    section = cycle_section(lost)
    assert section is not None and section["reach"][0] == ("left arm", *["0 %"] * 5)
    write_points(lost, tmp_path / "points.csv")
