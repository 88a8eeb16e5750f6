"""Tets compressed far below their rest volume: their steep pressure, integrated implicitly."""

from numba import njit

from msdm_core.kernels.element_kernels import SQUEEZED_RATIO, tet_shape, volume_ratio


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


@njit(forceinline=True, error_model="numpy")
def _edge(position, a, b):
    """From one node to another."""
    return position[b, 0] - position[a, 0], position[b, 1] - position[a, 1], position[b, 2] - position[a, 2]
