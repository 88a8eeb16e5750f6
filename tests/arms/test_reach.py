"""Points that an arm reaches, against known sets; and what stops it, with obstacles put in its way."""

import math
from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.arms.clearance import ClusteredSurface, Obstacles, arm_distances, split_at_trocar
from surgsim_apps.arms.joint_search import REACHED
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.ports import EndoscopePort, PortPlace, Ports, Wall
from surgsim_apps.arms.reach import ARM_DISTANCE, Sites, evaluate_both, evaluate_reach, tip_ball
from surgsim_apps.arms.results import REASONS
from surgsim_apps.arms.with_errors import DRAWS, evaluate_errors
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene import JointErrors
from surgsim_env.scene.model import Port
from tests.arms.pivot_arm import RADIUS, SITE, TABLE, pivot, pivot_excess, write_pivot
from tests.instruments.joints import random_joints
from tests.instruments.psm_table import PSM_LINKS

DOWN = (0.0, 0.0, -1.0)


def plate_at(height, x=0.0, half=0.02):
    """A square plate across z, as thin as two triangles."""
    points = np.array([[x - half, -half, height], [x + half, -half, height], [x + half, half, height],
                       [x - half, half, height]])  # fmt: skip
    return ClusteredSurface(points, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def ports_at_origin(wall):
    return Ports(
        left=PortPlace((0.0, 0.0, 0.0), into=DOWN),
        right=PortPlace((0.16, 0.0, 0.0), into=DOWN),
        endoscope=EndoscopePort((0.08, 0.0, 0.0), (0.08, 0.0, -0.1)),
        wall=wall,
    )


FREE = Wall(plate=True, thickness=0.0, hole=10.0)


def around(ball=0.0, organ=None, wall=FREE):
    """By default a small organ far away, and a wall that is all hole."""
    return Obstacles(organ or plate_at(-5.0), ports_at_origin(wall), ball)


def surface_sites(points):
    points = np.asarray(points, dtype=float)
    return Sites(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.zeros(len(points), dtype=bool))


def test_pivot_reaches_its_cone_and_depths_and_nothing_else(tmp_path):
    """Yaw, pitch and depth of a point are known: it is reached where all three are within the limits."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.15, -0.15, -0.22], [0.15, 0.15, -0.01], (400, 3))
    excess = np.array([pivot_excess(point) for point in points])
    depth = np.linalg.norm(points, axis=1)
    # Beyond a limit by an angle a at depth d, the nearest reachable place is at least d sin(a) cos(pitch) away.
    metres = np.stack([0.8 * depth * np.sin(excess[:, 0]), depth * np.sin(excess[:, 1]), excess[:, 2]]).max(axis=0)
    sure = (metres <= 0.0) | (metres > REACHED)
    report = evaluate_reach(kinematics, surface_sites(points[sure]), around()).report
    inside = metres[sure] <= 0.0
    assert inside.sum() > 40 and (~inside).sum() > 100
    assert report.reachable.tolist() == inside.tolist()
    assert {REASONS[index] for index in report.reason[~inside]} == {"a joint limit"}
    assert np.isnan(report.manipulability[~inside]).all() and not np.isnan(report.manipulability[inside]).any()
    assert report.position_error[inside].max() < 1e-6


def test_errors_of_the_joints_at_the_points_in_reach(tmp_path):
    """A slide's offset moves the tip along the shaft by itself; a plate beside it is then touched or not at all."""
    description = pivot(tmp_path)
    sites = surface_sites([[0.0, 0.0, -0.1], [0.03, 0.02, -0.12], [0.0, 0.0, -5.0]])

    def effect(errors):
        arm = load_arm(replace(description, joint_errors=errors), Port())
        reach = evaluate_reach(BatchKinematics(arm), sites, around())
        return evaluate_errors(reach, sites, around(), seed=0)

    assert effect(None) is None
    none = (0.0,) * 3
    exact, moved = effect(JointErrors(none, none, none)), effect(JointErrors((0.0, 0.0, 0.002), none, none))
    assert exact.tip_error.shape == (DRAWS, 2) and exact.tip_error.max() == 0.0 and exact.kept == 1.0
    assert 1e-4 < moved.tip_error.max() <= 0.002 and moved.kept == 1.0
    np.testing.assert_allclose(moved.tip_error[:, 0], moved.tip_error[:, 1], atol=1e-9)
    depth = np.linalg.norm(sites.points[:2], axis=1)
    np.testing.assert_allclose(
        moved.depth_error / moved.tip_error, np.tile(-sites.points[:2, 2] / depth, (DRAWS, 1)), rtol=1e-6
    )
    turned = effect(JointErrors(none, (0.01, 0.01, 0.0), none)).tip_error
    assert turned[:, 0].std() > 1e-5 and (turned <= 0.02 * depth).all()


@pytest.mark.slow
def test_psm_reaches_its_cone_and_depths():
    """Within yaw and pitch limits every depth from the trocar on to the straight instrument's end is reached.

    Beyond, nothing further from where the wrist can be than the 19.3 mm from there to the tip.
    """
    arm = load_arm("psm_grasper", Port())
    kinematics = BatchKinematics(arm)
    pitch_limit, wrist_most = PSM_LINKS[1].upper, PSM_LINKS[2].upper + PSM_LINKS[2].d + PSM_LINKS[3].d
    beyond = PSM_LINKS[5].a + 0.0102
    rng = np.random.default_rng(2)
    yaw, depth = rng.uniform(-1.2, 1.2, 300), rng.uniform(0.03, 0.30, 300)
    pitch = rng.uniform(-1.4, 1.4, 300)
    points = depth[:, None] * np.stack(
        [-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], axis=1
    )
    inside = (np.abs(pitch) < pitch_limit - 0.01) & (depth < wrist_most + beyond - 1e-4)
    # From a point at pitch p beyond the limit b, the wrist's places are at least d sin(p - b) away.
    away = np.maximum(depth * np.sin(np.clip(np.abs(pitch) - pitch_limit, 0.0, None)), depth - wrist_most)
    outside = away > beyond + REACHED
    assert inside.sum() > 80 and outside.sum() > 40
    sure = inside | outside
    reach = evaluate_reach(kinematics, surface_sites(points[sure]), around())
    assert reach.report.reachable.tolist() == inside[sure].tolist()
    assert {REASONS[index] for index in reach.report.reason[outside[sure]]} == {"a joint limit"}


def test_search_misses_no_pose_of_the_psm():
    """Places and directions that joint values have: each is found as a point approached along that direction."""
    kinematics = BatchKinematics(load_arm("psm_grasper", Port()))
    joints = random_joints(kinematics.arm, 60, seed=9, margin=0.03)
    there = kinematics.at(joints, shapes=False)
    past = kinematics.trocar_error(there) < 1e-6
    directions = there.direction[past]
    reach = evaluate_reach(kinematics, Sites(there.tip[past], -directions, np.ones(past.sum(), dtype=bool)), around())
    assert reach.report.reachable.all()
    cosine = np.einsum("nki,ni->nk", reach.candidates.pointing, directions)
    assert ((cosine >= math.cos(math.radians(10.0))) & reach.usable).any(axis=1).all()


def test_no_joints_reach_what_is_too_far():
    """The six-axis arm is as long as it is; limits or not, 5 m are too far."""
    kinematics = BatchKinematics(load_arm("six_axis", Port()))
    report = evaluate_reach(kinematics, surface_sites([[0.0, 0.0, -5.0], [0.0, 0.0, -0.1]]), around()).report
    assert [REASONS[index] for index in report.reason] == ["no joints put the tip there", "reachable"]


def test_trocar_missed_is_said():
    """Above the skin the six-axis arm's tip gets there, but has not passed the trocar."""
    kinematics = BatchKinematics(load_arm("six_axis", Port()))
    report = evaluate_reach(kinematics, surface_sites([[0.0, 0.0, 0.05]]), around()).report
    assert REASONS[report.reason[0]] == "the shaft misses its trocar"
    assert report.position_error[0] < 1e-6


def test_organ_in_the_way(tmp_path):
    """A plate across the shaft; beside it the shaft passes at the closed form's distance."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    through = evaluate_reach(kinematics, surface_sites([[0.0, 0.0, -0.15]]), around(organ=plate_at(-0.08))).report
    assert REASONS[through.reason[0]] == "the arm touches the organ"
    assert np.isnan(through.organ_clearance[0])
    beside = evaluate_reach(
        kinematics, surface_sites([[0.0, 0.0, -0.15]]), around(organ=plate_at(-0.08, x=0.05))
    ).report
    assert beside.reason[0] == 0
    # The plate's edge lies at x = 30 mm, the shaft's surface at its radius.
    assert beside.organ_clearance[0] == pytest.approx(0.03 - RADIUS, abs=1e-9)


def test_tip_may_touch_what_it_touches(tmp_path):
    """The organ at the tip is no collision, 5 mm up the shaft it is."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    for height, reached in ((0.0, True), (0.0009, True), (0.006, False)):
        site = surface_sites([[0.0, 0.0, -0.15]])
        report = evaluate_reach(kinematics, site, around(organ=plate_at(-0.15 + height))).report
        assert bool(report.reachable[0]) == reached
        # Contact on purpose is no lack of clearance: the shaft 20 mm above the tip is that far from the organ.
        if reached:
            assert report.organ_clearance[0] == pytest.approx(0.02 - height - RADIUS, abs=1e-6)


def test_inner_target_lies_behind_the_organ(tmp_path):
    """The way to an inner target is cut through the organ: it is no obstacle there."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    points = np.array([[0.0, 0.0, -0.15]])
    sites = Sites(points, np.array([[0.0, 0.0, 1.0]]), np.array([True]))
    report = evaluate_reach(kinematics, sites, around(organ=plate_at(-0.08))).report
    assert report.reason[0] == 0
    assert np.isnan(report.organ_clearance[0])


def test_wall_in_the_way(tmp_path):
    """A plate of the wall 20 mm thick with a narrow hole: a shaft tilted by 35 degrees lies in it, a straight one not.

    Outside the hole h = 12 mm from the trocar the shaft is h cos(a) - t/2 - r = -4.2 mm (a = 35), -2 mm (a = 0) clear.
    """
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    tilt = math.radians(35.0)
    points = 0.15 * np.array([[0.0, 0.0, -1.0], [-math.sin(tilt), 0.0, -math.cos(tilt)]])
    wide = evaluate_reach(kinematics, surface_sites(points), around(wall=Wall(plate=True, hole=0.05))).report
    assert wide.reason.tolist() == [0, 0]
    assert wide.wall_clearance == pytest.approx([0.036, 0.05 * math.cos(tilt) - 0.014], abs=1e-6)
    narrow = evaluate_reach(kinematics, surface_sites(points), around(wall=Wall(plate=True, hole=0.0165))).report
    assert [REASONS[index] for index in narrow.reason] == ["reachable", "the arm touches the wall"]


def test_a_link_in_the_way(tmp_path):
    """A ball of 20 mm round the shaft, 80 mm from the tip, meets a plate from x = 8 mm on that the shaft misses.

    The plate is 70 mm below the trocar: at the height of the ball with the tip at 150 mm, but not at 100 mm.
    """
    ball = f'<geom name="knob" size="0.02" pos="0 0 0.08"/>{SITE}'
    table = TABLE.replace('contact = ["shaft"]', 'contact = ["shaft"]\nlinks = ["knob"]')
    kinematics = BatchKinematics(load_arm(write_pivot(tmp_path, table=table, sites=ball), Port()))
    sites = surface_sites([[0.0, 0.0, -0.15], [0.0, 0.0, -0.10]])
    report = evaluate_reach(kinematics, sites, around(organ=plate_at(-0.07, x=0.028))).report
    assert report.reason.tolist() == [4, 0]


def test_ball_touches_from_outside():
    """A ball of 8 mm touches the surface when the tip, its middle, is 8 mm above it."""
    kinematics = BatchKinematics(load_arm("psm_palpator", Port(), tip_radius=0.008))
    assert tip_ball(kinematics) == 0.008
    assert tip_ball(BatchKinematics(load_arm("psm_grasper", Port()))) == 0.0
    reach = evaluate_reach(kinematics, surface_sites([[0.0, 0.0, -0.15]]), around(ball=0.008))
    tip = kinematics.at(reach.report.joints).tip[0]
    assert tip == pytest.approx([0.0, 0.0, -0.142], abs=1e-6)


def test_approaches_of_a_straight_instrument(tmp_path):
    """An arm without a wrist comes from one side only: along the surface's normal it counts one of 32 directions."""
    kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port()))
    report = evaluate_reach(kinematics, surface_sites([[0.0, 0.0, -0.15]]), around()).report
    assert report.approach_share[0] == 1 / 32


