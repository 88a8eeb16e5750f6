"""Held forces on two organs of our own in fat beside finite elements with the same support, quadratic tets."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from msdm_core.meshing.lattice_meshing import mesh_surface
from surgsim_env.palpation.job import plan_sites
from surgsim_env.palpation.press import scan
from surgsim_env.palpation.surface_scene import soft_bed
from surgsim_env.scene.anatomy import Anatomy, anatomy_of
from surgsim_env.scene.load import make_scene
from tests.patient.organs import kidney

pytest.importorskip("skfem", reason="scikit-fem, a development dependency, solves the reference")

DOWN = (0.0, 0.0, -1.0)
TIP, DEPTH = 0.008, 0.0045
# What the issue of this test asks for. The lattice is too stiff by up to 17 % under loads of a few cells.
TOLERANCE = 0.25


class HeldSolid:
    """An organ's tets as quadratic elements of small strains on its foundations, without capsule or fixed nodes."""

    def __init__(self, anatomy: Anatomy) -> None:
        from skfem import Basis, ElementTetP2, ElementVector, MeshTet
        from skfem.models.elasticity import lame_parameters, linear_elasticity

        material, organ = anatomy.scene.material, anatomy.organ()
        mesh = MeshTet(anatomy.mesh.points.T.copy(), anatomy.mesh.tets.T.astype(np.int64))
        self.basis = Basis(mesh, ElementVector(ElementTetP2()), intorder=3)
        stiffness = linear_elasticity(*lame_parameters(material.youngs_modulus, material.poisson_ratio)).assemble(
            self.basis
        )
        dofs = self.basis.nodal_dofs[:, organ.foundation_nodes].T
        rows = np.repeat(dofs[:, :, None], 3, axis=2).ravel()
        columns = np.repeat(dofs[:, None, :], 3, axis=1).ravel()
        held = csc_array((organ.foundation_stiffness.ravel(), (rows, columns)), shape=stiffness.shape)
        self.order = reverse_cuthill_mckee(csr_array(stiffness + held), symmetric_mode=True)
        whole = coo_array(csr_array(stiffness + held)[self.order][:, self.order])
        lower = whole.row >= whole.col
        band = np.zeros((int((whole.row - whole.col).max()) + 1, self.basis.N))
        band[(whole.row - whole.col)[lower], whole.col[lower]] = whole.data[lower]
        self.factors = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)

    def force(self, site: NDArray, normal: NDArray, contact_stiffness: float) -> float:
        """Force along the normal of a frictionless ball pressed in to DEPTH [N].

        A point of the surface at a distance r from the ball's centre is pushed away from it by k_p (R - r) per
        undeformed area. All that contact needs of the solid is the compliance of its degrees of freedom.
        """
        from skfem import FacetBasis

        mesh = self.basis.mesh
        middles = mesh.p[:, mesh.facets].mean(axis=1).T
        facets = mesh.boundary_facets()
        near = facets[np.linalg.norm(middles[facets] - site, axis=1) < 1.2 * TIP]
        surface = FacetBasis(mesh, self.basis.elem, facets=near, intorder=6)
        dofs = np.unique(surface.element_dofs)
        unit = np.zeros((self.basis.N, len(dofs)))
        unit[dofs, np.arange(len(dofs))] = 1.0
        solved = np.empty_like(unit)
        solved[self.order] = cho_solve_banded((self.factors, True), unit[self.order], check_finite=False)
        compliance = solved[dofs]
        local = np.searchsorted(dofs, surface.element_dofs)
        values = np.array([np.broadcast_to(np.array(one[0]), (3, *surface.dx.shape)) for one in surface.basis])
        place = np.asarray(surface.global_coordinates())
        centre = (site + (TIP - DEPTH) * normal)[:, None, None]
        u = np.zeros(len(dofs))
        for _ in range(60):
            moved = place - centre + np.einsum("ikeq,ie->keq", values, u[local])
            distance = np.linalg.norm(moved, axis=0)
            gap, out = np.maximum(TIP - distance, 0.0), moved / distance
            push = np.zeros(len(dofs))
            np.add.at(push, local, np.einsum("ikeq,keq,eq->ie", values, contact_stiffness * gap * out, surface.dx))
            across = np.eye(3)[:, :, None, None] - out[:, None] * out[None]
            slope = -contact_stiffness * ((gap > 0.0) * out[:, None] * out[None] - gap / distance * across)
            tangent = np.zeros((len(dofs), len(dofs)))
            each = np.einsum("ikeq,kleq,jleq,eq->ije", values, slope, values, surface.dx, optimize=True)
            np.add.at(tangent, (local[:, None, :], local[None, :, :]), each)
            # Newton's step on u - C f(u) = 0.
            change = np.linalg.solve(np.eye(len(dofs)) - compliance @ tangent, compliance @ push - u)
            u += min(1.0, 1e-3 / np.abs(change).max()) * change
            if np.abs(change).max() < 1e-9:
                total = np.einsum("keq,eq->k", contact_stiffness * gap * out, surface.dx)
                return float(-total @ normal)
        raise AssertionError("the reference did not converge")


def spleen(cell: float = 0.006):
    """A spleen-like slab of 110 x 70 x 30 mm with round edges, bulged upwards."""
    ball = trimesh.creation.icosphere(3, 1.0)
    x, y, z = (np.sign(ball.vertices) * np.abs(ball.vertices) ** [0.9, 0.9, 0.8] * [0.055, 0.035, 0.015]).T
    return mesh_surface(np.column_stack([x, y, z - 0.006 * (x / 0.055) ** 2]), ball.faces, cell_size=cell)


@pytest.mark.slow
@pytest.mark.parametrize("organ", [kidney, spleen])
def test_held_forces_are_those_of_finite_elements(organ) -> None:
    liver = make_scene("liver")
    scene = replace(
        liver,
        name="organ",
        anchors=(soft_bed(DOWN),),
        capsule=None,
        lesion=None,
        demonstration=(),
        instrument=replace(liver.instrument, tip_radius=TIP, approach=DOWN),
        palpation=replace(
            liver.palpation, press_depth=DEPTH, face_margin=TIP, thickness_smallest=0.0, site_spacing=0.016
        ),
    )
    anatomy = anatomy_of(scene, organ())
    sites, normals, _ = plan_sites(anatomy)
    chosen = np.linspace(0, len(sites) - 1, 3).round().astype(int)
    sites, normals = sites[chosen], normals[chosen]
    solid = HeldSolid(anatomy)
    expected = [solid.force(site, normal, scene.contact.stiffness) for site, normal in zip(sites, normals, strict=True)]
    found = [press.force for press in scan(anatomy, anatomy.organ(), sites, normals)]
    print(organ.__name__, np.round(found, 3), np.round(expected, 3), np.round(np.array(found) / expected, 3))
    np.testing.assert_allclose(found, expected, rtol=TOLERANCE)
