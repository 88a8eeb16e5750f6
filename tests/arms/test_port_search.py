"""Search for ports: its quick reach is the full evaluation's, and the ports that it finds lie on the wall and serve."""

import math
from dataclasses import replace

import numpy as np
import pytest

from surgsim_apps.arms.capability import BASE_SHIFT, Capability, DistanceField, shifted_bases
from surgsim_apps.arms.clearance import Obstacles, wall_clearance
from surgsim_apps.arms.kinematics import BatchKinematics
from surgsim_apps.arms.port_search import ANGLE_MOST, ORGAN_APART, PORTS_APART, PortSearch, on_one_wall
from surgsim_apps.arms.ports import SurfaceSource, Wall, default_ports, ports_from_table, read_ports
from surgsim_apps.arms.quick_reach import QuickReach
from surgsim_apps.arms.reach import Sites, evaluate_both, evaluate_reach
from surgsim_apps.arms.results import REASONS
from surgsim_apps.arms.study import find_sites
from surgsim_apps.reports.surface_drawing import tube
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import CyclicMotion, Port, as_toml, load_anatomy, make_scene, read_description
from surgsim_env.step_progress import StepProgress
from tests.arms.pivot_arm import FAR, MODEL, NEAR, SITE, pivot, write_pivot

COUNT = 24


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """What an arm of three joints reaches, 4 to 20 cm past its trocar."""
    return Capability(pivot(tmp_path_factory.mktemp("pivot")), 0.004)


@pytest.fixture(scope="module")
def anatomy():
    return load_anatomy(make_scene("phantom"))


def moved(ports, **shifts):
    """Ports with some of them shifted [m]."""
    places = {side: getattr(ports, side) for side in shifts}
    points = {side: tuple((np.array(place.point) + shifts[side]).tolist()) for side, place in places.items()}
    return replace(ports, **{side: replace(place, point=points[side]) for side, place in places.items()})


def quick_reach(anatomy, table, ports):
    sites = find_sites(anatomy, ports, COUNT, 0)
    return QuickReach(anatomy, dict.fromkeys(SIDES, table), Obstacles.of(anatomy, ports), sites)


def full(quick, anatomy, table, ports):
    """Masks of the left arm, the right one and both by the full evaluation."""
    description = table.kinematics.arm.description
    reaches = []
    for side in SIDES:
        kinematics = BatchKinematics(load_arm(description, getattr(ports, side).port, tip_radius=0.004))
        reaches.append(evaluate_reach(kinematics, quick.sites, Obstacles.of(anatomy, ports)))
    both = evaluate_both(reaches[0], reaches[1], quick.sites.points).reachable
    return reaches[0].report.reachable, reaches[1].report.reachable, both


def test_quick_reach_is_that_of_the_full_evaluation(anatomy, table):
    """Three placements at once, of an arm with one way to each point; points at the joints' limits apart."""
    usual = on_one_wall(default_ports(anatomy))
    slight = moved(usual, left=(-0.01, 0.01, 0.0), right=(0.02, 0.0, 0.0))
    places = [usual, moved(usual, left=(-0.02, 0.0, 0.0)), slight]
    quick = quick_reach(anatomy, table, usual)
    figures = quick.evaluate(places)
    assert 0.2 < figures.both[1].mean() < figures.both[0].mean()
    for row, ports in enumerate(places):
        for mask, exact in zip(
            (figures.left, figures.right, figures.both), full(quick, anatomy, table, ports), strict=True
        ):
            # A touch of the organ may be judged otherwise at one point.
            assert (mask[row] != exact).mean() <= 0.05


def test_a_search_finds_ports_from_which_both_reach_all(anatomy, table):
    """The left port 3 cm too far aside; the full evaluation confirms the ports found."""
    poor = on_one_wall(moved(default_ports(anatomy), left=(-0.03, 0.0, 0.0)))
    quick = quick_reach(anatomy, table, poor)
    search = PortSearch(anatomy, quick, poor, dict.fromkeys(SIDES, (table,)))
    found = search.run(60.0, 0, StepProgress())
    best = found.best.ports
    assert found.given.share < 0.7 and found.best.share >= 0.95
    assert full(quick_reach(anatomy, table, poor), anatomy, table, best)[2].mean() >= 0.95
    assert found.gains["left"] > found.given.share
    # On the dome, apart from each other and the organ, within the cone, the left one left.
    target, out = np.array(poor.endoscope.target), np.array(poor.endoscope.point) - poor.endoscope.target
    points = {name: np.array(port.point) for name, port in best.frames.items()}
    for point in points.values():
        assert np.linalg.norm(point - poor.dome_centre) == pytest.approx(poor.wall.radius)
        assert np.linalg.norm(anatomy.mesh.points - point, axis=1).min() >= ORGAN_APART
        away = point - target
        cosine = away @ out / (np.linalg.norm(away) * np.linalg.norm(out))
        assert cosine >= 1.0 / math.hypot(1.0, math.sqrt(2.0) * math.tan(ANGLE_MOST))
    apart = [np.linalg.norm(points[a] - points[b]) for a, b in (SIDES, ("left", "endoscope"), ("right", "endoscope"))]
    assert min(apart) >= PORTS_APART
    line = np.array(poor.right.point) - poor.left.point
    assert (points["right"] - points["left"]) @ line > 0.0
    # No placement of the front is better than another in all figures.
    figures = np.array([[each.share, each.clearance, each.dexterity] for each in found.front])
    for row in figures:
        assert not ((figures >= row).all(axis=1) & (figures > row).any(axis=1)).any() or len(figures) == 1
    assert search.run(60.0, 0, StepProgress()) == found


