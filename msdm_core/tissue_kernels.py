"""Springs and volume term of one organ, eight springs or tets at a time; arrays of rows of four (x, y, z and nothing).

The rows of eight items are loaded, turned into vectors of eight x, y and z, worked on by the equations in
`element_kernels`, turned back and added up item by item: the same sums in the same order as a plain loop.
"""

from numba import njit

from msdm_core.element_kernels import (
    SQUEEZED_RATIO,
    node_tension,
    six_rates,
    six_volumes,
    spring_drag,
    spring_scale,
    tet_gradients,
    tet_scale,
    tet_shape,
    volume_ratio,
)
from msdm_core.vector import (
    any_below,
    define_extract,
    define_shuffle,
    keep_lower,
    load_full,
    load_row,
    pack,
    spread_like,
    store_row,
)

GROUP = 8

_join = define_shuffle([0, 1, 2, 3, 4, 5, 6, 7])
_pick_xy = define_shuffle([0, 4, 8, 12, 1, 5, 9, 13])
_pick_z = define_shuffle([2, 6, 10, 14, 3, 7, 11, 15])
_low_halves = define_shuffle([0, 1, 2, 3, 8, 9, 10, 11])
_high_halves = define_shuffle([4, 5, 6, 7, 12, 13, 14, 15])
_mesh_low = define_shuffle([0, 8, 1, 9, 2, 10, 3, 11])
_mesh_high = define_shuffle([4, 12, 5, 13, 6, 14, 7, 15])
_row_0 = define_shuffle([0, 1, 8, 9])
_row_1 = define_shuffle([2, 3, 10, 11])
_row_2 = define_shuffle([4, 5, 12, 13])
_row_3 = define_shuffle([6, 7, 14, 15])
_at_0, _at_1, _at_2, _at_3, _at_4, _at_5, _at_6, _at_7 = (define_extract(place) for place in range(GROUP))


@njit(forceinline=True, error_model="numpy")
def _columns(r0, r1, r2, r3, r4, r5, r6, r7):
    """Eight rows (x, y, z, -) as three vectors of eight."""
    r01, r23, r45, r67 = _join(r0, r1), _join(r2, r3), _join(r4, r5), _join(r6, r7)
    low, high = _pick_xy(r01, r23), _pick_xy(r45, r67)
    return _low_halves(low, high), _high_halves(low, high), _low_halves(_pick_z(r01, r23), _pick_z(r45, r67))


