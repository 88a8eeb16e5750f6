"""The equations of one spring and one tet, for numbers or vectors of them; compiled into every loop over them.

Without fastmath nothing is fused or reordered: an organ alone, an organ among others and the same equations in numpy
agree to the bit where they add in the same order.
"""

from numba import njit

from msdm_core.kernels.vector_kernels import any_below, below_zero, keep_lower, root

# Below this volume ratio s a tet also bears the share K' of its volume term that is averaged at nodes, by a pressure
# that steepens: an average alone lets single tets collapse between swollen neighbours. Its energy
# K' s V0 ((J - s) - s ln(J / s)) is unbounded at J = 0. With a linear term instead, tets inverted at 50 to 80 % of the
# force.
SQUEEZED_RATIO = 0.6
# A spring strained further than this share of the way from its onset strain to its cap strain is steep: the tangent
# beyond that of the linear spring is integrated implicitly. Below, it is at most 1 + 0.0009 (c - 1) times as stiff,
# which `stability.stable_dt` counts.
STEEP_SHARE = 0.03


@njit(forceinline=True, error_model="numpy")
def spring_length(dx, dy, dz):
    """Length of a spring [m]; d: from one end to the other [m]."""
    return root(dx * dx + dy * dy + dz * dz)


@njit(forceinline=True, error_model="numpy")
def spring_scale(share, stiffness):
    """Force over length of a linear spring, k (1 - l0 / l) (Sala 2011, eq. 1).

    In: share l0 / l, stiffness k [N/m]
    Returns [N/m].
    """
    return stiffness * (1.0 - share)


@njit(forceinline=True, error_model="numpy")
def beyond_onset(length, rest_length, growth, onset):
    """How far a spring is strained beyond its onset strain, u = (|e| - e0) / (e1 - e0) (`Stiffening`).

    In: length l, rest_length l0 [m], growth 1 / (l0 (e1 - e0)) [1/m], onset e0 / (e1 - e0)
    Returns u, negative below the onset.
    """
    change = length - rest_length
    return (change - 2.0 * below_zero(change)) * growth - onset


@njit(forceinline=True, error_model="numpy")
def excess_scale(length, rest_length, share, beyond, excess):
    """Force over length and stiffness that stiffening adds, sign(e) (c - 1) (e1 - e0) (v^3 / 3 + (u - v)) l0 / l.

    In: length l, rest_length l0 [m], share l0 / l, beyond u, of which v is the part within 0 and 1, excess
        (c - 1) (e1 - e0)
    """
    over = beyond - below_zero(beyond)
    ramp = 1.0 + below_zero(over - 1.0)
    size = ramp * ramp * ramp * (1.0 / 3.0) + (over - ramp)
    return excess * keep_lower(length, rest_length, size * -1.0, size) * share


@njit(forceinline=True, error_model="numpy")
def steep_stiffness(beyond, rest_length, growth, excess):
    """Tangent over stiffness that stiffening adds to a spring, (c - 1) v^2; arguments as in `excess_scale`, numbers."""
    ramp = min(max(beyond, 0.0), 1.0)
    return excess * growth * rest_length * ramp * ramp


@njit(forceinline=True, error_model="numpy")
def faded_share(duration, time):
    """Share of its tension that a Maxwell arm loses, 1 - exp(-x), x = duration / time, by exp's series to x^4.

    A rational function has the same bits on every machine; below x = 0.1 it is exact to 1e-7, and it stays within 0 and
    1 for any x.
    """
    x = duration / time
    return 1.0 - 1.0 / (1.0 + x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0)))))


@njit(forceinline=True, error_model="numpy")
def spring_drag(dx, dy, dz, vx, vy, vz, stiffness, beta):
    """Force over length that Rayleigh's beta adds to a spring, k beta (dl/dt) / l.

    In: d: from one end to the other [m], v: difference of their velocities [m/s], stiffness k [N/m], beta [s]
    Returns [N/m].
    """
    return stiffness * beta * (dx * vx + dy * vy + dz * vz) / (dx * dx + dy * dy + dz * dz)


@njit(forceinline=True, error_model="numpy")
def tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz):
    """Six times the gradients dV/dx of the volume of a tet at its corners b, c and d: cross products of its edges.

    In: b, c, d: edges from the corner a [m]
    Returns nine numbers [m^2], x, y and z of each corner.
    """
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
    """Six times the volume of a tet: one edge times six times its gradient.

    In: b: edge from the corner a [m], gb: six times the gradient at b [m^2]
    Returns [m^3].
    """
    return bx * gbx + by * gby + bz * gbz


@njit(forceinline=True, error_model="numpy")
def tet_shape(b, c, d):
    """Six times the gradients and six times the volume of a tet.

    In: b, c, d: edges from the corner a, three numbers each [m]
    Returns the nine numbers of `tet_gradients` [m^2], and six times the volume [m^3].
    """
    gradients = tet_gradients(b[0], b[1], b[2], c[0], c[1], c[2], d[0], d[1], d[2])
    return gradients, six_volumes(b[0], b[1], b[2], gradients[0], gradients[1], gradients[2])


@njit(forceinline=True, error_model="numpy")
def six_rates(b, c, d, g):
    """Rate of six times the volume of a tet.

    In: b, c, d: velocities of these corners less that of a, three numbers each [m/s], g: `tet_gradients` [m^2]
    Returns [m^3/s].
    """
    return (
        six_volumes(b[0], b[1], b[2], g[0], g[1], g[2])
        + six_volumes(c[0], c[1], c[2], g[3], g[4], g[5])
        + six_volumes(d[0], d[1], d[2], g[6], g[7], g[8])
    )


@njit(forceinline=True, error_model="numpy")
def tet_scale(ratio, bulk, averaged_bulk, averaged_tension):
    """Factor from `tet_gradients` to the forces of a tet on its corners: minus a sixth of its tension.

    The tension is K (J - 1), plus the mean tension of the volumes averaged at its corners, plus, where J is below
    s = SQUEEZED_RATIO, K' (J - s) s / J.

    In: ratio J, bulk K [Pa], averaged_bulk K' [Pa], averaged_tension [Pa]
    Returns [Pa].
    """
    tension = bulk * (ratio - 1.0) + averaged_tension
    # A quotient takes as long as ten products: only where there is something to add.
    if any_below(ratio, SQUEEZED_RATIO):
        tension = tension + averaged_bulk * (below_zero(ratio - SQUEEZED_RATIO) * (SQUEEZED_RATIO / ratio))
    return tension * (-1.0 / 6.0)


@njit(forceinline=True, error_model="numpy")
def volume_ratio(six_volume, inverse_volume):
    """Volume of a tet over its rest volume, V / V0.

    In: six_volume: 6 V [m^3], inverse_volume: 1 / V0 [1/m^3]
    """
    return six_volume * (inverse_volume * (1.0 / 6.0))


@njit(forceinline=True, error_model="numpy")
def node_tension(sum_of_six_volumes, inverse_volume, bulk):
    """Tension of the volume averaged at a node, K_a (J_a - 1) (averaged volumes: Bonet and Burton 1998).

    In: sum_of_six_volumes: of the node's tets, 24 times the averaged volume, a quarter of each [m^3], inverse_volume:
        1 / the averaged volume at rest [1/m^3], bulk K_a [Pa]
    Returns [Pa].
    """
    return bulk * (sum_of_six_volumes * (inverse_volume * (1.0 / 24.0)) - 1.0)
