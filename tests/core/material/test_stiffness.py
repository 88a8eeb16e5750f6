"""Spring stiffness: formula (6) and the membrane against closed forms on the BCC lattice."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Capsule, Material
from msdm_core.material.stiffness import membrane_stiffness, spring_network
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from msdm_core.organ.measure import potential_energy
from tests.core import oracle

MODULUS = 4000.0  # [Pa]
CELL = 0.005  # [m]
CELLS = 5
LATTICE = box_mesh((CELLS * CELL,) * 3, (CELLS,) * 3)
CUBE_ROOT_2 = 2.0 ** (1.0 / 3.0)
EXACT = 1e-12


def spans(mesh: TetMesh, edges: NDArray) -> NDArray:
    return mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]


def interior(points: NDArray, *, rim: float) -> NDArray:
    """True for points of the lattice at least `rim` inside all its faces."""
    return ((points > rim - 1e-9) & (points < CELLS * CELL - rim + 1e-9)).all(axis=1)


def affine_constants(mesh: TetMesh, edges: NDArray, stiffness: NDArray, nodes: NDArray, volume: float) -> NDArray:
    """C_ijkl = (1 / V) sum over springs k l^2 n_i n_j n_k n_l [Pa], each spring halved between its two nodes.

    The body-centred lattice is a Bravais lattice: an affine strain leaves every node in balance, so these are the
    constants of the infinite lattice, without any relaxation. V is the nodes' volume.
    """
    share = 0.5 * np.isin(edges, nodes).sum(axis=1)
    span = spans(mesh, edges)
    weight = share * stiffness / (span * span).sum(axis=1)
    return np.einsum("s,si,sj,sk,sl->ijkl", weight, span, span, span, span) / volume


def lattice_constants(edges: NDArray, stiffness: NDArray) -> NDArray:
    """The constants of one corner and one centre node in the middle: together they fill one cell."""
    inside = np.flatnonzero(interior(LATTICE.points, rim=2 * CELL))
    corners = (CELLS + 1) ** 3
    pair = np.array([inside[inside < corners][0], inside[inside >= corners][0]])
    return affine_constants(LATTICE, edges, stiffness, pair, CELL**3)


def three_constants(tensor: NDArray) -> tuple[float, float, float]:
    """C11, C12, C44 of a tensor that is cubic to rounding."""
    c11, c12, c44 = tensor[0, 0, 0, 0], tensor[0, 0, 1, 1], tensor[0, 1, 0, 1]
    delta = np.eye(3)
    same = np.einsum("ai,aj,ak,al->ijkl", delta, delta, delta, delta)
    cubic = (
        c12 * np.einsum("ij,kl->ijkl", delta, delta)
        + c44 * (np.einsum("ik,jl->ijkl", delta, delta) + np.einsum("il,jk->ijkl", delta, delta))
        + (c11 - c12 - 2.0 * c44) * same
    )
    np.testing.assert_allclose(tensor, cubic, rtol=0, atol=EXACT * c11)
    return c11, c12, c44


# ---- formula (6) --------------------------------------------------------------------------------------------------


def test_formula_6_on_the_lattice_gives_the_known_springs():
    """k = n_t (2 sqrt 2 / 25) l_t E, V_t = a^3 / 12, so l_t = a / 2^(1/6); 4 tets share a cube edge, 6 a diagonal."""
    edges, stiffness = spring_network(LATTICE, MODULUS)
    length = np.linalg.norm(spans(LATTICE, edges), axis=1)
    inside = interior(LATTICE.points[edges].mean(axis=1), rim=0.75 * CELL)
    cube = inside & (np.abs(length - CELL) < 1e-9)
    diagonal = inside & (np.abs(length - math.sqrt(0.75) * CELL) < 1e-9)
    assert cube.sum() > 50 and diagonal.sum() > 200 and (cube | diagonal)[inside].all()
    unit = CELL * MODULUS
    np.testing.assert_allclose(stiffness[cube] / unit, 8.0 * CUBE_ROOT_2 / 25.0, rtol=EXACT)
    np.testing.assert_allclose(stiffness[diagonal] / unit, 12.0 * CUBE_ROOT_2 / 25.0, rtol=EXACT)
    assert stiffness[cube][0] / unit == pytest.approx(0.403175, abs=1e-6)
    assert stiffness[diagonal][0] / unit == pytest.approx(0.604762, abs=1e-6)


def test_formula_6_makes_the_lattice_isotropic():
    """C11 = 0.96 x 2^(1/3) E, C12 = C44 = 0.32 x 2^(1/3) E: isotropic (C11 = C12 + 2 C44), lambda = mu (nu = 1/4)."""
    c11, c12, c44 = three_constants(lattice_constants(*spring_network(LATTICE, MODULUS)))
    assert c11 / MODULUS == pytest.approx(0.96 * CUBE_ROOT_2, rel=1e-6)
    assert c12 / MODULUS == pytest.approx(0.32 * CUBE_ROOT_2, rel=1e-6)
    assert c44 / MODULUS == pytest.approx(0.32 * CUBE_ROOT_2, rel=1e-6)
    assert c11 == pytest.approx(c12 + 2.0 * c44, rel=EXACT)


def energy_density(model: OrganModel, gradient: NDArray) -> float:
    """Energy per volume of an affine displacement u = (F - 1) x of all nodes, halved to second order [Pa]."""
    state = rest_state(model)
    density = 0.0
    for sign in (1.0, -1.0):  # the mean of both signs drops the third order
        state.node_position[:] = model.node_rest_position @ (np.eye(3) + sign * gradient).T
        density += 0.5 * potential_energy(model, state)
    return density / float(model.tet_rest_volume.sum())


@pytest.mark.parametrize("nu", [0.25, 0.3, 0.4, 0.45, 0.49])
def test_springs_and_volume_term_have_the_wanted_lame_constants(nu: float):
    """mu = E / (2 (1 + nu)) from the springs, lambda = mu + K_t, within the lattice's factor of 1.00794."""
    model = compile_organ(OrganSpec(LATTICE, Material(MODULUS, 1000.0, nu)))
    mu = MODULUS / (2.0 * (1.0 + nu))
    lame = MODULUS * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    _, c12, c44 = three_constants(lattice_constants(model.spring_nodes, model.spring_stiffness))
    # The volume term alone: W = K_t (tr strain)^2 / 2 with equal share for any tr strain, and none for shear.
    bare = model._replace(spring_stiffness=np.zeros_like(model.spring_stiffness))
    strain = 1e-4
    bulk = 2.0 * energy_density(bare, np.diag([strain, 0.0, 0.0])) / strain**2
    both = 2.0 * energy_density(bare, np.diag([strain, strain, 0.0])) / strain**2
    shear = 2.0 * energy_density(bare, np.array([[0, strain, 0], [0, 0, 0], [0, 0, 0]])) / strain**2
    # (J - 1)^2 of a biaxial stretch is (2 e)^2 (1 + e^2 / 4) in the mean of both signs.
    assert both == pytest.approx(4.0 * bulk, rel=strain, abs=1e-9 * MODULUS)
    assert shear == pytest.approx(0.0, abs=1e-9 * MODULUS)
    assert bulk == pytest.approx(lame - mu, rel=1e-6, abs=1e-9 * MODULUS)
    assert c44 == pytest.approx(0.8 * CUBE_ROOT_2 * mu, rel=1e-6)
    assert c12 + bulk == pytest.approx(lame + (0.8 * CUBE_ROOT_2 - 1.0) * mu, rel=1e-6)
    assert 1.0 <= c44 / mu < 1.01
    assert 1.0 <= (c12 + bulk) / lame < 1.01