def test_distance_of_two_straight_arms(tmp_path):
    """Both straight down 160 mm apart: 160 mm less two radii, inside and outside; and split at the trocar."""
    sides = []
    for x in (0.0, 0.16):
        kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port((x, 0.0, 0.0))))
        sides.append((kinematics, kinematics.at(np.array([[0.0, 0.0, 0.15]]))))
    inside, outside = arm_distances(sides[0], sides[1], np.array([[0.08, 0.0, -0.15]]))
    assert inside[0] == pytest.approx(0.16 - 2 * RADIUS, abs=1e-12)
    assert outside[0] == pytest.approx(0.16 - 2 * RADIUS, abs=1e-12)
    within, without = split_at_trocar(*sides[0])
    assert sorted(within[0, 0, :, 2]) == pytest.approx([-0.15, 0.0], abs=1e-12)
    assert sorted(without[0, 0, :, 2]) == pytest.approx([0.0, 0.20], abs=1e-12)


def test_distance_of_two_arms_that_meet(tmp_path):
    """Both tips at one point, the shafts 2 a apart in angle: without 20 mm from there 2 (20 mm) sin(a) - 2 r.

    At the zone's edge the two shafts' nearest points face each other across the middle.
    """
    depth, half = 0.12, 0.06
    point, sides = np.array([half, 0.0, -depth]), []
    for x in (0.0, 2.0 * half):
        kinematics = BatchKinematics(load_arm(pivot(tmp_path), Port((x, 0.0, 0.0))))
        yaw = math.atan2(-(point[0] - x), depth)
        sides.append((kinematics, kinematics.at(np.array([[yaw, 0.0, math.hypot(half, depth)]]))))
    inside, outside = arm_distances(sides[0], sides[1], point[None])
    assert inside[0] == pytest.approx(2.0 * 0.020 * half / math.hypot(half, depth) - 2 * RADIUS, abs=1e-9)
    assert outside[0] == pytest.approx(2.0 * half - 2 * RADIUS, abs=1e-9)


