"""The move of a port that a report proposes lets both arms reach more, by the full evaluation too."""

import numpy as np
import pytest

from surgsim_apps.arms.capability import Capability
from surgsim_apps.arms.clearance import Obstacles
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.port_moves import best_move, moved_port
from surgsim_apps.arms.port_search import on_one_wall
from surgsim_apps.arms.ports import default_ports
from surgsim_apps.arms.quick_reach import QuickReach
from surgsim_apps.arms.reach import evaluate_both, evaluate_reach
from surgsim_apps.arms.study import find_sites
from surgsim_apps.reports.surface_drawing import OrthographicView
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import load_anatomy, make_scene
from tests.arms.pivot_arm import pivot

COUNT = 40


@pytest.fixture(scope="module")
def anatomy():
    return load_anatomy(make_scene("phantom"))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """An arm of three joints, which reaches 20 cm past its trocar."""
    return Capability(pivot(tmp_path_factory.mktemp("pivot")), 0.004)


@pytest.fixture(scope="module")
def quick(anatomy, table):
    usual = on_one_wall(default_ports(anatomy))
    sites = find_sites(anatomy, usual, COUNT, 0)
    return QuickReach(anatomy, dict.fromkeys(SIDES, table), Obstacles.of(anatomy, usual), sites)


def reached(quick, anatomy, table, ports):
    """Mask of the points that both arms reach by the full evaluation."""
    reaches = []
    for side in SIDES:
        arm = load_arm(table.kinematics.arm.description, getattr(ports, side).port)
        reaches.append(evaluate_reach(BatchKinematics(arm), quick.sites, Obstacles.of(anatomy, ports)))
    return evaluate_both(reaches[0], reaches[1], quick.sites.points).reachable


def test_a_port_too_far_aside_is_moved_back(quick, anatomy, table):
    """The left port 4 cm too far to the left: 2 cm to the right, and both reach more."""
    usual = on_one_wall(default_ports(anatomy))
    line = np.array(usual.right.point) - usual.left.point
    line /= np.linalg.norm(line)
    poor = moved_port(usual, "left", -0.04 * line)
    both, view = reached(quick, anatomy, table, poor), OrthographicView.along(-np.array([0.0, 0.0, 1.0]))
    move = best_move(quick, poor, both, view)
    assert (move.side, move.words) == ("left", "2 cm to the right")
    assert move.shift @ line == pytest.approx(0.02, abs=1e-3)
    assert move.before == both.mean()
    after = reached(quick, anatomy, table, moved_port(poor, move.side, move.shift)).mean()
    assert move.after == pytest.approx(after, abs=0.05)
    assert after >= move.before + 0.05


def test_no_move_is_proposed_where_both_reach_all(quick, anatomy):
    usual, view = on_one_wall(default_ports(anatomy)), OrthographicView.along(-np.array([0.0, 0.0, 1.0]))
    assert best_move(quick, usual, np.ones(COUNT, dtype=bool), view) is None
