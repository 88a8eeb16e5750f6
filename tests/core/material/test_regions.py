"""Materials, capsule and lesions: bad values, how much of each tet they fill, and what the organ makes of it."""

import math

import numpy as np
import pytest

from msdm_core.errors import MeshError, OrganError
from msdm_core.material.lumping import lump_mass
from msdm_core.material.regions import Capsule, Lesion, Material, boundary_layer, lesion_fraction, mixed_moduli
from msdm_core.material.stiffness import spring_network
from msdm_core.mesh.tet_mesh import TET_FACES, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ
from tests.core import oracle

HEALTHY = Material(youngs_modulus=5000.0, density=1060.0, poisson_ratio=0.45)
HARD = Material(youngs_modulus=40000.0, density=1100.0, poisson_ratio=0.40)
BLOCK = box_mesh((0.06, 0.06, 0.03), (12, 12, 6))
INTERIOR = (0.031, 0.028, 0.0152)  # away from every symmetry of the lattice [m]


def tagged_block() -> TetMesh:
    """The block with its half x < 30 mm tagged 1 ("left") and the rest 2 ("right")."""
    side = np.where(BLOCK.points[BLOCK.tets].mean(axis=1)[:, 0] < 0.03, 1, 2)
    return TetMesh(BLOCK.points, BLOCK.tets, side, {1: "left", 2: "right"})


# ---- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nu", [0.2499, 0.5, math.nan])
def test_material_refuses_a_poisson_ratio_it_cannot_have(nu: float):
    with pytest.raises(OrganError, match=f"{nu}"):
        Material(5000.0, 1000.0, nu)


@pytest.mark.parametrize(
    ("arguments", "named"), [((math.nan,), "youngs_modulus is nan"), ((1e6, 0.0), "thickness is 0")]
)
def test_capsule_refuses(arguments: tuple[float, ...], named: str):
    with pytest.raises(OrganError, match=named):
        Capsule(*arguments)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({}, "centre"),
        ({"centre": INTERIOR, "radius": 0.01, "radii": (0.01, 0.01, 0.01)}, "radii"),
        ({"centre": INTERIOR, "radius": -0.01}, "-0.01"),
    ],
)
def test_lesion_refuses(fields: dict, named: str):
    with pytest.raises(OrganError, match=f"node: .*{named}"):
        Lesion(**{"material": HARD, "name": "node", **fields})


def test_lesion_outside_the_organ_is_refused():
    half_out = Lesion((0.03, 0.03, 0.0325), 0.008, HARD, "metastasis")  # 27 % inside
    with pytest.raises(OrganError, match=r"metastasis: .* 2\d%"):
        lesion_fraction(BLOCK, half_out)


def test_unknown_region_lists_the_regions():
    lesion = Lesion(region="middle", material=HARD)
    with pytest.raises(MeshError, match=r"middle.*left, right"):
        lesion_fraction(tagged_block(), lesion)


# ---- how much of each tet -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("radius", "tolerance"), [(0.006, 0.02), (0.008, 0.01), (0.010, 0.01)])
def test_a_sphere_fills_its_own_volume(radius: float, tolerance: float):
    """sum_t fraction_t V_t = (4/3) pi r^3; a cut tet of 165 samples is good to 0.02, hundreds of them to much less."""
    fraction = lesion_fraction(BLOCK, Lesion(INTERIOR, radius, HARD))
    assert fraction.min() >= 0.0 and fraction.max() == 1.0
    assert fraction @ BLOCK.volumes == pytest.approx(4.0 / 3.0 * math.pi * radius**3, rel=tolerance)


def test_an_ellipsoid_fills_its_own_volume():
    """sum_t fraction_t V_t = (4/3) pi a b c, the mean of x^2 about its centre is a^2 / 5 along each axis."""
    radii = (0.018, 0.012, 0.008)
    fraction = lesion_fraction(BLOCK, Lesion(INTERIOR, radii=radii, material=HARD))
    filled = fraction * BLOCK.volumes
    assert filled.sum() == pytest.approx(4.0 / 3.0 * math.pi * math.prod(radii), rel=0.01)
    # A cut tet's share counts at its centroid, not where it lies: out by at most a tet's size, in a shell of them.
    offset = BLOCK.points[BLOCK.tets].mean(axis=1) - INTERIOR
    moments = (filled @ offset**2) / filled.sum()
    np.testing.assert_allclose(moments, np.square(radii) / 5.0, rtol=0.06)


