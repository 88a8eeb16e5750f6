"""Blocks of reference at finite strain: exact where the deformation is homogeneous, with the right tangents."""

import numpy as np
import pytest

from msdm_core.material.regions import Damping, Material
from msdm_core.material.tissue_law import Stiffening
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import OrganSpec, compile_organ, rest_state
from surgsim_apps.validation.continuum import SpringSolid, lattice_directions, uniaxial_stress
from surgsim_apps.validation.hyperelastic import OrganBlock, QuadraticBlock
from surgsim_apps.validation.statics import linear_organ

SIZE = (0.03, 0.03, 0.03)
# E 2900 Pa, nu 0.45.
SOLID = SpringSolid(1000.0, 8000.0)


class Cubic:
    """phi = e + 40 e^3."""

    def tension(self, strain):
        return strain + 40.0 * strain**3

    def tangent(self, strain):
        return 1.0 + 120.0 * strain**2


STIFF = SpringSolid(1000.0, 8000.0, Cubic(), lattice_directions())


@pytest.mark.parametrize("solid", [SOLID, STIFF], ids=["linear", "stiffening"])
def test_hexahedra_with_free_sides_are_the_closed_form(solid):
    block = QuadraticBlock.of(SIZE, (2, 2, 2))
    for strains in ((0.1, 0.3), (-0.1, -0.3)):
        expected = uniaxial_stress(solid, 1.0 + np.array(strains)) * SIZE[0] * SIZE[1]
        np.testing.assert_allclose(block.forces(solid, "slide", strains), expected, rtol=1e-6)


def test_bonded_ends_converge_with_the_elements():
    coarse, fine, finest = (QuadraticBlock.of(SIZE, (n,) * 3).forces(STIFF, "pull", (0.1, 0.2))[-1] for n in (2, 3, 4))
    assert coarse > fine > finest
    assert fine - finest < 0.6 * (coarse - fine)
    # Held ends are stiffer than free ones.
    assert finest > uniaxial_stress(STIFF, np.array([1.2]))[0] * SIZE[0] * SIZE[1]


def test_small_shear_of_hexahedra_and_organ_is_linear():
    mesh = box_mesh(SIZE, (2, 2, 2))
    organ = OrganBlock(mesh, linear_organ(mesh, 2900.0, 0.45))
    for forces in (
        QuadraticBlock.of(SIZE, (2, 2, 2)).forces(SOLID, "shear", (1e-3, 2e-3)),
        organ.forces("shear", (1e-3, 2e-3)),
    ):
        assert forces[1] == pytest.approx(2.0 * forces[0], rel=1e-4)


@pytest.mark.parametrize("stiffening", [None, Stiffening(0.02, 0.15, 30.0)], ids=["linear", "stiffening"])
def test_the_organs_tangent_is_the_derivative_of_its_kernels_forces(stiffening):
    """Springs and volume terms, averaged ones too, at an irregular deformation; no tet is squeezed below 0.6."""
    mesh = box_mesh((0.02, 0.02, 0.02), (2, 2, 2))
    model = compile_organ(OrganSpec(mesh, Material(5000.0, 1000.0, 0.45, stiffening), damping=Damping(0.0)))
    block, state, rng = OrganBlock(mesh, model, stiffening), rest_state(model), np.random.default_rng(0)
    displacement, direction = 3e-4 * rng.normal(size=mesh.points.size), rng.normal(size=mesh.points.size)
    step = 1e-9
    slope = (
        block.response(state, displacement + step * direction)[0]
        - block.response(state, displacement - step * direction)[0]
    ) / (2.0 * step)
    matrix = block.response(state, displacement)[1]
    assert state.volume_ratio_smallest[0] > 0.6
    assert np.abs(matrix @ direction - slope).max() < 1e-5 * np.abs(slope).max()
