"""Fields below a frictionless ball on a fine block, in its static equilibrium, beside Hertz's closed forms."""

import numpy as np
import pytest
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_RISE, QUADRATURE_WEIGHT
from msdm_core.kernels.structure_kernels import ContactLaw, OrganModel
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.meshing.lattice_meshing import box_mesh
from msdm_core.organ.compile import rest_state
from msdm_core.organ.fields import tissue_fields
from msdm_core.organ.stepping import advance, round_shapes
from surgsim_apps.validation.statics import assemble_stiffness, linear_organ, nodal_dofs, nodes_at

MODULUS, RATIO = 5e3, 0.3
SIZE, CELL = np.array([0.06, 0.06, 0.03]), 0.002
# a / R = 0.02, at which Hertz's small slopes hold; the contact radius is four cells.
RADIUS, REACH = 0.4, 0.008
DEPTH = REACH**2 / RADIUS
# The tissue gives way to 160 um of indentation and to 1 um of penetration.
LAW = ContactLaw(stiffness=1e8, damping=0.0, friction=0.0, tangential_stiffness=0.0)
BALL = np.array([0.5 * SIZE[0], 0.5 * SIZE[1], SIZE[2] - DEPTH + RADIUS])
ROUNDS = 40


def contact_gaps(model: OrganModel) -> tuple[csr_array, FloatArray, FloatArray]:
    """Slopes of the penetrations of quadrature points below the ball, penetrations at rest [m], k_p A [N/m]."""
    rest, surface = model.node_rest_position, model.surface_triangles
    middle = rest[surface].mean(axis=1) - BALL
    near = np.flatnonzero((middle[:, 2] > -RADIUS) & (np.hypot(*middle[:, :2].T) < 1.6 * REACH))
    around = np.concatenate([surface[near], model.surface_around[near]], axis=1)
    weight = np.concatenate(
        [
            np.broadcast_to(QUADRATURE_BARYCENTRIC, (len(near), 4, 3)),
            np.einsum("qk,tjk->tqj", QUADRATURE_RISE, model.surface_rise[near]),
        ],
        axis=2,
    )
    away = BALL - np.einsum("tqj,tjk->tqk", weight, rest[around])
    distance = np.linalg.norm(away, axis=2)
    values = weight[..., None] * (away / distance[..., None])[:, :, None]
    rows = np.arange(distance.size).reshape(len(near), 4, 1, 1)
    columns = 3 * around[:, None, :, None] + np.arange(3)
    places = np.broadcast_to(rows, values.shape).ravel(), np.broadcast_to(columns, values.shape).ravel()
    slope = coo_array((values.ravel(), places), shape=(distance.size, rest.size)).tocsr()
    area = np.repeat(model.surface_rest_area[near] * QUADRATURE_WEIGHT, 4)
    return slope, RADIUS - distance.ravel(), LAW.stiffness * area


def pressed_displacement(model: OrganModel) -> FloatArray:
    """Displacement of the nodes of a bonded block in equilibrium with the ball [m], by Newton's method."""
    rest = model.node_rest_position
    free = np.setdiff1d(np.arange(rest.size), nodal_dofs(nodes_at(rest, 0.0)))
    tissue = csr_array(assemble_stiffness(model)[free][:, free])
    slope, overlap, stiffness = contact_gaps(model)
    slope = csr_array(slope[:, free])
    moved, touching = np.zeros(len(free)), overlap > 0.0
    for _ in range(ROUNDS):
        held = csr_array(slope.T @ diags_array(stiffness * touching))
        whole = csr_array(tissue + held @ slope)
        moved, code = cg(
            whole, -(held @ overlap), x0=moved, rtol=1e-9, M=diags_array(1.0 / np.asarray(whole.diagonal()))
        )
        assert code == 0
        before, touching = touching, overlap + slope @ moved > 0.0
        if np.array_equal(before, touching):
            displacement = np.zeros(rest.size)
            displacement[free] = moved
            return displacement.reshape(-1, 3)
    raise AssertionError("the points in contact keep changing")


@pytest.mark.slow
def test_fields_below_a_ball():
    """Contact pressure in rings of a cell, its integral, and the largest von Mises stress: 0.62 p0 at 0.48 a."""
    model = linear_organ(box_mesh(SIZE, np.rint(SIZE / CELL).astype(int)), MODULUS, RATIO)
    state = rest_state(model, shape_count=1)
    state.node_position[:] += pressed_displacement(model)
    shapes = round_shapes(np.array([[BALL, BALL]]), [RADIUS])
    fields = tissue_fields(model, state, shapes, LAW, 1e-5)
    wrench = advance(model, state, dt=1e-5, shapes=shapes, contact=LAW)
    force = wrench[0, 2]
    push = fields.pressure * fields.area
    # The wrench is that of the bounded block, above the half space's at this depth: a and p0 follow from it.
    stiffness = MODULUS / (1.0 - RATIO**2)
    reach = np.cbrt(0.75 * force * RADIUS / stiffness)
    peak = 1.5 * force / (np.pi * reach**2)
    assert push @ fields.normal[:, 2] == pytest.approx(force, rel=0.02)
    away = np.hypot(*(model.node_rest_position[model.surface_triangles].mean(axis=1) - BALL)[:, :2].T)
    top = fields.normal[:, 2] > 0.9
    for inner in np.arange(0.0, 0.8 * reach - CELL, CELL):
        ring = top & (away >= inner) & (away < inner + CELL)
        hertz = peak * np.sqrt(1.0 - np.square(away[ring] / reach)) @ fields.area[ring]
        assert push[ring].sum() == pytest.approx(hertz, rel=0.1)
    most = int(fields.von_mises.argmax())
    place = BALL - model.node_rest_position[most]
    # Johnson (1985), section 3.4: 0.62 p0 at 0.48 a on the axis for nu = 0.3.
    assert fields.von_mises[most] == pytest.approx(0.62 * peak, rel=0.1)
    assert np.abs(place - np.array([0.0, 0.0, RADIUS - DEPTH + 0.48 * reach])).max() < CELL
