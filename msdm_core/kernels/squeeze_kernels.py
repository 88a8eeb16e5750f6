"""Implicit integration of squeezed tets and steep springs, which would limit the step at large strain."""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_EXCESS,
    spring_length,
    tet_shape,
    volume_ratio,
)
from msdm_core.kernels.lane_view_kernels import nodes_of
from msdm_core.kernels.layout_kernels import (
    add_to_node,
    at_node,
    difference,
    group_width,
    load_column,
    load_item,
    load_shared,
    set_node,
    store_column,
    take_from_node,
)
from msdm_core.kernels.option_kernels import INLINED, INNER, KERNEL
from msdm_core.kernels.space_kernels import (
    divided,
    edge,
    opposite,
    plus,
    scalar_product,
    shifted,
    times,
    vector_product,
)
from msdm_core.kernels.vector_kernels import any_below, keep_lower

# Implicit stiffness of a steep spring over the rise of its tangent, and the share of it that acts on the speed, as a
# drag; the other part acts on the change of speed, as a mass, which varies with the strain and feeds energy in. Under a
# held tip of `liver`, 7 mm deep, nodes then swing at 250 Hz: second differences of the force at 1 ms reach 0.8 N at 2
# of 12 sites with 0.025 (5 substeps, no relaxation), and with 0.1 0.014 N at 1 of 42 sites and 0.0015 N at the others
# (2 substeps, relaxation). A free block of elastic tissue, stretched by 12 %, keeps 0.95 of its energy after 0.1 s with
# 0.025, 0.87 to 0.89 with 0.1 and 0.75 with 0.3, at 0.57 to 0.75 of the stable step.
STEEP_HOLD, STEEP_DRAG = 1.0, 0.1
# Springs hold the rise of the volume term too: in a uniform expansion e springs have an energy of 15 mu e^2 / 2, and
# the volume term of 9 K_t e^2 / 2, so that springs stiffer by this times K_t / mu bound it.
VOLUME_HOLD = 0.5
# Numbers of a steep spring in `steep_rows`: its direction, dt K, 1 / (1 + dt K (a + b)) with the changes a, b of its
# ends' speeds by a pull of 1 N, and its pull so far.
STEEP_WIDTH = 6
# Sweeps per tangent over that at rest, and the fewest. Measured on a bar with all springs beyond the cap strain, by the
# spectral radius of a step: stretched by 30 %, the step at rest is stable up to tangents of 24, 44, 60 and 100 times
# that at rest with 4, 6, 8 and 12 sweeps, compressed by 15 % up to 44 and 75 with 4 and 6. Blocks of liver's law,
# stretched by 30 %, sheared by 40 % or compressed by 15 % at once and released, gain no energy at 0.95 of the step.
SWEEPS_PER_TANGENT = 1.0 / 3.0
SWEEPS_LEAST = 4


