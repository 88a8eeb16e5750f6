"""Tets squeezed far below their volume: what keeps their steep pressure from asking for a shorter step."""

from numba import njit

from msdm_core.element_kernels import SQUEEZED_RATIO, tet_shape, volume_ratio


@njit(cache=True, nogil=True, error_model="numpy")
def hold_squeezed(
    position, velocity, force, inverse_mass, tets, inverse_volume, averaged_bulk, squeezed, count, width, dt
):  # fmt: skip
    """Take the pressure of squeezed tets implicitly: tension p + dt p' dJ/dt, with the speeds at the step's end.

    Below s = SQUEEZED_RATIO a tet's own tension p steepens, p' = K' (s / J)^2. The tissue's kernel has applied p; here
    each such tet in turn gets the rest, from its nodes' masses and from the forces that have come together so far.
    A tet at rest gets nothing, so that what the organ balances at does not depend on dt; and none comes to pull.

    In: squeezed: first tet of each `width` in a row among which the kernel saw some; count: how many; dt [s]
    Out: force [N]
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
            # Six times the rate of the volume that all forces so far lead to, and by how much a tension of 6 slows it.
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
