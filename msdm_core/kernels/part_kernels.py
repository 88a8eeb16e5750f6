"""The substep of an organ up to one of its parts, repeated without motion, for timing."""

from numba import njit

from msdm_core.kernels.contact_kernels import add_contact_forces, hold_contact
from msdm_core.kernels.element_kernels import faded_share
from msdm_core.kernels.guard_kernels import guard_axes
from msdm_core.kernels.lane_view_kernels import TissueLaw, lanes_of, surface_of, touched_of
from msdm_core.kernels.option_kernels import KERNEL
from msdm_core.kernels.squeeze_kernels import SWEEPS_LEAST, hold_squeezed, hold_steep
from msdm_core.kernels.tissue_kernels import (
    add_energies,
    add_spring_forces,
    add_tet_forces,
    integrate,
    set_gravity,
    set_node_laws,
    set_node_tension,
    sum_at_nodes,
)
from msdm_core.kernels.vector_kernels import GROUP


@njit(**KERNEL)
def repeat_parts(model, state, shapes, law, response, dt, decay, fades, last, reference, wrench, count):
    """Substeps of an organ alone without beta, supports and foundations, up to the part `last`, without motion.

    Parts: 0 sums at nodes, 1 law at nodes, 2 springs, 3 tets, 4 contact, 5 guard, 6 steep springs, 7 implicit contact,
    8 squeezed tets, 9 integration.

    Model: model, law, response
    In:    shapes, dt [s], decay, fades: True if the arms relax, last, reference [m] (n_tool, 3), count
    Out:   state: forces, arms; wrench (n_tool, 6)
    Returns the number of points in contact, of entries in `steep_springs` and in `squeezed_tets`.
    """
    lanes, time, candidates = lanes_of(model), model.arm_time, state.candidate_count[0]
    surface, touched = surface_of(lanes, model, 0), touched_of(lanes, state, 0)
    rows = steep = squeezed = 0
    fade = (0.0, 0.0, 0.0)
    if fades:
        fade = (faded_share(dt, time[0]), faded_share(dt, time[1]), faded_share(dt, time[2]))
    for _ in range(count):
        state.node_pairs[:] = 0.0
        state.node_tension[:] = 0.0
        sum_at_nodes(lanes, model, state)
        tissue = TissueLaw(model.stiffens, False, fades, fade)
        if model.stiffens:
            add_energies(lanes, model, state)
        if last < 1:
            continue
        if model.stiffens:
            stiffens, steepens = set_node_laws(lanes, model, state, tissue)
            tissue = TissueLaw(stiffens, steepens, fades, fade)
        else:
            set_node_tension(lanes, model, state, tissue)
        if last < 2:
            continue
        set_gravity(lanes, model, state)
        steep = add_spring_forces(lanes, model, state, tissue)
        if last < 3:
            continue
        squeezed, steep = add_tet_forces(lanes, model, state, tissue, steep)
        if last < 4:
            continue
        rows = add_contact_forces(surface, touched, shapes, law, dt, candidates, reference, wrench)
        if last < 5:
            continue
        guard_axes(surface, touched, shapes, law, response, dt, candidates, reference, wrench)
        if last < 6:
            continue
        if steep > 0:
            hold_steep(lanes, model, state, steep, SWEEPS_LEAST, dt)
        if last < 7:
            continue
        hold_contact(surface, touched, shapes, law, dt, decay, rows, reference, wrench)
        if last < 8:
            continue
        hold_squeezed(
            touched.node_position, touched.node_velocity, touched.node_force, surface.node_inverse_mass,
            model.tet_nodes, model.tet_inverse_volume, model.tet_barrier_bulk, state.squeezed_tets, squeezed, GROUP, dt,
        )  # fmt: skip
        if last < 9:
            continue
        integrate(lanes, model, state, 0.0 * dt, 1.0)
    return rows, steep, squeezed