@njit(**INNER)
def hold_squeezed(
    position, velocity, force, inverse_mass, tets, inverse_volume, barrier_bulk, squeezed, count, width, dt
):  # fmt: skip
    """Implicit pressure of squeezed tets: tension p + dt p' dJ/dt, with the speeds at the end of the step.

    Below s = SQUEEZED_RATIO the tension p of a tet steepens, p' = K' (s / J)^2, and would limit the step. The tissue
    kernel has applied p; this kernel adds the remainder to each such tet in turn, from the masses of its nodes and all
    forces so far. A tet at rest gets no force, so the static equilibrium does not depend on dt; no tension becomes
    positive.

    In:  position [m], velocity [m/s] (n_node, 3), inverse_mass [1/kg] (n_node,), tets (n_tet, 4), inverse_volume
         [1/m^3], barrier_bulk [Pa] (n_tet,), squeezed: first of each `width` successive tets with a squeezed tet
         (n_tet,), count: entries of `squeezed`, width, dt [s]
    Out: force, added to [N] (n_node, 3)
    """
    for entry in range(count):
        for tet in range(squeezed[entry], min(squeezed[entry] + width, tets.shape[0])):
            corners = (tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3])
            b = edge(position, corners[0], corners[1])
            c = edge(position, corners[0], corners[2])
            d = edge(position, corners[0], corners[3])
            gb, six = tet_shape(b, c, d)
            ratio = volume_ratio(six, inverse_volume[tet])
            if not ratio < SQUEEZED_RATIO:
                continue
            gc, gd = vector_product(d, b), vector_product(b, c)
            ga = opposite(plus(plus(gb, gc), gd))
            gradients = (ga, gb, gc, gd)
            # Six times the rate of the volume after all forces so far, and its change for a tension of 6.
            six_rate = 0.0
            give = 0.0
            for corner in range(4):
                node = corners[corner]
                rate = dt * inverse_mass[node]
                for axis in range(3):
                    slope = gradients[corner][axis]
                    six_rate += slope * (velocity[node, axis] + rate * force[node, axis])
                    give += slope * slope * rate
            steepness = SQUEEZED_RATIO / ratio
            tension = barrier_bulk[tet] * (ratio - SQUEEZED_RATIO) * steepness
            stiffening = barrier_bulk[tet] * steepness * steepness * dt * (inverse_volume[tet] * (1.0 / 6.0))
            more = min(stiffening * six_rate / (1.0 + stiffening * give * (1.0 / 6.0)), -tension)
            for corner in range(4):
                node = corners[corner]
                for axis in range(3):
                    force[node, axis] -= more * (1.0 / 6.0) * gradients[corner][axis]


@njit(**INLINED)
def _change_speeds(lanes, speed, inverse_mass, dt, i, j, along, pull):
    """Change the speeds of a spring's ends by its pull [N] for one substep.

    No loop over x, y and z: LLVM would not unroll it here, and would spill the direction of many lanes to the stack.
    """
    for_i, for_j = pull * dt * load_item(lanes, inverse_mass, i), pull * dt * load_item(lanes, inverse_mass, j)
    add_to_node(lanes, speed, i, times(for_i, along))
    take_from_node(lanes, speed, j, times(for_j, along))


@njit(**INLINED)
def _direction(lanes, rows, row):
    """Direction of the spring of a row."""
    return (
        load_column(lanes, rows, STEEP_WIDTH, row, 0), load_column(lanes, rows, STEEP_WIDTH, row, 1),
        load_column(lanes, rows, STEEP_WIDTH, row, 2),
    )  # fmt: skip


@njit(**INLINED)
def _set_speed(lanes, speed, velocity, force, inverse_mass, dt, node):
    """Set the change of a node's speed by all forces so far, plus STEEP_DRAG of its speed."""
    rate = dt * load_item(lanes, inverse_mass, node)
    dragged = times(STEEP_DRAG, at_node(lanes, velocity, node))
    set_node(lanes, speed, node, shifted(dragged, rate, at_node(lanes, force, node)))