def test_a_quarter_is_the_papers_model_to_the_bit():
    """At nu = 1/4 springs get E itself and there is no volume term."""
    model = compile_organ(OrganSpec(LATTICE, Material(MODULUS, 1000.0)))
    np.testing.assert_array_equal(oracle.edge_stiffness(LATTICE, model), spring_network(LATTICE, MODULUS)[1])
    np.testing.assert_array_equal(model.tet_bulk, 0.0)
    assert not model.averages_volume


# ---- one tet -------------------------------------------------------------------------------------------------------

REGULAR = TetMesh(
    np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * (0.01 / math.sqrt(8.0)), [[0, 1, 2, 3]]
)


def test_a_regular_tet():
    """Each edge of length l has Lloyd's k = (2 sqrt 2 / 25) l E."""
    _, stiffness = spring_network(REGULAR, MODULUS)
    np.testing.assert_allclose(stiffness, 2.0 * math.sqrt(2.0) / 25.0 * 0.01 * MODULUS, rtol=EXACT)


# ---- moduli, messages ---------------------------------------------------------------------------------------------


def test_each_tet_adds_its_own_share():
    """k is linear in the tets' moduli: one tet's modulus raised by dE adds that tet's k (dE) to its six edges alone."""
    random = np.random.default_rng(1)
    modulus = random.uniform(1000.0, 9000.0, LATTICE.tet_count)
    tet, raised = 321, modulus.copy()
    raised[tet] += 5000.0
    _, before = spring_network(LATTICE, modulus)
    _, after = spring_network(LATTICE, raised)
    alone = TetMesh(LATTICE.points[LATTICE.tets[tet]], [[0, 1, 2, 3]])
    _, share = spring_network(alone, 5000.0)
    expected = np.zeros(len(before))
    expected[LATTICE.tet_edges[tet]] = share  # both list a tet's edges in the order of its corners
    np.testing.assert_allclose(after - before, expected, rtol=0, atol=EXACT * after.max())


