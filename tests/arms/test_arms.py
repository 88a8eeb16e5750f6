"""The whole evaluation: mirrored scenes, repeated runs, and every mistake in one line."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from msdm_core.mesh.tet_mesh import TetMesh
from surgsim_apps.arms.clearance import WORKING_ZONE
from surgsim_apps.arms.ports import (
    CAMERA_DISTANCE,
    PORT_SPACING,
    EndoscopePort,
    InnerTarget,
    PortPlace,
    Ports,
    default_ports,
    ports_from_table,
    read_ports,
)
from surgsim_apps.arms.results import REASONS, ArmReach
from surgsim_apps.arms.study import evaluate_arms, facing_points
from surgsim_apps.patient.fine_surface import split_edges
from surgsim_env.instruments.arm.arm import load_arm
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.arm_description import read_description
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import FineSurface
from tests.arms.pivot_arm import SITE, TABLE, write_pivot

PORTS_FILE = """
[left]
point = [-0.05, 0.03, 0.18]
target = [0.03, 0.03, 0.03]
[right]
point = [0.11, 0.03, 0.18]
into = [-0.08, 0.0, -0.15]
roll = 0.5
[endoscope]
point = [0.03, 0.03, 0.18]
target = [0.03, 0.03, 0.03]
[[targets]]
point = [0.03, 0.03, 0.015]
[wall]
thickness = 0.025
"""


@pytest.fixture(scope="module")
def phantom():
    return load_anatomy(make_scene("phantom"))


@pytest.fixture(scope="module")
def evaluation(phantom):
    return evaluate_both_arms(phantom)


def evaluate_both_arms(phantom):
    targets = (InnerTarget((0.03, 0.03, 0.015)), InnerTarget((0.03, 0.03, -2.0)))
    ports = replace(default_ports(phantom), targets=targets)
    return evaluate_arms(phantom, "psm_palpator", "psm_grasper", ports, count=25)


def arm_figures(arm: ArmReach):
    return {name: getattr(arm, name) for name in vars(arm) if name not in ("name", "joints")}


def test_shapes_and_targets(evaluation, phantom):
    assert evaluation.points.shape == evaluation.normals.shape == (27, 3)
    assert evaluation.inner.tolist() == [False] * 25 + [True] * 2
    for arm in (evaluation.left, evaluation.right):
        for name, values in arm_figures(arm).items():
            assert values.shape == (27,), name
        assert arm.joints.shape == (27, 6)
    assert [REASONS[index] for index in evaluation.left.reason[25:]] == ["reachable", "a joint limit"]
    assert evaluation.both[25:].tolist() == [True, False]
    assert evaluation.scene == "phantom" and evaluation.surface_points is phantom.mesh.points


def test_what_is_reported_is_so(evaluation):
    """At reached points everything is known, the tip is there and both arms keep 5 mm apart."""
    for arm in (evaluation.left, evaluation.right):
        good = arm.reachable
        assert good[:25].all() and not good[26]
        for name, values in arm_figures(arm).items():
            if name not in ("reason", "position_error", "organ_clearance"):
                assert np.isfinite(values[good]).all() and np.isnan(values[~good]).all(), name
        assert arm.position_error[good].max() < 1e-3 and arm.trocar_error[good].max() < 1e-9
        assert (arm.organ_clearance[:25] >= 0.0).all() and (arm.wall_clearance[good] >= 0.0).all()
        assert ((arm.isotropy[good] > 0.0) & (arm.isotropy[good] <= 1.0)).all()
        assert ((arm.limit_margin[good] > 0.0) & (arm.limit_margin[good] <= 1.0)).all()
    both = evaluation.both
    assert (
        both.any()
        and (np.minimum(evaluation.arm_distance_inside, evaluation.arm_distance_outside)[both] >= 0.005).all()
    )


def test_mujoco_agrees_with_what_is_reported(evaluation, phantom):
    """MuJoCo's own kinematics at the reported joints: the tip at its place, limits and trocar kept.

    Points p of the axes outside the tip's zone are |max(|p - c| - h, 0)| from the block of half sizes h, less radii.
    """
    ports, radius = default_ports(phantom), phantom.scene.instrument.tip_radius
    for report, place, ball in ((evaluation.left, ports.left, radius), (evaluation.right, ports.right, 0.0)):
        arm = load_arm(report.name, place.port, tip_radius=radius)
        for row in range(25):
            joints = report.joints[row]
            tip = arm.tip_pose(joints).position
            assert np.linalg.norm(tip - evaluation.points[row] - ball * evaluation.normals[row]) < 1e-3
            assert (joints >= arm.lower).all() and (joints <= arm.upper).all()
            assert arm.trocar_residual(joints) < 1e-9
            ends = arm.shape_ends(joints)
            along = np.linspace(0.0, 1.0, 2001)[:, None]
            axes = ends[:, None, 0] + along * (ends[:, None, 1] - ends[:, None, 0])
            outside = np.linalg.norm(axes - tip, axis=2) > ball + WORKING_ZONE
            beyond = np.maximum(np.abs(axes - [0.03, 0.03, 0.015]) - [0.03, 0.03, 0.015], 0.0)
            gaps = np.where(outside, np.linalg.norm(beyond, axis=2), np.inf) - arm.shape_radius[:, None]
            assert report.organ_clearance[row] == pytest.approx(gaps.min(), abs=5e-5)


@pytest.mark.slow
def test_run_repeats_to_the_byte(evaluation, phantom):
    """Same arguments, same bytes, of every array; another seed, other points."""
    again = evaluate_both_arms(phantom)
    for arm, other in ((evaluation.left, again.left), (evaluation.right, again.right)):
        for name in vars(arm):
            if name != "name":
                assert getattr(arm, name).tobytes() == getattr(other, name).tobytes(), name
    assert evaluation.arm_distance_inside.tobytes() == again.arm_distance_inside.tobytes()
    first = facing_points(phantom, np.array([[0.03, 0.03, 0.2]]), 5, 0)[0]
    assert not np.array_equal(first, facing_points(phantom, np.array([[0.03, 0.03, 0.2]]), 5, 1)[0])


def mirrored_description():
    """The grasper without the links, whose arc stands to one side: the rest of it mirrors into itself."""
    return replace(read_description("psm_grasper"), links=())


def mirrored(anatomy):
    mesh = anatomy.mesh
    points = mesh.points * [-1.0, 1.0, 1.0]
    return Anatomy(anatomy.scene, TetMesh(points, mesh.tets[:, [0, 2, 1, 3]]), anatomy.anchors, anatomy.face)


def mirrored_place(place):
    x, y, z = place.point
    u, v, w = place.into
    return PortPlace((-x, y, z), (-u, v, w), roll=-place.roll)


@pytest.mark.slow
def test_mirrored_scene_has_the_mirrored_report():
    """x to -x, left to right: the same points, reasons and figures, to what the search leaves of rounding."""
    anatomy = load_anatomy(make_scene("liver"))
    ports = Ports(
        PortPlace((-0.07, -0.11, 0.10), (0.35, 0.6, -0.6), roll=0.2),
        PortPlace((0.10, -0.10, 0.11), (-0.4, 0.62, -0.61), roll=-0.1),
        EndoscopePort((0.011, -0.12, 0.12), (0.0, 0.0, 0.0)),
    )
    (x, y, z), (u, v, w) = ports.endoscope.point, ports.endoscope.target
    other_ports = Ports(mirrored_place(ports.right), mirrored_place(ports.left), EndoscopePort((-x, y, z), (-u, v, w)))
    arm = mirrored_description()
    evaluation = evaluate_arms(anatomy, arm, arm, ports, count=30)
    other = evaluate_arms(mirrored(anatomy), arm, arm, other_ports, count=30)
    assert other.points * [-1.0, 1.0, 1.0] == pytest.approx(evaluation.points, abs=1e-12)
    for mine, theirs in ((evaluation.left, other.right), (evaluation.right, other.left)):
        assert mine.reason.tolist() == theirs.reason.tolist()
        assert mine.reachable.any()
        for name, values in arm_figures(mine).items():
            assert getattr(theirs, name) == pytest.approx(values, rel=1e-4, abs=2e-6, nan_ok=True), name
    assert evaluation.both.tolist() == other.both.tolist()
    assert other.arm_distance_inside == pytest.approx(evaluation.arm_distance_inside, abs=2e-6, nan_ok=True)


def test_default_ports_follow_the_rules(phantom):
    ports = default_ports(phantom)
    target, camera = np.array(ports.endoscope.target), np.array(ports.endoscope.point)
    sight = target - camera
    assert np.linalg.norm(sight) == pytest.approx(CAMERA_DISTANCE) and 0.10 <= CAMERA_DISTANCE <= 0.20
    for place in (ports.left, ports.right):
        aside = np.array(place.point) - camera
        assert np.linalg.norm(aside) == pytest.approx(PORT_SPACING) and aside @ sight == pytest.approx(0.0, abs=1e-12)
    assert ports.left.point[0] < ports.right.point[0]


def test_ports_file(tmp_path):
    path = tmp_path / "near.toml"
    path.write_text(PORTS_FILE)
    ports = read_ports(path)
    assert ports.wall.thickness == 0.025
    assert ports.left.port.into == pytest.approx((0.08, 0.0, -0.15))
    assert ports.right.roll == 0.5 and ports.targets[0].point == (0.03, 0.03, 0.015)


def table(**changes):
    base = {
        "left": {"point": [-0.05, 0.03, 0.18], "target": [0.03, 0.03, 0.03]},
        "right": {"point": [0.11, 0.03, 0.18], "target": [0.03, 0.03, 0.03]},
        "endoscope": {"point": [0.03, 0.03, 0.18], "target": [0.03, 0.03, 0.03]},
    }
    return {**base, **changes}


INSIDE = {"point": [0.03, 0.03, 0.015], "into": [0.0, 0.0, -1.0]}
NO_PORT = {"point": [0.0, 0.0, 0.1]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": NO_PORT}, "give exactly one of into and target"),
        ({"left": {**NO_PORT, "into": [0.0, 0.0, 0.0]}}, "into"),
        ({"left": {**NO_PORT, "target": [0.0, 0.0, 0.1]}}, "another, finite point"),
        ({"left": {**NO_PORT, "intoo": [0.0, 0.0, -1.0]}}, "did you mean 'into'"),
        ({"right": {"point": [-0.05, 0.03, 0.18], "into": [0.0, 0.0, -1.0]}}, "move them apart"),
        ({"wall": {"thickness": -0.01}}, "thickness"),
        ({"wall": {"hole": 0.001}}, "hole"),
        ({"wall": {"radius": 0.05}}, "raise wall.radius"),
        ({"endoscope": {"point": [0.0, 0.0, 0.1], "target": [0.0, 0.0, 0.1]}}, "another, finite point"),
    ],
)
def test_bad_ports_are_refused(changes, words):
    with pytest.raises(ValueError, match=r"^ports 'bad': ") as error:
        ports_from_table(table(**changes), name="bad")
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("side", ["left", "right", "endoscope"])
def test_port_inside_the_organ_is_refused(phantom, side):
    inside = {"point": [0.03, 0.03, 0.015], "target": [0.03, 0.03, 0.03]}
    with pytest.raises(ValueError, match=rf"the {side} port at \(30.0, 30.0, 15.0\) mm lies inside the organ"):
        evaluate_arms(phantom, "psm_palpator", "psm_palpator", ports_from_table(table(**{side: inside}), name="in"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sites": ""}, "tip site 'tip' is not in the model"),
        ({"sites": SITE + SITE}, "repeated name 'tip' in site"),
        ({"table": TABLE.replace("slide = 0.1", "slide = 0.3")}, "outside its limits"),
        ({"table": TABLE.replace("slide = 0.1", "")}, "home gives no value for joint 'slide'"),
        ({"table": TABLE.replace('"palpator"', '"grasper"')}, "a grasper needs a jaw"),
        ({"model": "limits"}, "joint 'slide' has no limits, or limits that cross"),
    ],
)
def test_bad_arms_are_refused(tmp_path, phantom, changes, words):
    from tests.arms.pivot_arm import FAR, MODEL, NEAR

    if changes.get("model") == "limits":
        changes = {"model": MODEL.replace(f'range="{NEAR} {FAR}"', f'range="{FAR} {NEAR}"')}
    path = write_pivot(tmp_path, **changes)
    with pytest.raises(ValueError, match="arm 'pivot'") as error:
        evaluate_arms(phantom, "psm_palpator", path)
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scene": "phantm"}, "did you mean 'phantom'"),
        ({"left": "psm_graspr"}, "psm_grasper"),
        ({"ports": "nowhere.toml"}, "cannot be read"),
    ],
)
def test_bad_arguments_are_refused(arguments, words):
    given = {"scene": "phantom", "left": "psm_grasper", "right": "psm_grasper", **arguments}
    with pytest.raises(ValueError, match=words):
        evaluate_arms(**given)


def test_points_face_the_ports_and_lie_even(phantom):
    """On the free top of the block: at even spacing no point is nearer than 0.6 to its neighbour (blue noise)."""
    points, normals = facing_points(phantom, np.array([[0.03, 0.03, 0.2]]), 100, 3)
    assert points[:, 2] == pytest.approx(0.03) and normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (100, 1)))
    gaps = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(gaps, np.inf)
    even = np.sqrt(0.06 * 0.06 / 100)
    assert gaps.min() > 0.6 * even
    quarters = np.histogram2d(points[:, 0], points[:, 1], bins=2, range=[[0, 0.06], [0, 0.06]])[0]
    assert quarters.min() > 18


def test_no_point_faces_ports_below_the_tray(phantom):
    with pytest.raises(ValueError, match="no free part of the organ's surface faces the ports"):
        facing_points(phantom, np.array([[0.03, 0.03, -0.2]]), 10, 0)


def test_ports_too_far_off_reach_nothing(phantom, evaluation):
    """From 30 cm above nothing is reached."""
    up = table(
        left={"point": [-0.05, 0.03, 0.33], "target": [0.03, 0.03, 0.03]},
        right={"point": [0.11, 0.03, 0.33], "target": [0.03, 0.03, 0.03]},
    )
    far = evaluate_arms(phantom, "psm_palpator", "psm_grasper", ports_from_table(up, name="far"), count=5)
    assert not (far.left.reachable | far.right.reachable).any()
    assert evaluation.both.mean() > 0.5


def test_pictures_show_the_fine_surface(phantom, tmp_path):
    mesh, scene = phantom.mesh, phantom.scene
    vertices, faces = split_edges(mesh.points, mesh.boundary_triangles, 0.004)
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "own.ply")
    fine = FineSurface(str(tmp_path / "own.ply"), "m")
    anatomy = load_anatomy(replace(scene, mesh=replace(scene.mesh, fine_surface=fine)))
    evaluation = evaluate_arms(anatomy, "psm_grasper", "psm_grasper", count=2)
    assert len(evaluation.surface_triangles) == len(faces) > len(mesh.boundary_triangles)
    other = evaluate_arms(phantom, "psm_grasper", "psm_grasper", count=2)
    np.testing.assert_array_equal(evaluation.points, other.points)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["phantom", "liver"])
def test_five_hundred_points(scene):
    """Two da Vinci-like arms at their default ports reach most of what faces them."""
    evaluation = evaluate_arms(scene, "psm_palpator", "psm_palpator", count=500)
    assert evaluation.both.mean() > 0.9
