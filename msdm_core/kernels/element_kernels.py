"""Equations of a spring and a tet, for numbers or vectors of them; inlined into every loop over them.

Without fastmath nothing is fused or reordered: an organ alone, an organ among others and the same equations in numpy
agree to the bit if sums have the same order.
"""

from numba import njit

from msdm_core.kernels.option_kernels import INLINED, INLINED_KERNEL
from msdm_core.kernels.space_kernels import scalar_product, vector_product
from msdm_core.kernels.vector_kernels import any_below, below_zero, root

# Below this volume ratio s a tet also has a barrier pressure of its whole volume modulus K': with a finite energy at
# J = 0 single tets collapse between swollen neighbours. The barrier's energy K' s V0 ((J - s) - s ln(J / s)) is
# unbounded there. With a linear term instead, tets inverted at 50 to 80 % of the force.
SQUEEZED_RATIO = 0.6
# Rise of a spring's tangent over that at rest above which the spring is steep: its rise is then integrated implicitly.
# A smaller rise counts in `stability.stable_dt`.
STEEP_EXCESS = 0.05
# Added to strains in denominators.
STRAIN_LEAST = 1e-30


@njit(**INLINED)
def spring_length(along):
    """Length of a spring [m]; along: from one end to the other [m]."""
    return root(scalar_product(along, along))


@njit(**INLINED)
def spring_scale(share, stiffness):
    """Force over length of a linear spring, k (1 - l0 / l) (Sala 2011, eq. 1).

    In: share l0 / l, stiffness k [N/m]
    Returns [N/m].
    """
    return stiffness * (1.0 - share)


@njit(**INLINED)
def spring_energy(length, rest_length, stiffness):
    """Twice the energy of a linear spring, k (l - l0)^2 [J]."""
    change = length - rest_length
    return stiffness * change * change


@njit(**INLINED)
def strain_square(energy, softness):
    """Square of the equivalent strain of a node, s^2 = 2 U_a / (E_a V_a) (`Stiffening`).

    In: energy: 4 U_a [J], softness: 1 / (2 E_a V_a) [1/J]
    """
    return energy * softness


@njit(**INLINED_KERNEL)
def node_law(square, onset, growth, excess):
    """Half of a node's factor w'(s) / s on linear tensions, and the rise w'' - 1 of their tangent.

    (1 + (c - 1) (e1 - e0) (v^3 / 3 + (u - v)) / s) / 2 and (c - 1) v^2, with u = (s - e0) / (e1 - e0) and v its part
    within 0, 1.

    In: square s^2, onset e0, growth 1 / (e1 - e0), excess (c - 1) (e1 - e0)
    """
    strain = root(square)
    beyond = (strain - onset) * growth
    over = beyond - below_zero(beyond)
    ramp = 1.0 + below_zero(over - 1.0)
    size = ramp * ramp * ramp * (1.0 / 3.0) + (over - ramp)
    return 0.5 + 0.5 * (excess * size / (strain + STRAIN_LEAST)), excess * growth * ramp * ramp


@njit(**INLINED)
def faded_share(duration, time):
    """Relative loss of tension in a Maxwell arm, 1 - exp(-x), x = duration / time, by exp's series to x^4.

    A rational function has the same bits on every machine; below x = 0.1 it is exact to 1e-7, and it stays within 0 and
    1 for any x.
    """
    x = duration / time
    return 1.0 - 1.0 / (1.0 + x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0)))))


@njit(**INLINED)
def spring_drag(along, velocity, stiffness, beta):
    """Force over length of Rayleigh's beta in a spring, k beta (dl/dt) / l.

    In: along: from one end to the other [m], velocity: difference of their velocities [m/s], stiffness k [N/m],
        beta [s]
    Returns [N/m].
    """
    return stiffness * beta * scalar_product(along, velocity) / scalar_product(along, along)


@njit(**INLINED)
def tet_shape(b, c, d):
    """Six times the gradient dV/dx of the volume of a tet at b, c x d [m^2], and six times the volume [m^3].

    In: b, c, d: edges from the corner a [m]; the gradients at c and d are d x b and b x c
    """
    gradient = vector_product(c, d)
    return gradient, scalar_product(b, gradient)


@njit(**INLINED)
def six_rates(b, c, d, b_rate, c_rate, d_rate):
    """Rate of six times the volume of a tet.

    In: b, c, d: edges from the corner a, three numbers each [m], their rates [m/s]
    Returns [m^3/s].
    """
    return (
        scalar_product(b_rate, vector_product(c, d))
        + scalar_product(c_rate, vector_product(d, b))
        + scalar_product(d_rate, vector_product(b, c))
    )


@njit(**INLINED)
def tet_scale(ratio, own_tension, barrier_bulk, averaged_tension):
    """Factor from six times the gradients dV/dx to the forces of a tet on its corners: minus a sixth of its tension.

    The tension is its own, of K (J - 1), plus the mean tension of the volumes averaged at its corners, plus
    K' (J - s) s / J for J below s = SQUEEZED_RATIO.

    In: ratio J, own_tension [Pa], barrier_bulk K' [Pa], averaged_tension [Pa]
    Returns [Pa].
    """
    tension = own_tension + averaged_tension
    # A quotient takes as long as ten products.
    if any_below(ratio, SQUEEZED_RATIO):
        tension = tension + barrier_bulk * (below_zero(ratio - SQUEEZED_RATIO) * (SQUEEZED_RATIO / ratio))
    return tension * (-1.0 / 6.0)


@njit(**INLINED)
def volume_ratio(six_volume, inverse_volume):
    """Volume of a tet over its rest volume, V / V0.

    In: six_volume: 6 V [m^3], inverse_volume: 1 / V0 [1/m^3]
    """
    return six_volume * (inverse_volume * (1.0 / 6.0))


@njit(**INLINED)
def averaged_change(sum_of_six_volumes, inverse_volume):
    """Relative change of the volume averaged at a node, J_a - 1 (averaged volumes: Bonet and Burton 1998).

    In: sum_of_six_volumes: of the node's tets, 24 times the averaged volume, a quarter of each [m^3], inverse_volume:
        1 / the averaged volume at rest [1/m^3]
    """
    return sum_of_six_volumes * (inverse_volume * (1.0 / 24.0)) - 1.0


@njit(**INLINED)
def volume_energy(change, bulk, volume):
    """Twice the energy of a volume without stiffening, K V0 (J - 1)^2 [J].

    In: change J - 1, bulk K [Pa], volume V0 [m^3]
    """
    return bulk * volume * (change * change)