# ---- the membrane -------------------------------------------------------------------------------------------------

CAPSULE_MODULUS, THICKNESS = 8e6, 50e-6
STIFFNESS_2D = CAPSULE_MODULUS * THICKNESS  # [N/m]


def face_energy(displacement: Callable[[NDArray], NDArray]) -> float:
    """Energy per area of the top face's springs alone, over the block of 2 x 2 cells in its middle [N/m].

    The face's diagonals alternate, with a period of two cells: springs on that block's rim count half.
    """
    stiffness = membrane_stiffness(LATTICE, CAPSULE_MODULUS, THICKNESS)
    edges = LATTICE.edges
    low, high = CELL - 1e-9, 3.0 * CELL + 1e-9
    ends = LATTICE.points[edges]
    on_top = (ends[:, :, 2] > CELLS * CELL - 1e-9).all(axis=1)
    within = on_top & ((ends[:, :, :2] > low) & (ends[:, :, :2] < high)).all(axis=(1, 2))
    middle = ends[:, :, :2].mean(axis=1)
    on_rim = ((middle < low + 2e-9) | (middle > high - 2e-9)).any(axis=1)
    share = np.where(on_rim, 0.5, 1.0) * within
    span = ends[:, 1] - ends[:, 0]
    stretch = (displacement(span) * span).sum(axis=1) / np.linalg.norm(span, axis=1)
    return 0.5 * float((share * stiffness) @ stretch**2) / (2.0 * CELL) ** 2


def test_membrane_has_the_wanted_stiffness_on_a_blocks_face():
    """2-D nu = 1/3: equibiaxial strain e costs E h e^2 / (1 - nu) = 1.5 E h e^2, uniaxial E h e^2 / (2 (1 - nu^2)),
    shear G h gamma^2 / 2 with G = (3/8) E; all within 1 % (exact, in fact)."""
    equibiaxial = face_energy(lambda span: span)
    along_x = face_energy(lambda span: span * [1.0, 0.0, 0.0])
    along_y = face_energy(lambda span: span * [0.0, 1.0, 0.0])
    shear = face_energy(lambda span: np.stack([span[:, 1], 0 * span[:, 1], 0 * span[:, 1]], axis=1))
    assert equibiaxial == pytest.approx(1.5 * STIFFNESS_2D, rel=1e-2)
    assert along_x == pytest.approx(9 / 16 * STIFFNESS_2D, rel=1e-2)
    assert along_y == pytest.approx(9 / 16 * STIFFNESS_2D, rel=1e-2)
    assert shear == pytest.approx(3 / 16 * STIFFNESS_2D, rel=1e-2)
    assert equibiaxial == pytest.approx(1.5 * STIFFNESS_2D, rel=EXACT)


def test_membrane_on_an_equilateral_triangle():
    """k = (sqrt 3 / 4) E h per triangle; each edge of a regular tet has two."""
    stiffness = membrane_stiffness(REGULAR, CAPSULE_MODULUS, THICKNESS)
    np.testing.assert_allclose(stiffness, 2.0 * math.sqrt(3.0) / 4.0 * STIFFNESS_2D, rtol=EXACT)


def test_membrane_lies_on_the_surface_only_and_joins_the_organs_springs():
    material = Material(MODULUS, 1000.0, 0.4)
    bare = compile_organ(OrganSpec(LATTICE, material))
    covered = compile_organ(OrganSpec(LATTICE, material, capsule=Capsule(CAPSULE_MODULUS, THICKNESS)))
    added = membrane_stiffness(LATTICE, CAPSULE_MODULUS, THICKNESS)
    np.testing.assert_array_equal(oracle.edge_stiffness(LATTICE, covered), oracle.edge_stiffness(LATTICE, bare) + added)
    np.testing.assert_array_equal(covered.tet_bulk, bare.tet_bulk)
    sides = LATTICE.boundary_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    known = {tuple(sorted(side)) for side in sides.tolist()}
    assert {tuple(edge) for edge in LATTICE.edges[added > 0.0].tolist()} == known