@pytest.mark.parametrize("radius", [0.006, 0.008, 0.010])
def test_each_cut_tet_has_its_own_share(radius: float):
    """Against 10 000 random points a tet (standard error 0.005), in 40 of the tets that the sphere's surface cuts."""
    fraction = lesion_fraction(BLOCK, Lesion(INTERIOR, radius, HARD))
    random = np.random.default_rng(0)
    cut = random.choice(np.flatnonzero((fraction > 0.0) & (fraction < 1.0)), 40, replace=False)
    points = random.dirichlet(np.ones(4), 10000) @ BLOCK.points[BLOCK.tets[cut]]
    error = fraction[cut] - (np.linalg.norm(points - INTERIOR, axis=2) <= radius).mean(axis=1)
    assert np.abs(error).max() < 0.045
    assert math.sqrt((error**2).mean()) < 0.012


def test_a_tagged_region_fills_its_tets():
    mesh = tagged_block()
    fraction = lesion_fraction(mesh, Lesion(region="left", material=HARD))
    np.testing.assert_array_equal(fraction, mesh.region == 1)
    assert fraction @ mesh.volumes == pytest.approx(mesh.volumes[mesh.region == 1].sum(), rel=1e-12)


# ---- what the organ makes of it -----------------------------------------------------------------------------------


def test_the_papers_capsule_is_every_tet_with_a_face_on_the_boundary():
    """A face is on the boundary where no other tet has it (counted here face by face)."""
    seen: dict[tuple[int, ...], list[int]] = {}
    for tet, nodes in enumerate(BLOCK.tets):
        for face in TET_FACES:
            seen.setdefault(tuple(sorted(nodes[face].tolist())), []).append(tet)
    expected = {owners[0] for owners in seen.values() if len(owners) == 1}
    layer = boundary_layer(BLOCK)
    assert set(np.flatnonzero(layer).tolist()) == expected
    model = compile_organ(OrganSpec(BLOCK, HEALTHY, capsule=Capsule(15000.0)))
    modulus = np.where(layer, 15000.0, 5000.0) * (1.25 / 1.45)
    np.testing.assert_allclose(oracle.edge_stiffness(BLOCK, model), spring_network(BLOCK, modulus)[1], rtol=1e-12)
    bulk = HEALTHY.volume_modulus * np.where(layer, 3.0, 1.0)
    np.testing.assert_allclose(model.tet_barrier_bulk, bulk, rtol=1e-12)


def bulk_modulus(spring_modulus, volume_modulus):
    """K = lambda + (2/3) mu, springs with lambda = mu = (2/5) E_s and the volume term's K_t in lambda."""
    return (2.0 / 3.0) * spring_modulus + volume_modulus


def mixture(share):
    """Spring and volume modulus of HEALTHY with a share of HARD: p^(1 - f) q^f of the shear and the bulk moduli."""
    modulus = HEALTHY.spring_modulus ** (1.0 - share) * HARD.spring_modulus**share
    soft, hard = (bulk_modulus(material.spring_modulus, material.volume_modulus) for material in (HEALTHY, HARD))
    return modulus, soft ** (1.0 - share) * hard**share - (2.0 / 3.0) * modulus


def test_a_lesions_properties_enter_by_volume_fraction():
    """Shear and bulk modulus by the geometric mean p^(1 - f) q^f, the density by the arithmetic one."""
    lesion = Lesion(INTERIOR, 0.008, HARD)
    fraction = lesion_fraction(BLOCK, lesion)
    assert ((fraction > 0.01) & (fraction < 0.99)).sum() > 20
    model = compile_organ(OrganSpec(BLOCK, HEALTHY, lesions=(lesion,)))
    modulus, volume_modulus = mixture(fraction)
    density = (1.0 - fraction) * 1060.0 + fraction * 1100.0
    np.testing.assert_allclose(oracle.edge_stiffness(BLOCK, model), spring_network(BLOCK, modulus)[1], rtol=1e-12)
    np.testing.assert_allclose(model.tet_barrier_bulk, volume_modulus, rtol=1e-12)
    np.testing.assert_allclose(model.node_mass, lump_mass(BLOCK, density, scheme="barycentric"), rtol=1e-12)
    np.testing.assert_allclose(model.node_mass.sum(), density @ BLOCK.volumes, rtol=1e-12)


def test_tets_out_of_a_lesions_reach_keep_their_moduli_to_the_bit():
    moduli = np.linspace(900.0, 5000.0, 101)
    spring, volume = mixed_moduli(moduli, 7.0 * moduli, HARD, np.zeros(101))
    np.testing.assert_array_equal(spring, moduli)
    np.testing.assert_array_equal(volume, 7.0 * moduli)


