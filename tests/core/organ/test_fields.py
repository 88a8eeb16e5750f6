"""Stress, stretch, energy and contact traction of an organ: closed forms, virtual work, and the wrench."""

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel
from msdm_core.material.regions import Damping, Material
from msdm_core.material.tissue_law import Relaxation, Stiffening
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.fields import TissueFields, contact_points, tissue_fields
from msdm_core.organ.measure import potential_energy, principal_values
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance, round_shapes
from surgsim_apps.validation.statics import (
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    nodes_at,
    solve_displacement,
    twice_energy,
)
from tests.core.measures import internal_forces

MODULUS, RATIO = 20e3, 0.25
SHEAR = MODULUS / (2.0 + 2.0 * RATIO)
BAR, CELLS = np.array([0.02, 0.02, 0.06]), 8
SMALL = 1e-4
LAW = ContactLaw(stiffness=3e7, damping=100.0, friction=0.3, tangential_stiffness=1.5e7)


def test_principal_values_of_any_symmetric_matrices():
    """Against LAPACK: to rounding, and to its root where two values are close and the roots of a cubic are steep."""
    random = np.random.default_rng(0).standard_normal((200, 3, 3))
    given = random + random.transpose(0, 2, 1)
    expected = np.linalg.eigvalsh(given)[:, ::-1]
    apart = np.abs(np.diff(expected, axis=1)).min(axis=1) > 0.1
    np.testing.assert_allclose(principal_values(given)[apart], expected[apart], rtol=0, atol=1e-13)
    twins = np.array([np.zeros((3, 3)), np.eye(3), np.diag([1.0, 1.0, 2.0]), np.diag([3.0, 1.0, 3.0])])
    turn = np.linalg.qr(random[0])[0]
    given = np.concatenate([twins, turn @ twins @ turn.T])
    np.testing.assert_allclose(principal_values(given), np.linalg.eigvalsh(given)[:, ::-1], rtol=0, atol=1e-7)


# ---- stress and energy -----------------------------------------------------------------------------------------------


def fields_of(model: OrganModel, displacement: NDArray) -> TissueFields:
    state = rest_state(model)
    state.node_position[:] += displacement.reshape(-1, 3)
    return tissue_fields(model, state, NO_SHAPES, NO_CONTACT, 1e-5)


def test_stress_is_that_of_virtual_work():
    """sum v sigma = -sum f x (virial theorem of internal forces), and sum V0 w = U, squeezed, stiff and relaxing."""
    tissue = Material(5000.0, 1000.0, 0.45, Stiffening(0.02, 0.2, 5.0), Relaxation((0.3, 0.2), (0.02, 0.3)))
    mesh = box_mesh((0.03, 0.03, 0.02), (3, 3, 2))
    model = compile_organ(OrganSpec(mesh, tissue, damping=Damping(60.0)))
    state = rest_state(model)
    state.node_position[:] *= [1.1, 0.5, 1.0]
    state.node_position[:] += 2e-4 * np.random.default_rng(1).standard_normal(state.node_position.shape)
    advance(model, state, dt=1e-5, substep_count=10)
    assert state.element_relief.any()
    fields = tissue_fields(model, state, NO_SHAPES, NO_CONTACT, 1e-5)
    volume = np.zeros(len(model.node_mass))
    corners = state.node_position[model.tet_nodes]
    tet_volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert (tet_volume / model.tet_rest_volume).min() < 0.6
    np.add.at(volume, model.tet_nodes, tet_volume[:, None] / 4.0)
    expected = -np.einsum("ni,nj->ij", internal_forces(model, state), state.node_position)
    measured = np.einsum("n,nij->ij", volume, fields.stress)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-12 * np.abs(fields.stress).max() * volume.sum())
    lift = model.node_mass @ (state.node_position - model.node_rest_position) @ model.gravity
    assert fields.energy_density @ model.node_rest_volume == pytest.approx(potential_energy(model, state) + lift)


@pytest.fixture(scope="module")
def bar():
    """A bar with fitted springs and its stiffness matrix."""
    mesh = box_mesh(BAR, np.rint(BAR / BAR[0] * CELLS).astype(int), top_nodes=False)
    model = linear_organ(mesh, MODULUS, RATIO, stiffness_rule="fitted")
    points = model.node_rest_position
    return model, assemble_stiffness(model), np.concatenate([nodes_at(points, 0.0), nodes_at(points, BAR[2])])


def middle(model: OrganModel) -> NDArray:
    """Volume of each node in the middle third of the bar, 0 elsewhere: weights of a mean over the section."""
    inside = np.abs(model.node_rest_position[:, 2] - 0.5 * BAR[2]) < BAR[2] / 6.0
    return model.node_rest_volume * inside


