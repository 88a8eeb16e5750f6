"""Averaged share of the volume term, and its conservation by averaging."""

import numpy as np
import pytest

from msdm_core.material.regions import Material, averaged_volume_modulus, nodal_average
from msdm_core.mesh.tet_mesh import TET_FACES
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ

BLOCK = box_mesh((0.04, 0.03, 0.03), (4, 3, 3))


@pytest.mark.parametrize("nu", [0.25, 0.3, 0.35])
def test_up_to_a_ratio_of_0_35_every_tet_keeps_its_volume_term(nu: float):
    model = compile_organ(OrganSpec(BLOCK, Material(5000.0, 1000.0, nu)))
    assert not model.averages_volume
    np.testing.assert_array_equal(model.node_bulk, 0.0)
    for bulk in (model.tet_bulk, model.tet_barrier_bulk):
        np.testing.assert_array_equal(bulk, Material(5000.0, 1000.0, nu).volume_modulus)


@pytest.mark.parametrize("nu", [0.36, 0.41, 0.45, 0.49])
def test_above_it_an_inner_tet_keeps_four_thirds_of_the_shear_modulus(nu: float):
    """K_t = (4/3) mu at nu = 0.35; the rest is the nodes', but tets with a face on the boundary keep all of it."""
    material = Material(5000.0, 1000.0, nu)
    model = compile_organ(OrganSpec(BLOCK, material))
    shear = 5000.0 / (2.0 * (1.0 + nu))
    outer = np.zeros(BLOCK.tet_count, dtype=bool)
    faces = np.sort(BLOCK.tets[:, TET_FACES], axis=2).reshape(-1, 3)
    _, which, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    outer[np.flatnonzero(count[which.ravel()] == 1) // 4] = True
    assert 0 < outer.sum() < BLOCK.tet_count
    kept = np.where(outer, material.volume_modulus, 4.0 / 3.0 * shear)
    np.testing.assert_allclose(model.tet_bulk, kept, rtol=1e-9)
    rest = nodal_average(BLOCK, material.volume_modulus - kept)[1]
    np.testing.assert_allclose(model.node_bulk, rest, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model.tet_barrier_bulk, material.volume_modulus, rtol=1e-12)


def test_nodes_share_out_the_volume_and_its_modulus():
    """sum V_a = sum V_t and sum K_a V_a = sum K_t V_t."""
    modulus = np.random.default_rng(0).uniform(0.0, 1e4, BLOCK.tet_count)
    volume, shared = nodal_average(BLOCK, modulus)
    assert volume.sum() == pytest.approx(BLOCK.volumes.sum(), rel=1e-12)
    assert shared @ volume == pytest.approx(modulus @ BLOCK.volumes, rel=1e-12)


def test_regions_without_excess_give_nothing():
    """mu = (2/5) E_s = 300: a tet keeps K_t up to 400, and at the boundary any."""
    springs = np.full(BLOCK.tet_count, 750.0)
    for modulus, averaged in ((0.0, 0.0), (400.0, 0.0), (500.0, 100.0)):
        expected = np.full(BLOCK.tet_count, averaged)
        expected[BLOCK.boundary_tets] = 0.0
        result = averaged_volume_modulus(BLOCK, springs, np.full(BLOCK.tet_count, modulus))
        np.testing.assert_allclose(result, expected, atol=1e-9)
