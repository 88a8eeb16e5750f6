"""What would limit the step where tissue is strained far, integrated implicitly: squeezed tets and steep springs."""

from numba import njit

from msdm_core.kernels.element_kernels import (
    SQUEEZED_RATIO,
    STEEP_SHARE,
    beyond_onset,
    spring_length,
    steep_stiffness,
    tet_shape,
    volume_ratio,
)


@njit(cache=True, nogil=True, error_model="numpy")
def hold_squeezed(
    position, velocity, force, inverse_mass, tets, inverse_volume, averaged_bulk, squeezed, count, width, dt
):  # fmt: skip
    """Make the pressure of squeezed tets implicit: tension p + dt p' dJ/dt, with the speeds at the end of the step.

    Below s = SQUEEZED_RATIO the tension p of a tet steepens, p' = K' (s / J)^2, and would limit the step. The tissue
    kernel has applied p; this one adds the rest to each such tet in turn, from the masses of its nodes and all forces
    so far. A tet at rest gets no force, so the static equilibrium does not depend on dt; no tension becomes positive.

    In:  position [m], velocity [m/s] (n_node, 3), inverse_mass [1/kg] (n_node,), tets (n_tet, 4), inverse_volume
         [1/m^3], averaged_bulk [Pa] (n_tet,), squeezed: the first of each `width` tets in a row among which one is
         squeezed (n_tet,), count: entries of `squeezed`, width, dt [s]
    Out: force, added to [N] (n_node, 3)
    """
    for entry in range(count):
        for tet in range(squeezed[entry], min(squeezed[entry] + width, tets.shape[0])):
            corners = (tets[tet, 0], tets[tet, 1], tets[tet, 2], tets[tet, 3])
            g, six = tet_shape(
                _edge(position, corners[0], corners[1]),
                _edge(position, corners[0], corners[2]),
                _edge(position, corners[0], corners[3]),
            )
            ratio = volume_ratio(six, inverse_volume[tet])
            if not ratio < SQUEEZED_RATIO:
                continue
            gradients = (
                (-(g[0] + g[3] + g[6]), -(g[1] + g[4] + g[7]), -(g[2] + g[5] + g[8])),
                (g[0], g[1], g[2]), (g[3], g[4], g[5]), (g[6], g[7], g[8]),
            )  # fmt: skip
            # Six times the rate of the volume that follows from all forces so far, and its change for a tension of 6.
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
            tension = averaged_bulk[tet] * (ratio - SQUEEZED_RATIO) * steepness
            stiffening = averaged_bulk[tet] * steepness * steepness * dt * (inverse_volume[tet] * (1.0 / 6.0))
            more = min(stiffening * six_rate / (1.0 + stiffening * give * (1.0 / 6.0)), -tension)
            for corner in range(4):
                node = corners[corner]
                for axis in range(3):
                    force[node, axis] -= more * (1.0 / 6.0) * gradients[corner][axis]


@njit(cache=True, nogil=True, error_model="numpy")
def hold_steep(
    position, velocity, force, inverse_mass, nodes, stiffness, rest_length, growth, onset, excess, gain, relaxes,
    tet_count, steep, count, width, dt,
):  # fmt: skip
    """Make what stiffening adds to the tangent of steep springs implicit: tension T + dt K dl/dt at the step's end.

    K = k (c - 1) v^2 (1 + sum g_i) would limit the step. The tissue kernel has applied T; this one adds the rest to
    each spring strained beyond STEEP_SHARE in turn, from the masses of its nodes and all forces so far: half of K in
    order and half in reverse, which holds a bar of steep springs at twice to three times the step of one pass. A spring
    at rest gets no force, so the static equilibrium does not depend on dt.

    In:  position [m], velocity [m/s] (n_node, 3), inverse_mass [1/kg] (n_node,), nodes (n_spring, 2), stiffness [N/m],
         rest_length [m], growth [1/m], onset, excess, gain (n_spring,) as in `OrganModel`, relaxes, tet_count: springs
         that come with a tet, steep: the first of each `width` springs in a row among which one is steep, count:
         entries of `steep`, width, dt [s]
    Out: force, added to [N] (n_node, 3)
    """
    for turn in range(2 * count):
        entry = turn if turn < count else 2 * count - 1 - turn
        begin = steep[entry]
        end = min(begin + width, tet_count if begin < tet_count else nodes.shape[0])
        for place in range(end - begin):
            spring = begin + place if turn < count else end - 1 - place
            i, j = nodes[spring, 0], nodes[spring, 1]
            x, y, z = _edge(position, i, j)
            rest, length = rest_length[spring], spring_length(x, y, z)
            beyond = beyond_onset(length, rest, growth[spring], onset[spring])
            if not beyond > STEEP_SHARE:
                continue
            x, y, z = x / length, y / length, z / length
            rate_i, rate_j = dt * inverse_mass[i], dt * inverse_mass[j]
            speed = (
                x * (velocity[j, 0] + rate_j * force[j, 0] - velocity[i, 0] - rate_i * force[i, 0])
                + y * (velocity[j, 1] + rate_j * force[j, 1] - velocity[i, 1] - rate_i * force[i, 1])
                + z * (velocity[j, 2] + rate_j * force[j, 2] - velocity[i, 2] - rate_i * force[i, 2])
            )
            tangent = stiffness[spring] * steep_stiffness(beyond, rest, growth[spring], excess[spring]) * (0.5 * dt)
            if relaxes:
                tangent *= gain[spring]
            more = tangent * speed / (1.0 + tangent * (rate_i + rate_j))
            for axis, part in enumerate((x, y, z)):
                force[i, axis] += more * part
                force[j, axis] -= more * part


@njit(forceinline=True, error_model="numpy")
def _edge(position, a, b):
    """From one node to another."""
    return position[b, 0] - position[a, 0], position[b, 1] - position[a, 1], position[b, 2] - position[a, 2]
