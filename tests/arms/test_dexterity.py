"""Dexterity of an arm with a closed form for everything."""

import math

import numpy as np
import pytest

from surgsim_apps.arms import reach
from surgsim_apps.arms.joint_search import DIRECTION_COUNT, approach_directions, directions_met
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene.model import Port
from tests.arms.pivot_arm import EFFORT, FAR, NEAR, OUTER, PITCH, YAW, pivot

LENGTH = reach.CHARACTERISTIC_LENGTH


@pytest.fixture
def kinematics(tmp_path):
    return BatchKinematics(load_arm(pivot(tmp_path), Port()))


def test_manipulability_and_isotropy(kinematics):
    """Columns of J at depth d and pitch b: yaw (d cos b, L), pitch (d, L), slide (1, 0), all perpendicular."""
    pitch, depth = 0.3, 0.12
    values = reach.scaled_singular_values(kinematics, kinematics.at(np.array([[0.2, pitch, depth]])))
    lengths = sorted([math.hypot(depth * math.cos(pitch), LENGTH), math.hypot(depth, LENGTH), 1.0], reverse=True)
    assert values[0] == pytest.approx(lengths, rel=1e-12)
    assert reach.manipulability(values)[0] == pytest.approx(math.prod(lengths), rel=1e-12)
    assert reach.isotropy(values)[0] == pytest.approx(lengths[-1] / lengths[0], rel=1e-12)


def test_trocar_by_control_takes_two_freedoms():
    """Six joints less two of the trocar leave four motions; the tip of a straight tool can still go anywhere."""
    arm = load_arm("six_axis", Port())
    kinematics = BatchKinematics(arm)
    chain = kinematics.at(arm.home[None])
    values = reach.scaled_singular_values(kinematics, chain)
    assert values.shape == (1, 4)
    linear, _ = kinematics.tip_jacobian(chain)
    assert np.linalg.matrix_rank(linear[0]) == 3
    assert (values > 0.0).all()


def test_limit_margin(kinematics):
    middle, high = [0.0, 0.0, 0.5 * (NEAR + FAR)], [YAW, 0.0, 0.1]
    quarter = [0.5 * YAW, -0.5 * PITCH, 0.5 * (NEAR + FAR)]
    margin = reach.limit_margin(kinematics, np.array([middle, high, quarter]))
    assert margin == pytest.approx([1.0, 0.0, 0.75**2], abs=1e-12)  # 4 (3/4)(1/4) = 3/4


def test_tip_force(kinematics):
    """Straight at depth d: along the shaft the slide's force, across it torque over d."""
    depth = 0.1
    chain = kinematics.at(np.array([[0.0, 0.0, depth]] * 4))
    across = np.array([math.sqrt(0.5), 0.0, -math.sqrt(0.5)])
    force = reach.tip_force(kinematics, chain, np.array([[0.0, 0.0, -1.0], [1.0, 0, 0], [0, 1.0, 0], across]))
    slanted = min(EFFORT[2], EFFORT[0] / depth) * math.sqrt(2.0)
    assert force == pytest.approx([EFFORT[2], EFFORT[0] / depth, EFFORT[1] / depth, slanted], rel=1e-12)


def test_trocar_load(kinematics):
    """A lever of inner length d and outer length o: (d + o) / o times the sideways force, nothing for one along it."""
    depth = 0.1
    outer = OUTER + 0.1 - depth
    chain = kinematics.at(np.array([[0.0, 0.0, depth]] * 3))
    load = reach.trocar_load(kinematics, chain, np.array([[1.0, 0, 0], [0, 0, -1.0], [0.6, 0.0, -0.8]]))
    assert load == pytest.approx([(depth + outer) / outer, 0.0, 0.6 * (depth + outer) / outer], abs=1e-12)


def test_camera_angle(kinematics):
    """The shaft straight down to a point; the camera 8 cm beside the trocar, 15 cm above the point: atan(8 / 15)."""
    chain = kinematics.at(np.array([[0.0, 0.0, 0.15]]))
    angle = reach.camera_angle(chain, np.array([[0.0, 0.0, -0.15]]), np.array([0.08, 0.0, 0.0]))
    assert angle[0] == pytest.approx(math.atan2(0.08, 0.15), abs=1e-12)


def test_directions_fill_the_half_space():
    """Unit, outward, spread evenly: the mean of equal shares of a half sphere is n / 2, its second moment 1/3 each."""
    normals = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    directions = approach_directions(normals, np.array([[1.0, 0.2, 0.5]] * 2), np.array([1.0, 0.0, 0.0]))
    assert directions.shape == (2, DIRECTION_COUNT, 3)
    assert np.linalg.norm(directions, axis=2) == pytest.approx(1.0)
    assert (np.einsum("ndi,ni->nd", directions, normals) > 0.2).all()
    assert directions.mean(axis=1) == pytest.approx(0.5 * normals, abs=0.01)
    moment = np.einsum("ndi,ndj->nij", directions, directions) / DIRECTION_COUNT
    assert moment == pytest.approx(np.broadcast_to(np.eye(3) / 3.0, (2, 3, 3)), abs=0.02)


def test_directions_mirror():
    """Mirrored normals and lines of sight give the mirrored set, even where the normal looks right at the camera."""
    mirror = np.array([-1.0, 1.0, 1.0])
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    towards, line = rng.normal(size=(5, 3)), np.array([1.0, 0.0, 0.0])
    mirrored = approach_directions(normals, towards, line) * mirror
    direct = approach_directions(normals * mirror, towards * mirror, line)
    for mine, theirs in zip(mirrored, direct, strict=True):
        gaps = np.linalg.norm(mine[:, None] - theirs, axis=2)
        assert gaps.min(axis=1).max() < 1e-12


def test_looking_right_at_the_camera_uses_the_line():
    directions = approach_directions(
        np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 0.2]]), np.array([1.0, 0.0, 0.0])
    )
    assert np.isfinite(directions).all()
    assert directions[0, 1, 1] == pytest.approx(0.0, abs=1e-12) and directions[0, 1, 0] > 0.0


def test_approach_share_counts_usable_tips():
    directions = approach_directions(
        np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 1.0]]), np.array([1.0, 0.0, 0.0])
    )
    usable, single = np.ones((1, 5), dtype=bool), np.ones((1, 1), dtype=bool)
    pointing = -directions[:, :5]
    assert directions_met(pointing, usable, directions).sum() == 5
    assert not directions_met(pointing, ~usable, directions).any()
    turned = -directions[:, :1] + [[[0.0, math.tan(math.radians(9.9)), 0.0]]]
    turned /= np.linalg.norm(turned, axis=2)[..., None]
    assert directions_met(turned, single, directions).sum() == 1
    turned = -directions[:, :1] + [[[0.0, math.tan(math.radians(10.1)), 0.0]]]
    turned /= np.linalg.norm(turned, axis=2)[..., None]
    assert not directions_met(turned, single, directions).any()