def test_links_lie_outside_whatever_their_height():
    """The PSM's rail and arc are outside, even where they stand beyond the trocar's plane; its wrist inside."""
    kinematics = BatchKinematics(load_arm("psm_grasper", Port()))
    chain = kinematics.at(kinematics.arm.home[None])
    inside, outside = split_at_trocar(kinematics, chain)
    assert np.isnan(inside[0, ~kinematics.distal]).all()
    assert np.array_equal(outside[0, ~kinematics.distal], chain.shape_ends[0, ~kinematics.distal])
    wrist = kinematics.arm.shape_names.index("wrist")
    assert np.isnan(outside[0, wrist]).all() and not np.isnan(inside[0, wrist]).any()


def test_arms_step_aside_for_each_other():
    """Ports 4 cm apart: where the arms' best stands are too close others are tried, and none that is closer chosen."""
    sites = surface_sites([[0.02 + x, y, -0.12] for x in (-0.03, 0.0, 0.03) for y in (-0.03, 0.0, 0.03)])
    reaches = [
        evaluate_reach(BatchKinematics(load_arm("psm_grasper", Port((x, 0.0, 0.0)))), sites, around())
        for x in (0.0, 0.04)
    ]
    assert all(reach.report.reachable.all() for reach in reaches)
    stands = [(reach.kinematics, reach.kinematics.at(reach.report.joints)) for reach in reaches]
    first = np.minimum(*arm_distances(stands[0], stands[1], sites.points))
    both = evaluate_both(reaches[0], reaches[1], sites.points)
    chosen = np.minimum(both.inside, both.outside)
    assert (first < ARM_DISTANCE).any()
    assert (chosen >= first).all() and (chosen > first)[first < ARM_DISTANCE].any()
    assert both.reachable.tolist() == (chosen >= ARM_DISTANCE).tolist()
