"""The equations of one spring and one tet, for numbers or for vectors of them; compiled into every loop over them.

Without fastmath nothing is fused or reordered: one organ, an organ among others and the plain equations in numpy agree
to the bit as far as the order of their sums does.
"""

from numba import njit

from msdm_core.vector import any_below, below_zero, root

# Below this volume ratio s a tet also bears the share K' of its volume term that is averaged at nodes, and ever more of
# it: an average lets single tets collapse between swollen neighbours. Its energy K' s V0 ((J - s) - s ln(J / s)) has no
# bound at J = 0. With a linear term in its place, presses turned tets inside out at half to four fifths of the force.
SQUEEZED_RATIO = 0.6


@njit(forceinline=True, error_model="numpy")
def spring_scale(dx, dy, dz, stiffness, rest_length):
    """Force over length of a spring, k (1 - l0 / l) [N/m] (Sala 2011, eq. 1)."""
    return stiffness * (1.0 - rest_length / root(dx * dx + dy * dy + dz * dz))


@njit(forceinline=True, error_model="numpy")
def spring_drag(dx, dy, dz, vx, vy, vz, stiffness, beta):
    """What Rayleigh's beta adds to that, k beta (dl/dt) / l [N/m], from the difference v of the ends' velocities."""
    return stiffness * beta * (dx * vx + dy * vy + dz * vz) / (dx * dx + dy * dy + dz * dz)


@njit(forceinline=True, error_model="numpy")
def tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz):
    """Six times dV/dx [m^2] of the corners b, c and d of a tet, from its edges to them: their cross products."""
    gbx = cy * dz - cz * dy
    gby = cz * dx - cx * dz
    gbz = cx * dy - cy * dx
    gcx = dy * bz - dz * by
    gcy = dz * bx - dx * bz
    gcz = dx * by - dy * bx
    gdx = by * cz - bz * cy
    gdy = bz * cx - bx * cz
    gdz = bx * cy - by * cx
    return gbx, gby, gbz, gcx, gcy, gcz, gdx, gdy, gdz


@njit(forceinline=True, error_model="numpy")
def six_volumes(bx, by, bz, gbx, gby, gbz):
    """Six times the volume of a tet [m^3]: one edge times its gradient."""
    return bx * gbx + by * gby + bz * gbz


@njit(forceinline=True, error_model="numpy")
def tet_shape(b, c, d):
    """Six times the gradients and the volume of a tet, from its edges to b, c and d, three parts each."""
    gradients = tet_gradients(b[0], b[1], b[2], c[0], c[1], c[2], d[0], d[1], d[2])
    return gradients, six_volumes(b[0], b[1], b[2], gradients[0], gradients[1], gradients[2])


@njit(forceinline=True, error_model="numpy")
def six_rates(b, c, d, g):
    """Rate of that [m^3/s], from what corner a's velocity is short of those of b, c and d, three parts each."""
    return (
        six_volumes(b[0], b[1], b[2], g[0], g[1], g[2])
        + six_volumes(c[0], c[1], c[2], g[3], g[4], g[5])
        + six_volumes(d[0], d[1], d[2], g[6], g[7], g[8])
    )


@njit(forceinline=True, error_model="numpy")
def tet_scale(ratio, bulk, averaged_bulk, averaged_tension):
    """What a tet's gradients (six times dV/dx) are to be multiplied with, minus a sixth of its tension [Pa].

    That is K (J - 1) of its own; the mean of the volumes averaged at its corners; and,
    where it is squeezed below s = SQUEEZED_RATIO, K' (J - s) s / J of the share K' that is averaged.
    """
    tension = bulk * (ratio - 1.0) + averaged_tension
    # A quotient takes as long as ten products: only where there is something to add.
    if any_below(ratio, SQUEEZED_RATIO):
        tension = tension + averaged_bulk * (below_zero(ratio - SQUEEZED_RATIO) * (SQUEEZED_RATIO / ratio))
    return tension * (-1.0 / 6.0)


@njit(forceinline=True, error_model="numpy")
def volume_ratio(six_volume, inverse_volume):
    """V / V0 of a tet from six times its volume and 1 / V0."""
    return six_volume * (inverse_volume * (1.0 / 6.0))


@njit(forceinline=True, error_model="numpy")
def node_tension(sum_of_six_volumes, inverse_volume, bulk):
    """Tension of the volume averaged at a node, K_a (J_a - 1) [Pa] (averaged volumes: Bonet and Burton 1998).

    The sum holds 24 times that volume: six for the box product, four for the quarter that each tet gives.
    """
    return bulk * (sum_of_six_volumes * (inverse_volume * (1.0 / 24.0)) - 1.0)