@pytest.mark.parametrize("nu", [0.25, 0.45])
def test_a_lesion_of_the_healthy_tissue_changes_nothing(nu: float):
    tissue = Material(5000.0, 1060.0, nu)
    plain = compile_organ(OrganSpec(BLOCK, tissue))
    model = compile_organ(OrganSpec(BLOCK, tissue, lesions=(Lesion(INTERIOR, 0.008, tissue),)))
    np.testing.assert_array_equal(model.spring_stiffness, plain.spring_stiffness)
    np.testing.assert_allclose(model.tet_bulk, plain.tet_bulk, rtol=1e-14)


def test_at_a_quarter_a_lesion_needs_no_volume_term():
    """K = (2/3) E_s in both tissues: their geometric means leave K_t = 0 to the bit, the paper's model."""
    lesion = Lesion(INTERIOR, 0.008, Material(40000.0, 1060.0))
    model = compile_organ(OrganSpec(BLOCK, Material(5000.0, 1060.0), lesions=(lesion,)))
    np.testing.assert_array_equal(model.tet_bulk, 0.0)


def test_mixed_moduli_lie_between_one_stress_and_one_strain():
    """Between the harmonic and the arithmetic mean, tissue of nu 0.25 with a lesion of 0.49; K_t never below 0."""
    soft, hard = Material(5000.0, 1000.0), Material(40000.0, 1000.0, 0.49)
    f = np.linspace(0.0, 1.0, 11)
    spring, volume = mixed_moduli(np.full(11, soft.spring_modulus), np.full(11, soft.volume_modulus), hard, f)
    assert (volume >= 0.0).all()
    assert (spring[0], volume[0]) == (soft.spring_modulus, soft.volume_modulus)
    for mixed, low, high in (
        (spring, soft.spring_modulus, hard.spring_modulus),
        (
            bulk_modulus(spring, volume),
            bulk_modulus(soft.spring_modulus, soft.volume_modulus),
            bulk_modulus(hard.spring_modulus, hard.volume_modulus),
        ),
    ):
        assert mixed[-1] == pytest.approx(high, rel=1e-14)
        assert (mixed[1:-1] > 1.0 / ((1.0 - f) / low + f / high)[1:-1]).all()
        assert (mixed[1:-1] < ((1.0 - f) * low + f * high)[1:-1]).all()


def test_later_lesions_overlay_earlier_ones():
    """A second lesion over the same place takes its share of what the first one left, in order."""
    first = Lesion(INTERIOR, 0.010, HARD, "first")
    second = Lesion(INTERIOR, 0.006, HEALTHY, "core")
    model = compile_organ(OrganSpec(BLOCK, HEALTHY, lesions=(first, second)))
    a, b = lesion_fraction(BLOCK, first), lesion_fraction(BLOCK, second)
    share = a * (1.0 - b)
    np.testing.assert_allclose(model.tet_barrier_bulk, mixture(share)[1], rtol=1e-12)


def test_regions_have_their_own_material():
    mesh = tagged_block()
    model = compile_organ(OrganSpec(mesh, {"left": HEALTHY, "right": HARD}))
    left = mesh.region == 1
    bulk = np.where(left, HEALTHY.volume_modulus, HARD.volume_modulus)
    np.testing.assert_allclose(model.tet_barrier_bulk, bulk, rtol=1e-12)
    modulus = np.where(left, HEALTHY.spring_modulus, HARD.spring_modulus)
    np.testing.assert_array_equal(oracle.edge_stiffness(mesh, model), spring_network(mesh, modulus)[1])
    density = np.where(left, HEALTHY.density, HARD.density)
    np.testing.assert_allclose(model.node_mass.sum(), density @ mesh.volumes, rtol=1e-12)


@pytest.mark.parametrize("anchors", [[-1], [BLOCK.node_count], [0.5]])
def test_an_anchor_that_is_no_node_is_refused(anchors: list):
    with pytest.raises(OrganError, match=rf"anchors are node indices in 0..{BLOCK.node_count - 1}"):
        compile_organ(OrganSpec(BLOCK, HEALTHY, anchors=anchors))


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 0.0, np.nan)])
def test_gravity_is_three_finite_numbers(gravity):
    with pytest.raises(OrganError, match="gravity"):
        compile_organ(OrganSpec(box_mesh((0.02, 0.02, 0.02), (2, 2, 2)), Material(5e3, 1e3), gravity=gravity))


@pytest.mark.parametrize("bad", [0.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["youngs_modulus", "density"])
def test_material_names_the_field_and_its_value(name: str, bad: float):
    with pytest.raises(OrganError, match=f"{name} is {bad}"):
        Material(**{"youngs_modulus": 5000.0, "density": 1000.0, name: bad})