@njit(forceinline=True, error_model="numpy")
def _rows(x, y, z):
    """Three vectors of eight as eight rows (x, y, z, 0)."""
    nothing = z * 0.0
    low, high, low_z, high_z = _mesh_low(x, y), _mesh_high(x, y), _mesh_low(z, nothing), _mesh_high(z, nothing)
    return (
        _row_0(low, low_z), _row_1(low, low_z), _row_2(low, low_z), _row_3(low, low_z),
        _row_0(high, high_z), _row_1(high, high_z), _row_2(high, high_z), _row_3(high, high_z),
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def _edge(values, items, item, corner):
    """Row from corner 0 of an item to another of its corners."""
    return load_row(values, items[item, corner]) - load_row(values, items[item, 0])


@njit(forceinline=True, error_model="numpy")
def _edges(values, items, first, corner):
    """The same of eight items, as three vectors."""
    return _columns(
        _edge(values, items, first, corner), _edge(values, items, first + 1, corner),
        _edge(values, items, first + 2, corner), _edge(values, items, first + 3, corner),
        _edge(values, items, first + 4, corner), _edge(values, items, first + 5, corner),
        _edge(values, items, first + 6, corner), _edge(values, items, first + 7, corner),
    )  # fmt: skip


@njit(forceinline=True, error_model="numpy")
def _pull(force, items, item, pull):
    """Add a row to the first end of a spring and take it from the other."""
    i, j = items[item, 0], items[item, 1]
    store_row(force, i, load_row(force, i) + pull)
    store_row(force, j, load_row(force, j) - pull)


@njit(forceinline=True, error_model="numpy")
def _push(force, items, item, a, b, c, d):
    """Take a row from corner a of a tet and add one to each of the others."""
    at_a, at_b, at_c, at_d = items[item, 0], items[item, 1], items[item, 2], items[item, 3]
    store_row(force, at_a, load_row(force, at_a) - a)
    store_row(force, at_b, load_row(force, at_b) + b)
    store_row(force, at_c, load_row(force, at_c) + c)
    store_row(force, at_d, load_row(force, at_d) + d)


@njit(forceinline=True, error_model="numpy")
def _share(total, items, item, value):
    """Add a number to each corner of a tet."""
    total[items[item, 0]] += value
    total[items[item, 1]] += value
    total[items[item, 2]] += value
    total[items[item, 3]] += value


@njit(cache=True, nogil=True, error_model="numpy")
def set_gravity(force, mass, gravity):
    """F = m g."""
    for node in range(force.shape[0]):
        for axis in range(3):
            force[node, axis] = mass[node] * gravity[axis]
        force[node, 3] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(position, velocity, force, inverse_mass, dt, decay):
    """Symplectic Euler: v = decay v + dt f / m, x = x + dt v, decay = e^(-alpha dt); returns a sum finite if all is."""
    total = load_row(position, 0) * 0.0
    for node in range(position.shape[0]):
        speed = load_row(velocity, node) * decay + load_row(force, node) * (dt * inverse_mass[node])
        place = load_row(position, node) + speed * dt
        store_row(velocity, node, speed)
        store_row(position, node, place)
        total = total + (place + speed)
    return (_at_0(total) + _at_1(total)) + _at_2(total)


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_forces(position, force, nodes, stiffness, rest_length, begin):
    """Springs from one on to the last: f = k (l - l0) along the spring (Sala 2011, eq. 1)."""
    whole = begin + (nodes.shape[0] - begin) // GROUP * GROUP
    for first in range(begin, whole, GROUP):
        r0, r1 = _edge(position, nodes, first, 1), _edge(position, nodes, first + 1, 1)
        r2, r3 = _edge(position, nodes, first + 2, 1), _edge(position, nodes, first + 3, 1)
        r4, r5 = _edge(position, nodes, first + 4, 1), _edge(position, nodes, first + 5, 1)
        r6, r7 = _edge(position, nodes, first + 6, 1), _edge(position, nodes, first + 7, 1)
        x, y, z = _columns(r0, r1, r2, r3, r4, r5, r6, r7)
        scale = spring_scale(x, y, z, load_full(stiffness, first), load_full(rest_length, first))
        _pull(force, nodes, first, r0 * _at_0(scale))
        _pull(force, nodes, first + 1, r1 * _at_1(scale))
        _pull(force, nodes, first + 2, r2 * _at_2(scale))
        _pull(force, nodes, first + 3, r3 * _at_3(scale))
        _pull(force, nodes, first + 4, r4 * _at_4(scale))
        _pull(force, nodes, first + 5, r5 * _at_5(scale))
        _pull(force, nodes, first + 6, r6 * _at_6(scale))
        _pull(force, nodes, first + 7, r7 * _at_7(scale))
    for spring in range(whole, nodes.shape[0]):
        x, y, z = _difference(position, nodes, spring, 1)
        scale = spring_scale(x, y, z, stiffness[spring], rest_length[spring])
        _pull(force, nodes, spring, _edge(position, nodes, spring, 1) * scale)


@njit(cache=True, nogil=True, error_model="numpy")
def add_spring_damping(position, velocity, force, nodes, stiffness, beta):
    """Rayleigh's beta along the springs: f = k beta dl/dt."""
    for spring in range(nodes.shape[0]):
        x, y, z = _difference(position, nodes, spring, 1)
        vx, vy, vz = _difference(velocity, nodes, spring, 1)
        scale = spring_drag(x, y, z, vx, vy, vz, stiffness[spring], beta)
        _pull(force, nodes, spring, _edge(position, nodes, spring, 1) * scale)


@njit(forceinline=True, error_model="numpy")
def _difference(values, items, item, corner):
    """From corner 0 of an item to another of its corners, as three numbers."""
    i, j = items[item, 0], items[item, corner]
    return values[j, 0] - values[i, 0], values[j, 1] - values[i, 1], values[j, 2] - values[i, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def sum_volumes(position, total, tets):
    """Six times the volume of every tet, added up at its corners [m^3]."""
    whole = tets.shape[0] // GROUP * GROUP
    for first in range(0, whole, GROUP):
        bx, by, bz = _edges(position, tets, first, 1)
        cx, cy, cz = _edges(position, tets, first, 2)
        dx, dy, dz = _edges(position, tets, first, 3)
        g = tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz)
        six = six_volumes(bx, by, bz, g[0], g[1], g[2])
        _share(total, tets, first, _at_0(six))
        _share(total, tets, first + 1, _at_1(six))
        _share(total, tets, first + 2, _at_2(six))
        _share(total, tets, first + 3, _at_3(six))
        _share(total, tets, first + 4, _at_4(six))
        _share(total, tets, first + 5, _at_5(six))
        _share(total, tets, first + 6, _at_6(six))
        _share(total, tets, first + 7, _at_7(six))
    for tet in range(whole, tets.shape[0]):
        _, six = tet_shape(*_three_edges(position, tets, tet))
        _share(total, tets, tet, six)


@njit(forceinline=True, error_model="numpy")
def _three_edges(values, tets, tet):
    """From corner 0 of a tet to its other three."""
    return _difference(values, tets, tet, 1), _difference(values, tets, tet, 2), _difference(values, tets, tet, 3)


@njit(cache=True, nogil=True, error_model="numpy")
def set_node_tension(total, node_inverse_volume, node_bulk):
    """From the sums at nodes to the tension of the volumes averaged there, K_a (J_a - 1) [Pa]."""
    for node in range(total.shape[0]):
        total[node] = node_tension(total[node], node_inverse_volume[node], node_bulk[node])


@njit(cache=True, nogil=True, error_model="numpy")
def add_volume_rates(position, velocity, total, tets, beta):
    """Beta times the rate of `sum_volumes`."""
    for tet in range(tets.shape[0]):
        gradients, _ = tet_shape(*_three_edges(position, tets, tet))
        _share(total, tets, tet, beta * six_rates(*_three_edges(velocity, tets, tet), gradients))


@njit(cache=True, nogil=True, error_model="numpy")
def add_volume_damping(position, velocity, force, tets, inverse_volume, bulk, beta):
    """Beta's share of each tet's own volume term: tension K beta dJ/dt."""
    for tet in range(tets.shape[0]):
        gradients, _ = tet_shape(*_three_edges(position, tets, tet))
        rate = beta * volume_ratio(six_rates(*_three_edges(velocity, tets, tet), gradients), inverse_volume[tet])
        _push_one(force, tets, tet, bulk[tet] * rate * (-1.0 / 6.0), gradients, 0.0, gradients)


@njit(forceinline=True, error_model="numpy")
def _corner_tension(tension, tets, tet):
    """Mean tension of the volumes around the corners of a tet."""
    return 0.25 * (tension[tets[tet, 0]] + tension[tets[tet, 1]] + tension[tets[tet, 2]] + tension[tets[tet, 3]])


@njit(cache=True, nogil=True, error_model="numpy")
def add_tet_forces(
    position, force, tension, tets, inverse_volume, bulk, averaged_bulk, stiffness, rest_length, low, squeezed
):  # fmt: skip
    """Volume terms: a tet pulls its corners with its tension times dV/dx; keeps the smallest V / V0 seen.

    K (J - 1) per tet adds K to Lame's lambda and nothing to mu (after the volume-only energy of Golec et al. 2020); the
    mean tension of the volumes averaged at its corners comes on top. Spring t comes with tet t, whose first edge it is.
    Returns how many groups of eight have a squeezed tet; `squeezed` holds the first tet of each.
    """
    whole = tets.shape[0] // GROUP * GROUP
    count = 0
    lowest = spread_like(inverse_volume, low[0])
    for first in range(0, whole, GROUP):
        bx, by, bz = _edges(position, tets, first, 1)
        cx, cy, cz = _edges(position, tets, first, 2)
        dx, dy, dz = _edges(position, tets, first, 3)
        gbx, gby, gbz, gcx, gcy, gcz, gdx, gdy, gdz = tet_gradients(bx, by, bz, cx, cy, cz, dx, dy, dz)
        ratio = volume_ratio(six_volumes(bx, by, bz, gbx, gby, gbz), load_full(inverse_volume, first))
        lowest = keep_lower(ratio, lowest, ratio, lowest)
        if any_below(ratio, SQUEEZED_RATIO):
            squeezed[count] = first
            count += 1
        averaged = pack(
            _corner_tension(tension, tets, first), _corner_tension(tension, tets, first + 1),
            _corner_tension(tension, tets, first + 2), _corner_tension(tension, tets, first + 3),
            _corner_tension(tension, tets, first + 4), _corner_tension(tension, tets, first + 5),
            _corner_tension(tension, tets, first + 6), _corner_tension(tension, tets, first + 7),
        )  # fmt: skip
        scale = tet_scale(ratio, load_full(bulk, first), load_full(averaged_bulk, first), averaged)
        pull = spring_scale(bx, by, bz, load_full(stiffness, first), load_full(rest_length, first))
        gbx, gby, gbz = scale * gbx - pull * bx, scale * gby - pull * by, scale * gbz - pull * bz
        gcx, gcy, gcz = scale * gcx, scale * gcy, scale * gcz
        gdx, gdy, gdz = scale * gdx, scale * gdy, scale * gdz
        a = _rows(gbx + gcx + gdx, gby + gcy + gdy, gbz + gcz + gdz)
        b, c, d = _rows(gbx, gby, gbz), _rows(gcx, gcy, gcz), _rows(gdx, gdy, gdz)
        _push(force, tets, first, a[0], b[0], c[0], d[0])
        _push(force, tets, first + 1, a[1], b[1], c[1], d[1])
        _push(force, tets, first + 2, a[2], b[2], c[2], d[2])
        _push(force, tets, first + 3, a[3], b[3], c[3], d[3])
        _push(force, tets, first + 4, a[4], b[4], c[4], d[4])
        _push(force, tets, first + 5, a[5], b[5], c[5], d[5])
        _push(force, tets, first + 6, a[6], b[6], c[6], d[6])
        _push(force, tets, first + 7, a[7], b[7], c[7], d[7])
    _keep(low, _at_0(lowest))
    _keep(low, _at_1(lowest))
    _keep(low, _at_2(lowest))
    _keep(low, _at_3(lowest))
    _keep(low, _at_4(lowest))
    _keep(low, _at_5(lowest))
    _keep(low, _at_6(lowest))
    _keep(low, _at_7(lowest))
    for tet in range(whole, tets.shape[0]):
        edge, c, d = _three_edges(position, tets, tet)
        gradients, six = tet_shape(edge, c, d)
        ratio = volume_ratio(six, inverse_volume[tet])
        _keep(low, ratio)
        if any_below(ratio, SQUEEZED_RATIO) and not (count > 0 and squeezed[count - 1] == whole):
            squeezed[count] = whole
            count += 1
        scale = tet_scale(ratio, bulk[tet], averaged_bulk[tet], _corner_tension(tension, tets, tet))
        pull = spring_scale(edge[0], edge[1], edge[2], stiffness[tet], rest_length[tet])
        _push_one(force, tets, tet, scale, gradients, pull, edge)
    return count


@njit(forceinline=True, error_model="numpy")
def _keep(low, ratio):
    """Remember a volume ratio where it is the smallest yet."""
    if not ratio >= low[0]:
        low[0] = ratio


@njit(forceinline=True, error_model="numpy")
def _push_one(force, tets, tet, scale, gradients, pull, edge):
    """Forces of one tet, corner by corner, and of the spring along its first edge."""
    for axis in range(3):
        b, c, d = scale * gradients[axis] - pull * edge[axis], scale * gradients[3 + axis], scale * gradients[6 + axis]
        force[tets[tet, 0], axis] -= b + c + d
        force[tets[tet, 1], axis] += b
        force[tets[tet, 2], axis] += c
        force[tets[tet, 3], axis] += d