def test_a_search_puts_the_base_where_the_arm_reaches_more(anatomy, table, tmp_path):
    """Tables of a slide that ends at 12 cm, as given to the left arm, and of one that ends at 20 cm."""
    model = MODEL.replace(f'range="{NEAR} {FAR}"', f'range="{NEAR} 0.12"')
    short = read_description(write_pivot(tmp_path, model=model, sites=SITE))
    usual, short_table = on_one_wall(default_ports(anatomy)), Capability(short, 0.004)
    quick = quick_reach(anatomy, table, usual)
    best = quick.evaluate([usual]).share[0]
    quick.tables = {"left": short_table, "right": table}
    given = quick.evaluate([usual]).share[0]
    assert given < best
    search = PortSearch(anatomy, quick, usual, {"left": (short_table, table), "right": (table, short_table)})
    found = search.run(1.0, 0, StepProgress())
    assert (found.given.share, found.gains["bases"]) == (given, best)
    assert quick.tables == dict.fromkeys(SIDES, table)
    assert found.arms == {"left": table.kinematics.arm.description}
    assert found.best.share == quick.evaluate([found.best.ports]).share[0]


def test_bases_beside_their_place_keep_the_shaft_in_the_trocar():
    """`load_arm` refuses a home that misses the trocar; the base of a mechanism with a remote centre stays."""
    arm = read_description("six_axis")
    bases = shifted_bases(arm)
    shifts = [np.array(base.trocar.point) - arm.trocar.point for base in bases]
    x, y = BASE_SHIFT * np.eye(3)[:2]
    assert np.array(shifts) == pytest.approx(np.array([x, -x, y, -y]), abs=1e-12)
    depth = -load_arm(arm).tip_pose(load_arm(arm).home).position[2]
    for base in bases:
        # The tip is as far past its trocar as it was.
        assert load_arm(base).tip_pose(load_arm(base).home).position == pytest.approx([0.0, 0.0, -depth], abs=1e-6)
    assert shifted_bases(read_description("psm_grasper")) == []


def test_ports_found_are_read_from_their_file_as_they_were(anatomy, tmp_path):
    usual = replace(on_one_wall(default_ports(anatomy)), obstacles=(SurfaceSource("/rib.stl", "mm"),))
    (tmp_path / "ports.toml").write_text(as_toml(usual))
    assert read_ports(tmp_path / "ports.toml") == usual


def test_a_point_that_a_breath_takes_out_of_reach_is_not_reached(table):
    """Depths of 185, 195 and 197 mm past a trocar, of 200 mm at most; the organ goes 8 mm down at its top."""
    breath = CyclicMotion("breathing", (0.0, 0.0, -0.008), (4.0, 5.0), 0.33, 0.40, size=(1.0, 1.0))
    still = make_scene("phantom")
    port = Port((1.0, 1.0, 1.0))
    points = np.array(port.point) - np.array([0.185, 0.195, 0.197])[:, None] * np.array([0.0, 0.0, 1.0])
    sites = Sites(points, np.tile([0.0, 0.0, 1.0], (3, 1)), np.zeros(3, dtype=bool))
    reached = []
    for scene in (still, replace(still, motions=(breath,))):
        anatomy = load_anatomy(scene)
        around = Obstacles.of(anatomy, replace(default_ports(anatomy), wall=Wall(plate=True, thickness=0.0, hole=10.0)))
        reached.append(QuickReach(anatomy, {"left": table}, around, sites).alone("left", [port])[0].tolist())
    assert reached == [[True, True, True], [True, False, False]]


def test_a_view_ends_at_the_organ(anatomy, table):
    quick = quick_reach(anatomy, table, default_ports(anatomy))
    above = np.array(default_ports(anatomy).endoscope.point)
    assert quick.seen_from(above) == 1.0
    beneath = 2.0 * anatomy.mesh.points.mean(axis=0) - above
    assert quick.seen_from(beneath) == 0.0


