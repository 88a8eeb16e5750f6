"""The move of a port that a report proposes lets both arms reach more, by the full evaluation too."""

import numpy as np
import pytest

from surgsim_apps.arms.clearance import ClusteredSurface, Obstacles
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.port_moves import PortSearch, moved_port
from surgsim_apps.arms.ports import default_ports
from surgsim_apps.arms.reach import Sites, evaluate_both, evaluate_reach
from surgsim_apps.arms.study import facing_points
from surgsim_apps.reports.surface_drawing import OrthographicView
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import load_anatomy, make_scene
from tests.arms.pivot_arm import pivot

COUNT = 40


@pytest.fixture
def search(tmp_path):
    """Two arms of three joints on a flat organ, which reach 20 cm past their trocars."""
    anatomy = load_anatomy(make_scene("phantom"))
    usual = default_ports(anatomy)
    points, normals = facing_points(anatomy, [usual.left.point, usual.right.point], COUNT, 0)
    organ = ClusteredSurface(anatomy.mesh.points, anatomy.mesh.boundary_triangles)
    return PortSearch(
        dict.fromkeys(SIDES, pivot(tmp_path)), anatomy, organ, Sites(points, normals, np.zeros(COUNT, dtype=bool))
    )


def best_move(search, ports):
    found = {side: search.reach_from_port(side, ports, np.arange(COUNT)) for side in SIDES}
    both = evaluate_both(found["left"], found["right"], search.sites.points).reachable
    scope = np.array(ports.endoscope.target) - ports.endoscope.point
    return search.best_move(ports, found, both, OrthographicView.along(scope)), both.mean()


def share(search, ports):
    """Share of the points that both arms reach by the full evaluation."""
    reaches = []
    for side in SIDES:
        kinematics = BatchKinematics(load_arm(search.arms[side], getattr(ports, side).port))
        reaches.append(evaluate_reach(kinematics, search.sites, Obstacles(search.organ, ports, 0.0)))
    return evaluate_both(reaches[0], reaches[1], search.sites.points).reachable.mean()


def test_a_port_too_far_aside_is_moved_back(search):
    """The left port 4 cm too far to the left: 2 cm to the right, and both reach more."""
    usual = default_ports(search.anatomy)
    line = np.array(usual.right.point) - usual.left.point
    line /= np.linalg.norm(line)
    poor = moved_port(usual, "left", -0.04 * line)
    move, before = best_move(search, poor)
    assert (move.side, move.words) == ("left", "2 cm to the right")
    assert move.shift @ line == pytest.approx(0.02, abs=1e-3)
    assert move.before == before == share(search, poor)
    # The confirming sample holds all points here.
    assert move.after == pytest.approx(share(search, moved_port(poor, move.side, move.shift)))
    assert move.after >= before + 0.05


def test_no_move_is_proposed_where_both_reach_all(search):
    usual = default_ports(search.anatomy)
    move, _ = best_move(search, usual)
    good = moved_port(usual, move.side, move.shift)
    assert best_move(search, good) == (None, 1.0)
