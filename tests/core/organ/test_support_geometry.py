"""The solids that organs rest on: depth and normal against a slow oracle, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.kernels.support_kernels import add_support_forces
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.support import SIZES, Support, SupportLaw
from tests.core import oracle

CELL = 0.005
LAW = SupportLaw(1e7, 0.0)


def organ(*supports: Support, law: SupportLaw = LAW, anchors: object = ()) -> OrganModel:
    mesh = box_mesh((0.02, 0.01, 0.01), (4, 2, 2))
    if anchors == "all":
        anchors = np.arange(mesh.node_count)
    return compile_organ(OrganSpec(mesh, oracle.TISSUE, supports=supports, support_law=law, anchors=anchors))


def push(model: OrganModel, position, velocity, force, stretch, dt) -> None:
    """`add_support_forces` of solids that stand still."""
    ground = np.stack([model.support_position, np.zeros_like(model.support_position)], axis=1)
    load, before = np.zeros_like(model.support_position), force.sum(axis=0)
    add_support_forces(model, ground, position, velocity, force, stretch, load, dt)
    np.testing.assert_allclose(load.sum(axis=0), force.sum(axis=0) - before, atol=1e-12 * np.abs(force).sum())


def outline(support: Support, random: np.random.Generator, count: int = 20000) -> np.ndarray:
    """Random points all over a solid's surface in its own frame [m], shape (count, 3)."""
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    if support.kind == "sphere":
        return support.size[0] * directions
    if support.kind == "capsule":
        radius, half = support.size
        # Round ends, and the wall between them.
        points = radius * directions + half * np.sign(directions[:, 2:]) * np.array([0.0, 0.0, 1.0])
        wall = random.random(count) < 0.5
        round_ = directions[wall, :2] / np.linalg.norm(directions[wall, :2], axis=1)[:, None]
        points[wall] = np.column_stack([radius * round_, random.uniform(-half, half, wall.sum())])
        return points
    half = np.array(support.size)
    points = random.uniform(-half, half, (count, 3))
    face = random.integers(0, 3, count)
    points[np.arange(count), face] = random.choice([-1.0, 1.0], count) * half[face]
    return points


def inside(support: Support, point: np.ndarray) -> bool:
    """True if a point lies in a solid, in its own frame."""
    if support.kind == "plane":
        return bool(point[2] < 0.0)
    if support.kind == "box":
        return bool((np.abs(point) < support.size).all())
    if support.kind == "sphere":
        return bool(point @ point < support.size[0] ** 2)
    radius, half = support.size
    axis = np.linspace(-half, half, 4001)[:, None] * [0.0, 0.0, 1.0]
    return bool(np.linalg.norm(point - axis, axis=1).min() < radius)


numbers = st.floats(-1.0, 1.0, allow_nan=False)


@settings(max_examples=80, deadline=None)
@given(
    kind=st.sampled_from(sorted(SIZES)),
    sizes=st.tuples(*[st.floats(0.006, 0.02)] * 3),
    place=st.tuples(numbers, numbers, numbers),
    turn=st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.1),
    seed=st.integers(0, 2**32 - 1),
)
def test_nodes_are_pushed_out_the_nearest_way(kind, sizes, place, turn, seed):
    """The force on each node is k_p A d n, none outside; d n leads to the surface, of which no point is nearer."""
    support = Support(
        "solid", kind, position=tuple(0.01 * np.array(place)), rotation=turn, size=sizes[: len(SIZES[kind])]
    )
    model = organ(support)
    force, stretch = np.zeros_like(model.node_rest_position), np.zeros((len(model.support_nodes), 1, 3))
    push(model, model.node_rest_position, np.zeros_like(force), force, stretch, 1e-4)
    assert not stretch.any()
    w, x, y, z = turn
    back = Rotation.from_quat([x, y, z, w]).inv()
    local = back.apply(model.node_rest_position[model.support_nodes] - support.position)
    step = back.apply(force[model.support_nodes]) / (LAW.stiffness * model.support_area[:, None])
    surface = None if kind == "plane" else outline(support, np.random.default_rng(seed))
    for point, out in zip(local, step, strict=True):
        depth = float(np.linalg.norm(out))
        if not inside(support, point):
            assert depth < 1e-7
            continue
        if surface is None:
            np.testing.assert_allclose(out, [0.0, 0.0, -point[2]], atol=1e-12)
            continue
        assert np.linalg.norm(surface - point, axis=1).min() > depth - 1e-9
        assert not inside(support, point + 1.001 * out + 1e-9 * out / max(depth, 1e-12))
        assert depth < 1e-7 or inside(support, point + 0.999 * out)