def test_distance_field_of_a_ball():
    """Radius less the distance from the middle, to a share of the grid's step; inf beyond the margin."""
    points, triangles = tube(np.zeros(3), np.zeros(3), 0.05)
    field = DistanceField(points, triangles, 0.02)
    places = np.random.default_rng(0).uniform(-0.04, 0.04, (200, 3))
    places = places[np.linalg.norm(places, axis=1) > 0.02]
    np.testing.assert_allclose(field.at(places), np.linalg.norm(places, axis=1) - 0.05, atol=0.002)
    assert field.at(np.array([[0.2, 0.0, 0.0]])) == np.inf


# ---- a patient's own skin and obstacles ------------------------------------------------------------------------------


@pytest.fixture
def skin_file(tmp_path, anatomy):
    """A ball about the organ as the body's surface, in millimetres."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=180.0)
    ball.apply_translation(1e3 * anatomy.mesh.points.mean(axis=0))
    ball.export(tmp_path / "skin.stl")
    return tmp_path / "skin.stl"


def test_ports_lie_on_a_skin(anatomy, table, skin_file):
    wall = Wall(skin=SurfaceSource(str(skin_file), "mm"))
    ports = replace(default_ports(anatomy), wall=wall)
    found = PortSearch(anatomy, quick_reach(anatomy, table, ports), ports, dict.fromkeys(SIDES, (table,))).run(
        3.0, 0, StepProgress()
    )
    middle = anatomy.mesh.points.mean(axis=0)
    for port in found.best.ports.frames.values():
        assert np.linalg.norm(np.array(port.point) - middle) == pytest.approx(0.18, abs=1e-3)


def test_clearance_from_a_skin_is_that_from_its_sphere(anatomy, skin_file):
    ports = replace(default_ports(anatomy), wall=Wall(thickness=0.01, skin=SurfaceSource(str(skin_file), "mm")))
    around, middle = Obstacles.of(anatomy, ports), anatomy.mesh.points.mean(axis=0)
    segments = middle + np.array([[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], [[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]]])
    gaps = wall_clearance(ports, segments, np.array([1.0, 1.0, 1.0]), around.skin)
    assert gaps == pytest.approx([0.18 - 0.1 - 0.005, -0.005], abs=1e-3)
    hole = middle + np.array([0.0, 0.0, 0.18])
    assert wall_clearance(ports, segments[1:], hole, around.skin) > 0.01


def test_an_obstacle_takes_points_out_of_reach(anatomy, table, tmp_path):
    """A bar between the left port and the organ; the right arm reaches as before."""
    import trimesh

    usual = on_one_wall(default_ports(anatomy))
    middle = 0.5 * (np.array(usual.left.point) + usual.left.target)
    bar = trimesh.creation.box((0.08, 0.08, 0.01))
    bar.apply_translation(middle)
    bar.export(tmp_path / "bar.stl")
    barred = replace(usual, obstacles=(SurfaceSource(str(tmp_path / "bar.stl")),))
    free, blocked = (quick_reach(anatomy, table, ports).evaluate([usual]) for ports in (usual, barred))
    assert free.left.any() and not blocked.left.any()
    assert (free.right == blocked.right).all()
    kinematics = BatchKinematics(load_arm(table.kinematics.arm.description, usual.left.port, tip_radius=0.004))
    sites = find_sites(anatomy, usual, COUNT, 0)
    clear, stopped = (evaluate_reach(kinematics, sites, Obstacles.of(anatomy, each)).report for each in (usual, barred))
    assert {REASONS[reason] for reason in stopped.reason[clear.reachable]} == {"the arm touches another obstacle"}


def test_a_skin_is_a_label_of_a_scan(tmp_path):
    """A ball of 40 mm in voxels of 4 mm, in LPS."""
    import nibabel

    grid = np.stack(np.meshgrid(*[np.arange(30)] * 3, indexing="ij"), axis=-1)
    labels = (np.linalg.norm(4.0 * (grid - 14.5), axis=-1) < 40.0).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(labels, np.diag([-4.0, -4.0, 4.0, 1.0])), tmp_path / "body.nii.gz")
    points, triangles = SurfaceSource(str(tmp_path / "body.nii.gz"), label="1").read()
    away = np.linalg.norm(points - 4e-3 * 14.5, axis=1)
    assert away == pytest.approx(0.04, abs=0.003)
    assert len(triangles) > 1000


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"wall": {"plate": True, "skin": {"file": "skin.stl"}}}, "plate and skin"),
        ({"wall": {"skin": {"file": "scan.nii.gz"}}}, "label"),
        ({"obstacles": [{"file": "rib.stl", "label": "rib"}]}, "label"),
    ],
)
def test_wrong_surfaces_are_refused(entries, message):
    table = {
        "left": {"point": [0.0, 0.0, 0.2], "into": [0.0, 0.0, -1.0]},
        "right": {"point": [0.1, 0.0, 0.2], "into": [0.0, 0.0, -1.0]},
        "endoscope": {"point": [0.05, 0.0, 0.2], "target": [0.05, 0.0, 0.0]},
    }
    with pytest.raises(ValueError, match=message):
        ports_from_table({**table, **entries}, name="mine")
