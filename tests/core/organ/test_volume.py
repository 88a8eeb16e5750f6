"""Averaged share of the volume term, and its conservation by averaging."""

import numpy as np
import pytest

from msdm_core.material.regions import Material, averaged_volume_modulus, nodal_average
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ

BLOCK = box_mesh((0.04, 0.03, 0.03), (4, 3, 3))


@pytest.mark.parametrize("nu", [0.25, 0.3, 0.4])
def test_up_to_two_fifths_every_tet_keeps_its_volume_term(nu: float):
    model = compile_organ(OrganSpec(BLOCK, Material(5000.0, 1000.0, nu)))
    assert not model.averages_volume
    np.testing.assert_array_equal(model.node_bulk, 0.0)
    np.testing.assert_array_equal(model.tet_barrier_bulk, 0.0)
    np.testing.assert_array_equal(model.tet_bulk, Material(5000.0, 1000.0, nu).volume_modulus)


@pytest.mark.parametrize("nu", [0.41, 0.45, 0.49])
def test_above_it_a_tet_keeps_three_shear_moduli(nu: float):
    """K_t = 3 mu at nu = 0.4; the rest is the node's, the same everywhere in one material."""
    material = Material(5000.0, 1000.0, nu)
    model = compile_organ(OrganSpec(BLOCK, material))
    shear = 5000.0 / (2.0 * (1.0 + nu))
    np.testing.assert_allclose(model.tet_bulk, 3.0 * shear, rtol=1e-9)
    np.testing.assert_allclose(model.node_bulk, material.volume_modulus - 3.0 * shear, rtol=1e-9)
    np.testing.assert_allclose(model.tet_bulk + model.tet_barrier_bulk, material.volume_modulus, rtol=1e-12)


def test_nodes_share_out_the_volume_and_its_modulus():
    """sum V_a = sum V_t and sum K_a V_a = sum K_t V_t."""
    modulus = np.random.default_rng(0).uniform(0.0, 1e4, BLOCK.tet_count)
    volume, shared = nodal_average(BLOCK, modulus)
    assert volume.sum() == pytest.approx(BLOCK.volumes.sum(), rel=1e-12)
    assert shared @ volume == pytest.approx(modulus @ BLOCK.volumes, rel=1e-12)


def test_regions_without_excess_give_nothing():
    springs, volume = np.array([1000.0, 1000.0, 1000.0]), np.array([0.0, 1200.0, 1500.0])
    np.testing.assert_allclose(averaged_volume_modulus(mesh, springs, volume), [0.0, 0.0, 300.0], atol=1e-9)