def test_what_parts_from_a_support_forgets_where_it_stuck():
    """A node's stretch grows with its path across, u = v t, is cut at mu N / (k_t A), and is 0 once it is outside."""
    floor = Support("floor", "plane", position=(0.0, 0.0, 0.001), friction=0.5)
    model = organ(floor)
    position, force = model.node_rest_position.copy(), np.zeros_like(model.node_rest_position)
    sideways, stretch = np.zeros_like(force), np.zeros((len(model.support_nodes), 1, 3))
    sideways[:, 0] = 0.1
    low = position[model.support_nodes, 2] < 0.001
    for count in range(1, 4):
        push(model, position, sideways, force, stretch, 1e-3)
        np.testing.assert_allclose(stretch[low, 0], [[1e-4 * count, 0.0, 0.0]] * int(low.sum()), atol=1e-15)
    assert not stretch[~low].any()
    # 1 mm deep: mu k_p d / k_t = 0.5 x 2 x 1 mm.
    push(model, position, 100.0 * sideways, force, stretch, 1e-3)
    np.testing.assert_allclose(stretch[low, 0, 0], 1e-3, rtol=1e-12)
    push(model, position + np.array([0.0, 0.0, 0.002]), sideways, force, stretch, 1e-3)
    assert not stretch.any()


@pytest.mark.parametrize(("speed", "share"), [(-0.01, 1.1), (0.0, 1.0), (0.05, 0.5), (0.2, 0.0)])
def test_damping_pushes_what_comes_and_pulls_nothing_back(speed: float, share: float):
    """A max(0, k_p d - c v) of a node 1 mm deep that leaves with v, as a share of k_p d A."""
    floor = Support("floor", "plane", position=(0.0, 0.0, 0.001))
    model = organ(floor, law=SupportLaw(1e7, 1e5))
    force, velocity = np.zeros_like(model.node_rest_position), np.zeros_like(model.node_rest_position)
    velocity[:, 2] = speed
    stretch = np.zeros((len(model.support_nodes), 1, 3))
    push(model, model.node_rest_position, velocity, force, stretch, 1e-4)
    low = model.node_rest_position[model.support_nodes, 2] < 0.001
    np.testing.assert_allclose(force[model.support_nodes, 2], np.where(low, share * 1e4 * model.support_area, 0.0))
    assert not force[:, :2].any()


def test_only_free_surface_nodes_are_held():
    mesh = box_mesh((0.02, 0.01, 0.01), (4, 2, 2))
    anchors = np.flatnonzero(mesh.points[:, 0] < 1e-9)
    model = compile_organ(OrganSpec(mesh, oracle.TISSUE, anchors=anchors, supports=(Support("floor", "plane"),)))
    held = set(model.support_nodes.tolist())
    assert held == set(mesh.boundary_nodes.tolist()) - set(anchors.tolist())
    assert not len(compile_organ(OrganSpec(mesh, oracle.TISSUE)).support_nodes)
    # All of the surface belongs to its nodes, of which the anchored ones are left out here.
    everything = organ(Support("floor", "plane"))
    assert everything.support_area.sum() == pytest.approx(2 * (2 * 0.02 * 0.01 + 0.01 * 0.01))
    assert rest_state(everything).support_stretch.shape == (len(everything.support_nodes), 1, 3)


REFUSED = [
    ({"kind": "mesh"}, "mesh"),
    ({"kind": "box", "size": (0.1, 0.1)}, r"size is \(0.1, 0.1\)"),
    ({"kind": "sphere", "size": (-0.1,)}, "-0.1"),
    ({"position": (0.0, 0.0)}, "position is"),
    ({"axis": (0.0, 0.0, 0.0)}, "axis is"),
    ({"rotation": (0.0, 0.0, 0.0, 0.0)}, "rotation is"),
    ({"axis": (0.0, 0.0, 1.0), "rotation": (1.0, 0.0, 0.0, 0.0)}, "axis"),
    ({"friction": -0.1}, "friction is -0.1"),
]


@pytest.mark.parametrize(("entries", "named"), REFUSED)
def test_a_wrong_support_is_refused(entries, named):
    with pytest.raises(OrganError, match=named):
        Support(**{"name": "s", "kind": "plane", **entries})


def test_what_an_organ_cannot_rest_on_is_refused():
    with pytest.raises(OrganError, match=r"'ball'.* 4.9 mm"):
        organ(Support("ball", "sphere", size=(0.0049,)))
    organ(Support("roll", "capsule", size=(0.0051, 0.001)))
    with pytest.raises(OrganError, match="'floor'"):
        organ(Support("floor", "plane"), Support("floor", "plane"))
    with pytest.raises(OrganError, match="'floor'"):
        organ(Support("floor", "plane"), anchors="all")
    with pytest.raises(OrganError, match="stiffness is 0"):
        SupportLaw(0.0)
