"""Organs of the same tets side by side whose rest shapes and anchors differ: each as it would alone."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest

from msdm_core.errors import OrganError
from msdm_core.kernels.structure_kernels import ContactShapes, LaneModel, LaneState, OrganModel, OrganState
from msdm_core.lanes.lanes import get_lane, lane_shapes, put_lane, same_rest, set_lane, stack_organs, stack_shapes
from msdm_core.material.regions import Material
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.foundation import Foundation
from msdm_core.organ.motion import Motion
from msdm_core.organ.stepping import advance_organ
from msdm_core.organ.support import Support, SupportLaw
from tests.core import oracle
from tests.core.lanes.abreast import advance_lanes, rest_lanes
from tests.core.lanes.test_lanes import DAMPED, LAW, SUBSTEP, SUBSTEPS, same, varied
from tests.core.measures import ground_work, steer

SIZE, CELLS = (0.03, 0.02, 0.02), (6, 4, 4)
DOWN = (0.0, 0.0, -9.81)


def size_of(index: int) -> float:
    return 1.0 + 0.03 * (index % 5 - 2)


@cache
def drawn(index: int) -> OrganModel:
    """A block on its bed, held at one face: of another size each, of other moduli, and fewer held each second time."""
    mesh = box_mesh(SIZE, CELLS)
    scale = size_of(index)
    held = mesh.points[:, 0] <= 1e-9
    if index % 2:
        held &= np.abs(mesh.points[:, 1] - 0.01) <= 0.0051
    bed = Support("bed", "box", position=(0.0, 0.0, -0.02), size=(0.1, 0.1, 0.02), friction=0.2)
    spec = OrganSpec(
        TetMesh(mesh.points * scale, mesh.tets, mesh.region, mesh.region_names),
        Material(youngs_modulus=6000.0 + 500.0 * index, density=1000.0, poisson_ratio=0.45),
        anchors=np.flatnonzero(held),
        damping=DAMPED,
        gravity=DOWN,
        supports=(bed,),
        support_law=SupportLaw(1e7, 100.0),
    )
    return varied(compile_organ(spec), index)


def ball(index: int) -> ContactShapes:
    """A ball above a block, on its way down and aside."""
    place = (0.016 + 5e-4 * index, 0.0105, 0.02 * size_of(index) + 0.0041)
    return oracle.ball(place, 0.004, velocity=(2e-3 * (index % 3 - 1), 1e-3, -0.02))


@cache
def held(index: int) -> OrganModel:
    """A block of another shape each on an elastic foundation, on ground that moves, part of it near one corner."""
    mesh = box_mesh(SIZE, CELLS)
    bent = mesh.points * size_of(index) + np.outer(mesh.points[:, 0] ** 2, [0.0, 0.0, 1.0 + 0.5 * index])
    under = np.flatnonzero(mesh.points[:, 2] <= 1e-9)
    fixed = np.flatnonzero((mesh.points[:, 0] <= 1e-9) & (mesh.points[:, 2] > 0.009 + 0.003 * (index % 2)))
    spec = OrganSpec(
        mesh.moved(bent),
        Material(youngs_modulus=6000.0, density=1000.0, poisson_ratio=0.45),
        anchors=fixed,
        damping=DAMPED,
        foundations=(Foundation("fat", under, 2e5, 7e4),),
        motions=(
            Motion("breathing", (1e-3, 0.0, 5e-4)),
            Motion("heartbeat", (0.0, 4e-4, 0.0), centre=(0.01, 0.01, 0.01), reach=0.015),
        ),
    )
    return varied(compile_organ(spec), index)


@dataclass
class Both:
    """Organs alone and side by side."""

    organs: list[OrganModel]
    dtype: type = np.float64
    alone: list[OrganState] = field(init=False)
    balls: list[ContactShapes] = field(init=False)
    model: LaneModel = field(init=False)
    state: LaneState = field(init=False)
    shapes: ContactShapes = field(init=False)

    def __post_init__(self) -> None:
        self.alone = [rest_state(organ, shape_count=1) for organ in self.organs]
        self.balls = [ball(lane) for lane in range(len(self.organs))]
        self.model = stack_organs(self.organs, dtype=self.dtype, lanes=8, own_rest=True)
        self.state = rest_lanes(self.organs, shape_count=1, dtype=self.dtype, lanes=8, own_rest=True)
        self.shapes = stack_shapes(self.balls)
        self.wrench, self.lane_wrench = np.zeros((len(self.organs), 1, 6)), np.zeros((8, 1, 6))

    def press(self, steps: int):
        """Haptic steps of both, one after the other."""
        for _ in range(steps):
            faults = advance_lanes(self.model, self.state, self.shapes, LAW, SUBSTEP, SUBSTEPS, self.lane_wrench)
            for lane, organ in enumerate(self.organs):
                into = self.wrench[lane]
                alone = advance_organ(organ, self.alone[lane], self.balls[lane], LAW, SUBSTEP, SUBSTEPS, into)
                assert alone == faults[lane], f"lane {lane}"
            yield faults

    def assert_same(self) -> None:
        """Wrenches, states and shapes, to the bit."""
        assert self.lane_wrench[: len(self.organs)].tobytes() == self.wrench.tobytes()
        for lane, single in enumerate(self.alone):
            assert same(get_lane(self.state, lane), single) == [], f"lane {lane}"
            for together, alone in zip(lane_shapes(self.shapes, lane), self.balls[lane], strict=True):
                assert together.tobytes() == alone.tobytes()


def test_the_blocks_differ_in_all_that_lanes_share_otherwise():
    first, second = drawn(0), drawn(1)
    assert not same_rest(first, second) and same_rest(first, first._replace(tet_bulk=second.tet_bulk))
    assert len(first.surface_triangles) < len(second.surface_triangles)
    assert len(first.support_nodes) < len(second.support_nodes)
    for name in ("spring_rest_length", "tet_inverse_volume", "node_inverse_volume"):
        assert not np.array_equal(getattr(first, name), getattr(second, name)), name
    with pytest.raises(OrganError, match=r"another spring_rest_length .* or stack them with own_rest"):
        stack_organs([first, second])
    coarse = oracle.block(SIZE, (3, 2, 2), damping=DAMPED, gravity=DOWN)
    with pytest.raises(OrganError, match=r"lane 1 has another spring_nodes .* share tets, supports"):
        stack_organs([first, coarse], own_rest=True)


def test_a_press_is_that_of_the_organ_alone():
    """300 haptic steps into blocks on beds under gravity, side by side and alone: to the bit."""
    both = Both([drawn(index) for index in range(7)])  # one lane stays empty
    for _ in both.press(300):
        assert both.lane_wrench[:7].tobytes() == both.wrench.tobytes()
    both.assert_same()
    assert (both.wrench[:, 0, 2] > 0.02).all(), "every lane is pressed"
    assert all(np.abs(single.support_stretch).max() > 1e-7 for single in both.alone), "every bed holds"


def test_foundations_and_moving_ground_are_those_of_the_organ_alone():
    """Blocks bent each its own way, held by fat at the same nodes and carried by the same motions: to the bit."""
    both = Both([held(index) for index in range(6)])
    first, second = both.organs[:2]
    assert np.array_equal(first.foundation_nodes, second.foundation_nodes)
    assert len(first.motion_anchored_nodes) != len(second.motion_anchored_nodes)
    for name in ("foundation_position", "foundation_stiffness", "motion_node_shift", "motion_foundation_shift"):
        assert not np.array_equal(getattr(first, name), getattr(second, name)), name
    for lane, single in enumerate(both.alone):
        steer(single, (0.5 + 0.1 * lane, -0.4), 100 * SUBSTEP * SUBSTEPS)
        put_lane(both.state, lane, single)
    for _ in both.press(100):
        pass
    both.assert_same()
    assert (np.array([ground_work(single) for single in both.alone]) != 0.0).all(), "the ground drags every lane"


def test_squeezed_tets_are_those_of_the_organ_alone():
    """Lanes that begin with half their volume: the tets' own rest volumes tell how far they are squeezed."""
    both = Both([drawn(index) for index in range(8)])
    for lane, single in enumerate(both.alone):
        single.node_position[:] *= 0.82
        put_lane(both.state, lane, single)
    for _ in both.press(3):
        pass
    both.assert_same()
    assert all(single.volume_ratio_smallest[0] < 0.6 for single in both.alone)


def test_another_organ_comes_into_a_lane():
    """Lane 2 goes on with a block of a larger surface, then with the smaller one again; the others do not notice."""
    both = Both([drawn(index) for index in (0, 1, 2, 3)])
    for index in (5, 4):
        for _ in both.press(40):
            pass
        fresh = drawn(index)
        both.organs[2], both.alone[2], both.balls[2] = fresh, rest_state(fresh, shape_count=1), ball(2)
        set_lane(both.model, 2, fresh)
        put_lane(both.state, 2, both.alone[2])
        for array, new in zip(lane_shapes(both.shapes, 2), both.balls[2], strict=True):
            array[:] = new
    for _ in both.press(60):
        pass
    both.assert_same()
    assert both.wrench[:, 0, 2].all()