def test_bar_in_tension(bar):
    """sigma_zz = F / A, the others 0; von Mises and the largest principal stress as large; w = E e^2 / 2."""
    model, stiffness, ends = bar
    strain = SMALL * model.node_rest_position[ends, 2] / BAR[2]
    displacement = solve_displacement(stiffness, nodal_dofs(ends, (2,)), strain * BAR[2])
    fields, weight = fields_of(model, displacement), middle(model)
    expected = MODULUS * SMALL
    assert fields.area.sum() == pytest.approx(2.0 * (BAR * np.roll(BAR, 1)).sum(), rel=SMALL)
    for measured in (fields.stress[:, 2, 2], fields.von_mises, fields.principal_stress[:, 0]):
        assert np.average(measured, weights=weight) == pytest.approx(expected, rel=0.03)
    across = np.abs(np.average(fields.stress[:, [0, 1, 0], [0, 1, 1]], axis=0, weights=weight))
    assert across.max() < 0.01 * expected
    assert np.average(fields.energy_density, weights=weight) == pytest.approx(0.5 * expected * SMALL, rel=0.03)
    # Stretches are kinematic: 1 + e along, 1 - nu e across.
    mid_tets = (middle(model)[model.tet_nodes] > 0.0).all(axis=1)
    stretch = fields.principal_stretch[mid_tets].mean(axis=0) - 1.0
    np.testing.assert_allclose(stretch, SMALL * np.array([1.0, -RATIO, -RATIO]), rtol=0, atol=0.03 * SMALL)


def test_bar_in_shear(bar):
    """Its whole surface sheared: tau_xz = G gamma, principal values +- tau, von Mises sqrt(3) tau."""
    model, stiffness, _ = bar
    points = model.node_rest_position
    outer = np.flatnonzero(np.minimum(points, BAR - points).min(axis=1) < 1e-9)
    shear = np.outer(SMALL * points[outer, 2], [1.0, 0.0, 0.0])
    fields = fields_of(model, solve_displacement(stiffness, nodal_dofs(outer), shear.ravel()))
    tau, weight = SHEAR * SMALL, middle(model)
    assert np.average(fields.stress[:, 0, 2], weights=weight) == pytest.approx(tau, rel=0.03)
    assert np.average(fields.von_mises, weights=weight) == pytest.approx(np.sqrt(3.0) * tau, rel=0.03)
    for place, expected in enumerate((tau, 0.0, -tau)):
        measured = np.average(fields.principal_stress[:, place], weights=weight)
        assert measured == pytest.approx(expected, abs=0.03 * tau)


