"""The held force on an organ of our own in fat beside finite elements with the same support, quadratic tets."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import LinearOperator, cg, spilu

from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.patient.supports import soft_bed
from surgsim_env.palpation.site_press import scan
from surgsim_env.scene.anatomy import Anatomy, anatomy_of
from surgsim_env.scene.load import make_material, make_scene
from tests.patient.organs import kidney

DOWN = (0.0, 0.0, -1.0)
TIP, DEPTH = 0.008, 0.0045
# Asked for. Measured at this site: +22 %; the lattice is too stiff by up to 17 % under loads of a few cells.
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
        whole = csr_array(stiffness + held)
        self.order = reverse_cuthill_mckee(whole, symmetric_mode=True)
        self.place_in_order = np.argsort(self.order)
        self.stiffness = whole
        # Incomplete factors precondition well; complete ones of a solid take minutes.
        self.incomplete = spilu(
            csc_array(whole[self.order][:, self.order]), drop_tol=3e-3, fill_factor=6.0, permc_spec="NATURAL",
            diag_pivot_thresh=0.0, options={"SymmetricMode": True},
        )  # fmt: skip

    def precondition(self, load: NDArray) -> NDArray:
        """Approximate displacement [m] under a load [N], (n,) each."""
        return self.incomplete.solve(load[self.order])[self.place_in_order]

    def force(self, site: NDArray, normal: NDArray, contact_stiffness: float) -> float:
        """Force along the normal of a frictionless ball pressed in to DEPTH [N].

        A point of the surface at a distance r from the ball's centre is pushed away from it by k_p (R - r) per
        undeformed area. Newton's method without the turn of that force; conjugate gradients solve each step.
        """
        from skfem import FacetBasis

        mesh = self.basis.mesh
        middles = mesh.p[:, mesh.facets].mean(axis=1).T
        facets = mesh.boundary_facets()
        near = facets[np.linalg.norm(middles[facets] - site, axis=1) < 1.5 * TIP]
        surface = FacetBasis(mesh, self.basis.elem, facets=near, intorder=6)
        dofs = surface.element_dofs
        values = np.array([np.broadcast_to(np.array(shape[0]), (3, *surface.dx.shape)) for shape in surface.basis])
        place = np.asarray(surface.global_coordinates())
        centre = (site + (TIP - DEPTH) * normal)[:, None, None]
        near_inverse = LinearOperator(self.stiffness.shape, self.precondition, dtype=np.float64)
        u, force = np.zeros(self.basis.N), 0.0
        for _ in range(30):
            moved = place - centre + np.einsum("ikeq,ie->keq", values, u[dofs])
            distance = np.linalg.norm(moved, axis=0)
            gap, out = np.maximum(TIP - distance, 0.0), moved / distance
            push = np.zeros(self.basis.N)
            pressure = contact_stiffness * gap * out * surface.dx
            np.add.at(push, dofs, np.einsum("ikeq,keq->ie", values, pressure))
            previous, force = force, float(-pressure.sum(axis=(1, 2)) @ normal)
            if abs(force - previous) <= 1e-3 * force:
                return force
            along = np.einsum("ikeq,keq->ieq", values, out)
            each = np.einsum("ieq,jeq->ije", along * (contact_stiffness * (gap > 0.0) * surface.dx), along)
            rows, columns = np.broadcast_arrays(dofs[:, None, :], dofs[None, :, :])
            held = coo_array((each.ravel(), (rows.ravel(), columns.ravel())), shape=self.stiffness.shape)
            whole = csr_array(self.stiffness + held)
            change, failed = cg(whole, push - self.stiffness @ u, rtol=1e-4, M=near_inverse, maxiter=500)
            assert not failed
            u += change
        raise AssertionError("the reference did not converge")


@pytest.mark.slow
def test_a_held_force_is_that_of_finite_elements() -> None:
    liver = make_scene("liver")
    scene = replace(
        liver,
        name="organ",
        material=make_material("liver_linear").material,
        anchors=(soft_bed(DOWN),),
        capsule=None,
        lesion=None,
        demonstration=(),
        instrument=replace(liver.instrument, tip_radius=TIP, approach=DOWN),
        timing=replace(liver.timing, substep_count=5, mass_scaling=False),
        palpation=replace(
            liver.palpation, press_depth=DEPTH, face_margin=TIP, thickness_smallest=0.0, site_spacing=0.016
        ),
    )
    anatomy = anatomy_of(scene, kidney())
    sites, normals, _ = plan_sites(anatomy)
    expected = HeldSolid(anatomy).force(sites[0], normals[0], scene.contact.stiffness)
    (press,) = scan(anatomy, anatomy.organ(), sites[:1], normals[:1])
    assert press.force == pytest.approx(expected, rel=TOLERANCE)