@njit(**KERNEL)
def hold_steep(lanes, model, state, count, sweeps_least, dt):
    """Implicit rise of the tangent of steep springs: tension T + dt K dw/dt, w = v+ - (1 - d) v at both ends.

    K = h q (1 + sum g_i) with the model's `spring_hold` h and q the mean of (c - 1) v^2 of both ends: the tangent of a
    node's energy over springs and volumes is nowhere above that of linear ones times 1 + q, which would limit the
    step; d = STEEP_DRAG. The tissue kernel has applied T. For the springs with q above STEEP_EXCESS this kernel solves
    for the remainder, p = dt K times the rate of length by w, from the masses of their nodes and all forces so far:
    Gauss-Seidel sweeps over the springs, in order and in reverse in turn, from p = 0. After each pair of sweeps
    M' (v+ - v) = dt f - d (M' - M) v: symplectic Euler with larger masses, M <= M' <= M + dt^2 K, symmetric, and a drag
    that outweighs what these take from or give to the motion as they change. The error of the sweeps is smallest in
    the fast motions, which would limit the step: the largest q of an organ needs (1 + q) SWEEPS_PER_TANGENT sweeps. A
    spring at rest gets no force, so the static equilibrium does not depend on dt.

    In:  count: entries of `steep_springs`, each the first of `group_width` successive springs with a steep spring,
         sweeps_least: an even number as `steep_sweeps` of the model, dt [s]
    Out: force of the nodes, added to
    """
    position, velocity, force = nodes_of(lanes, state)
    nodes, hold, inverse_mass = model.spring_nodes, model.spring_hold, model.node_inverse_mass
    tet_count, width = model.tet_nodes.shape[0], group_width(lanes)
    steepness, steep, places = state.node_steepness, state.steep_springs, state.steep_places
    rows, speed = state.steep_rows, state.steep_speed
    held = 0
    none = load_item(lanes, steepness, 0) * 0.0
    largest = none
    for entry in range(count):
        begin = steep[entry]
        for spring in range(begin, min(begin + width, tet_count if begin < tet_count else nodes.shape[0])):
            i, j = nodes[spring, 0], nodes[spring, 1]
            more = 0.5 * (load_item(lanes, steepness, i) + load_item(lanes, steepness, j))
            if not any_below(STEEP_EXCESS - more, 0.0):
                continue
            largest = keep_lower(more, largest, largest, more)
            along = difference(lanes, position, nodes, spring, 1)
            along = divided(along, spring_length(along))
            # Each of several organs side by side has its own steep springs.
            tangent = keep_lower(none + STEEP_EXCESS, more, load_item(lanes, hold, spring) * more, none)
            if model.relaxes:
                tangent = tangent * load_shared(lanes, steepness, model.element_gain, spring)
            give = dt * load_item(lanes, inverse_mass, i) + dt * load_item(lanes, inverse_mass, j)
            places[held] = spring
            store_column(lanes, rows, STEEP_WIDTH, held, 0, along[0])
            store_column(lanes, rows, STEEP_WIDTH, held, 1, along[1])
            store_column(lanes, rows, STEEP_WIDTH, held, 2, along[2])
            store_column(lanes, rows, STEEP_WIDTH, held, 3, tangent * dt)
            store_column(lanes, rows, STEEP_WIDTH, held, 4, 1.0 / (1.0 + tangent * dt * give))
            store_column(lanes, rows, STEEP_WIDTH, held, 5, none)
            _set_speed(lanes, speed, velocity, force, inverse_mass, dt, i)
            _set_speed(lanes, speed, velocity, force, inverse_mass, dt, j)
            held += 1
    wanted = SWEEPS_PER_TANGENT * (1.0 + largest)
    for sweep in range(model.steep_sweeps):
        pair = sweep - sweep % 2
        goes_on = none + 1.0
        if pair >= sweeps_least:
            if not any_below(pair - wanted, 0.0):
                break
            goes_on = keep_lower(none + pair, wanted, goes_on, none)
        for turn in range(held):
            row = turn if sweep % 2 == 0 else held - 1 - turn
            i, j = nodes[places[row], 0], nodes[places[row], 1]
            along = _direction(lanes, rows, row)
            rate = scalar_product(along, difference(lanes, speed, nodes, places[row], 1))
            pull = load_column(lanes, rows, STEEP_WIDTH, row, 5)
            more = (load_column(lanes, rows, STEEP_WIDTH, row, 3) * rate - pull) * (
                load_column(lanes, rows, STEEP_WIDTH, row, 4) * goes_on
            )
            store_column(lanes, rows, STEEP_WIDTH, row, 5, pull + more)
            _change_speeds(lanes, speed, inverse_mass, dt, i, j, along, more)
    for row in range(held):
        i, j = nodes[places[row], 0], nodes[places[row], 1]
        pull = times(load_column(lanes, rows, STEEP_WIDTH, row, 5), _direction(lanes, rows, row))
        add_to_node(lanes, force, i, pull)
        take_from_node(lanes, force, j, pull)