def saint_venant(x: NDArray, y: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """tau_xz and tau_yz over G times the twist of a square bar (Timoshenko and Goodier 1970, section 109).

    Prandtl's phi = (32 a^2 / pi^3) sum (-1)^((n - 1) / 2) / n^3 (1 - cosh(k y) / cosh(k a)) cos(k x), k = n pi / 2 a.
    """
    order = np.arange(1, 60, 2)[:, None]
    k, sign = 0.5 * np.pi * order / half, (-1.0) ** (order // 2)
    size = 16.0 * half / (np.pi * order) ** 2 * sign
    along_x = -size * np.sinh(k * y) / np.cosh(k * half) * np.cos(k * x)
    along_y = size * (1.0 - np.cosh(k * y) / np.cosh(k * half)) * np.sin(k * x)
    return along_x.sum(axis=0), along_y.sum(axis=0)


def test_bar_in_torsion(bar):
    """The stress has the bar's torque M; in the core it is Saint-Venant's of the twist, over all inner nodes that of M.

    Surface springs make the bar 8 % stiffer than the continuum with eight cells (`twice_energy`), 9 % with six. The
    excess stress is that of nodes within 1.5 cells of the surface: 10 % on it, over Saint-Venant's field with the mean
    that nodes take, and 1 % two cells below.
    """
    model, stiffness, ends = bar
    arm = model.node_rest_position - 0.5 * BAR
    turn = np.stack([-arm[ends, 1], arm[ends, 0]], axis=1) * SMALL * model.node_rest_position[ends, 2:] / BAR[2]
    displacement = solve_displacement(stiffness, nodal_dofs(ends, (0, 1)), turn.ravel())
    torque = twice_energy(stiffness, displacement) / SMALL
    fields, weight = fields_of(model, displacement), middle(model)
    measured, depth = fields.stress[:, [0, 1], 2], 0.5 * BAR[0] - np.abs(arm[:, :2]).max(axis=1)
    moment = np.average(arm[:, 0] * measured[:, 1] - arm[:, 1] * measured[:, 0], weights=weight) * BAR[0] * BAR[1]
    assert moment == pytest.approx(torque, rel=0.03)
    field = np.stack(saint_venant(arm[:, 0], arm[:, 1], 0.5 * BAR[0]), axis=1)

    def projected(least: float) -> float:
        """Factor of the field in the measured stress at nodes deeper than a number of cells."""
        inner = weight * (depth > least * BAR[0] / CELLS - 1e-9)
        return (inner @ (measured * field).sum(axis=1)) / (inner @ (field * field).sum(axis=1))

    assert projected(2.0) == pytest.approx(SHEAR * SMALL / BAR[2], rel=0.03)
    # Not within 3 %: the surface has its excess of the torque, so that 4.4 % are missing inside.
    assert projected(0.5) == pytest.approx(torque / (0.1406 * BAR[0] ** 4), rel=0.05)


# ---- traction --------------------------------------------------------------------------------------------------------


def pressed_block(shapes_at: NDArray, radius: float, tools: int, moves: tuple[NDArray, ...]):
    """A block pressed and dragged: model, state and shapes; one velocity of each tool for each 0.05 s [m/s]."""
    mesh = box_mesh((0.03, 0.03, 0.02), (6, 6, 4))
    # A ball needs a floor; a jaw draws the block away from its far end.
    held = np.flatnonzero(mesh.points[:, 2] < 1e-9 if tools == 1 else mesh.points[:, 0] > 0.03 - 1e-9)
    model = compile_organ(OrganSpec(mesh, Material(5000.0, 1000.0, 0.45), anchors=held, damping=Damping(100.0)))
    count = len(shapes_at)
    shapes = round_shapes(shapes_at, [radius] * count, tool=np.arange(count) * tools // count)
    state = rest_state(model, shape_count=count)
    for velocity in moves:
        shapes.tool_twist[:, :3] = velocity
        advance(model, state, dt=1e-4, substep_count=500, shapes=shapes, contact=LAW)
    return model, state, shapes


BALL = np.array([[[0.0153, 0.0148, 0.028]] * 2])
JAW = np.array([[[0.005, y, z], [0.025, y, z]] for z in (-0.0015, 0.0215) for y in (0.013, 0.017)])
DOWN, ASIDE, STILL = np.array([[0.0, 0.0, -0.04]]), np.array([[0.03, 0.01, 0.0]]), np.zeros((1, 3))
CLOSING, PULLING = np.array([[0.0, 0.0, 0.03], [0.0, 0.0, -0.03]]), np.array([[0.02, 0.0, 0.0]] * 2)


@pytest.mark.parametrize(
    ("at", "radius", "moves"),
    [(BALL, 0.008, (DOWN, STILL)), (BALL, 0.008, (DOWN, ASIDE)), (JAW, 0.0015, (CLOSING, PULLING))],
    ids=["held", "sliding", "jaw"],
)
def test_tractions_sum_to_the_wrench_of_the_next_substep(at, radius, moves):
    """Sum of t a = force of all tools on the organ; by tool that of its points; nothing changes by asking."""
    model, state, shapes = pressed_block(at, radius, len(moves[0]), moves)
    before = [field.copy() for field in (state.node_position, state.contact_stretch, state.element_relief, *shapes)]
    fields = tissue_fields(model, state, shapes, LAW, 1e-4)
    points = contact_points(model, state, shapes, LAW, 1e-4)
    after = (state.node_position, state.contact_stretch, state.element_relief, *shapes)
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))
    wrench = advance(model, state, dt=1e-4, shapes=shapes, contact=LAW)
    size = np.abs(wrench[:, :3]).max()
    assert size > 0.05
    np.testing.assert_allclose((fields.traction * fields.area[:, None]).sum(axis=0), -wrench[:, :3].sum(axis=0),
                               rtol=0, atol=1e-12 * size)  # fmt: skip
    for tool, expected in enumerate(wrench):
        of_tool = points.force[shapes.shape_tool[points.shape] == tool].sum(axis=0)
        np.testing.assert_allclose(of_tool, expected[:3], rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(fields.shear - fields.pressure[:, None] * fields.normal, fields.traction, atol=1e-9)
    assert np.linalg.norm(fields.shear, axis=1).max() > 0.1 * fields.pressure.max() > 0.0


def test_no_traction_after_contact():
    """None at rest with the ball placed far away, as by `Simulation.restart`: scratch of contact is still there."""
    model, state, shapes = pressed_block(BALL, 0.008, 1, (DOWN,))
    for places in (shapes.shape_ends, shapes.tool_centre):
        places[..., 2] += 0.1
    state.node_position[:], state.node_velocity[:], state.contact_engaged[:] = model.node_rest_position, 0.0, 0
    assert state.contact_count[0] > 0
    assert not tissue_fields(model, state, shapes, LAW, 1e-4).traction.any()
