"""Isosurface stuffing (Labelle and Shewchuk 2007): a closed surface filled with tets of a body-centred cubic lattice.

Grid coordinates count HALF cells, so that the nodes are the integer points whose coordinates are all even (cube
corners) or all odd (cube centres); an edge is long (two steps along an axis) or short (one step along a diagonal).
A node's number is its row-major place in the enclosing integer grid.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.surface import line_hits
from msdm_core.mesh.tet_mesh import FloatArray, Int64Array

Field = Callable[[FloatArray], FloatArray]

# Bisections for the place of a cut on an edge: 2^-HALVINGS of its length.
HALVINGS = 24
# Nodes move onto a surface within this share of an edge: the paper's "safe" values. Random signs and cuts on a lattice
# (a million tets, cuts at the limits) gave dihedral angles of 9.317 to 161.643 degrees, never beyond.
ALPHA_LONG, ALPHA_SHORT = 0.24999, 0.41189

AXES = np.eye(3, dtype=np.int64) * 2
DIAGONALS = np.array([(1, y, z) for y, z in product((1, -1), repeat=2)], dtype=np.int64)
# Shift of the lattice [cells], so that no lattice line runs through a vertex or along an edge of an aligned surface.
ORIGIN_SHIFT = 1e-7 * np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])

CLEAR_CELLS = 2  # cells of empty lattice around the surface: no tet then reaches past the grid


@dataclass(frozen=True)
class Lattice:
    """A grid of half cells around a surface: position [m] = origin + half_cell * grid coordinates."""

    origin: FloatArray  # (3,) [m]
    half_cell: float  # [m]
    shape: tuple[int, int, int]

    @property
    def strides(self) -> Int64Array:
        """Increment of the node number per step along each axis, shape (3,)."""
        return np.array([self.shape[1] * self.shape[2], self.shape[2], 1], dtype=np.int64)

    def coordinates(self, nodes: Int64Array) -> Int64Array:
        """Grid coordinates of nodes, shape (..., 3)."""
        return np.stack(np.unravel_index(nodes, self.shape), axis=-1)


def lattice_around(vertices: FloatArray, cell_size: float, width: int = 1) -> Lattice:
    """Lattice of cubes with edge `cell_size` [m], with a cube corner at the middle of the bounding box.

    Its cells fill whole cubes of `width` (1, 2, 4, ...) cells along each edge, CLEAR_CELLS of them empty all around.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    # An even reach gives the middle node even coordinates: it is a cube corner.
    reach = 2 * (np.ceil((high - low) / (2 * cell_size)).astype(np.int64) + CLEAR_CELLS * width)
    reach += -reach % width
    half_cell = cell_size / 2
    origin = (low + high) / 2 + cell_size * ORIGIN_SHIFT - half_cell * reach
    nx, ny, nz = (int(n) for n in 2 * reach + 1)
    return Lattice(origin, half_cell, (nx, ny, nz))


def node_signs(grid_vertices: FloatArray, triangles: Int64Array, lattice: Lattice) -> NDArray[np.int8]:
    """+1 inside, -1 outside, per grid point: parity of the crossings along x, shape (n_grid,); only nodes count."""
    crossed = np.zeros(lattice.shape, dtype=np.int8)
    x, y, z = grid_vertices.T
    for parity in (0, 1):
        row, column, at = line_hits(y, z, x, triangles, parity)
        next_node = np.ceil(at).astype(np.int64)
        np.add.at(crossed, (next_node, row, column), 1)
    inside = np.cumsum(crossed, axis=0, dtype=np.int64) % 2
    return (2 * inside - 1).astype(np.int8).ravel()


def edge_fractions(
    step: Int64Array, node: Int64Array, grid_vertices: FloatArray, triangles: Int64Array, lattice: Lattice
) -> FloatArray:
    """Fraction of each edge at its crossing with the surface, the middle one of several, shape (n,).

    Args:
        step: from node to node, (3,), or (n, 3) for edges of one direction but several lengths; its largest
            component is positive, the others are as large or zero.
        node: first node of each edge, shape (n,).
        grid_vertices: of the surface, in grid coordinates.
        triangles: of the surface.
        lattice: the grid.
    """
    direction = np.atleast_2d(step)[0]
    along = int(np.argmax(direction))
    across = [axis for axis in range(3) if axis != along]
    length = step[..., along]
    # Coordinates that are constant along the line number it; on a diagonal they can be negative.
    shear = direction[across] // direction[along]
    reach = 2 * max(lattice.shape)
    nodes = lattice.coordinates(node)
    start = nodes[:, along]
    lines = nodes[:, across] - shear * start[:, None]
    projected = grid_vertices[:, across] - shear * grid_vertices[:, [along]]
    # Nodes are all even or all odd: so are the lines along an axis, and along a diagonal of the cube all are even.
    hits = [
        line_hits(projected[:, 0], projected[:, 1], grid_vertices[:, along], triangles, parity)
        for parity in ((0,) if shear.all() else (0, 1))
    ]
    row, column, hit_at = (np.concatenate(parts) for parts in zip(*hits, strict=True))
    hit_line = (row + reach) * (4 * reach) + column + reach
    edge_line = (lines[:, 0] + reach) * (4 * reach) + lines[:, 1] + reach
    order = np.lexsort([hit_at, hit_line])
    hit_at, hit_line = hit_at[order], hit_line[order]
    # Crossings belong to the half-open stretch (start, start + length], as in node_signs.
    hit_key = hit_line * (2 * reach) + np.ceil(hit_at).astype(np.int64)
    first = np.searchsorted(hit_key, edge_line * (2 * reach) + start, side="right")
    after = np.searchsorted(hit_key, edge_line * (2 * reach) + start + length, side="right")
    chosen = first + (after - first) // 2
    # An end within rounding of the surface can have its crossing counted on the next edge of the same line.
    missed = first == after
    before, behind = np.maximum(first - 1, 0), np.minimum(first, len(hit_at) - 1)
    gap_before = np.where(hit_line[before] == edge_line, np.abs(start - hit_at[before]), np.inf)
    gap_behind = np.where(hit_line[behind] == edge_line, np.abs(hit_at[behind] - start - length), np.inf)
    chosen = np.where(missed, np.where(gap_before <= gap_behind, before, behind), chosen)
    return np.clip((hit_at[chosen] - start) / length, 0.0, 1.0)


@dataclass(frozen=True)
class Cuts:
    """Cuts of lattice edges by the surface, one per edge, in increasing order of (node, other)."""

    node: Int64Array  # (n_cut,)
    other: Int64Array  # (n_cut,), above node
    fraction: FloatArray  # (n_cut,), 0 at node, 1 at other
    is_long: NDArray[np.bool_]  # (n_cut,)


class Body(Protocol):
    """A body to be filled with tets."""

    @property
    def box(self) -> FloatArray:
        """Points around the body: it lies in their bounding box [m], shape (n, 3)."""
        ...

    def signs(self, lattice: Lattice) -> NDArray[np.int8]:
        """+1 inside, -1 outside, per grid point, shape (n_grid,); only nodes count."""
        ...

    def fractions(self, step: Int64Array, node: Int64Array, sign: NDArray[np.int8], lattice: Lattice) -> FloatArray:
        """Fraction of each edge at its crossing with the surface (n,); `step`, `node` as in `edge_fractions`."""
        ...


@dataclass(frozen=True, eq=False)
class SurfaceBody:
    """The inside of a closed surface: vertices [m] (n_vertex, 3) and triangles (n_triangle, 3)."""

    vertices: FloatArray
    triangles: Int64Array

    @property
    def box(self) -> FloatArray:
        """The vertices."""
        return self.vertices

    def signs(self, lattice: Lattice) -> NDArray[np.int8]:
        """As `Body.signs`."""
        return node_signs(self._on_grid(lattice), self.triangles, lattice)

    def fractions(self, step: Int64Array, node: Int64Array, sign: NDArray[np.int8], lattice: Lattice) -> FloatArray:
        """As `Body.fractions`."""
        return edge_fractions(step, node, self._on_grid(lattice), self.triangles, lattice)

    def _on_grid(self, lattice: Lattice) -> FloatArray:
        return (self.vertices - lattice.origin) / lattice.half_cell


@dataclass(frozen=True, eq=False)
class LevelSetBody:
    """The region of a box with a positive value of a function.

    Fields:
        value: continuous function of points [m] (n, 3), shape (n,), below 0 outside the box; its sign alone is used
        box: two opposite corners [m] (2, 3)
    """

    value: Field
    box: FloatArray

    def signs(self, lattice: Lattice) -> NDArray[np.int8]:
        """As `Body.signs`."""
        sign = np.full(lattice.shape, -1, dtype=np.int8)
        # Two shells of the grid stay outside: no tet may reach past it.
        for first in (2, 3):
            axes = [np.arange(first, count - 2, 2) for count in lattice.shape]
            for plane in axes[0]:
                grid = np.stack(np.meshgrid([plane], axes[1], axes[2], indexing="ij"), axis=-1)
                inside = self.value(lattice.origin + lattice.half_cell * grid.reshape(-1, 3)) > 0
                sign[plane, first:-2:2, first:-2:2] = np.where(inside, 1, -1).reshape(grid.shape[1:3])
        return sign.ravel()

    def fractions(self, step: Int64Array, node: Int64Array, sign: NDArray[np.int8], lattice: Lattice) -> FloatArray:
        """As `Body.fractions`."""
        start = lattice.origin + lattice.half_cell * lattice.coordinates(node)
        return _roots(self.value, start, np.multiply(step, lattice.half_cell, dtype=np.float64), sign[node] > 0)


def stuff(body: Body, lattice: Lattice) -> tuple[FloatArray, Int64Array]:
    """Fill a body with tets: points (n_node, 3) [m] and tets (n_tet, 4) (Labelle and Shewchuk 2007, algorithm 1).

    Args:
        body: inside of a closed surface or level set.
        lattice: around it, from `lattice_around`.
    """
    sign = body.signs(lattice)
    cuts = _edge_cuts(body, lattice, sign)
    limit = np.where(cuts.is_long, ALPHA_LONG, ALPHA_SHORT)
    return fill_background(_background_tets(lattice, sign), cuts, limit, sign, lattice)


def _roots(value: Field, start: FloatArray, span: FloatArray, inside: NDArray[np.bool_]) -> FloatArray:
    """Sign changes t of a function along start + t span, by bisection, shape (n,); `inside` is its sign at t = 0."""
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        same = (value(start + middle[:, None] * span) > 0) == inside
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def fill_background(
    background: Int64Array, cuts: Cuts, limit: FloatArray, sign: NDArray[np.int8], lattice: Lattice
) -> tuple[FloatArray, Int64Array]:
    """Inner part of conforming tets of grid points: points (n_node, 3) [m] and tets (n_tet, 4).

    Args:
        background: the tets, shape (n, 4).
        cuts: of all their edges between inside and outside.
        limit: nodes move onto the surface within this share of a cut edge, shape (n_cut,).
        sign: of the grid points; 0 afterwards at moved nodes.
        lattice: the grid.
    """
    cuts, warped_to = _warp(cuts, sign, lattice, limit)
    background = background[(sign[background] > 0).any(axis=1)]
    return _compressed(_stencils(background, sign, cuts, lattice), warped_to, cuts, lattice)


def _edge_cuts(body: Body, lattice: Lattice, sign: NDArray[np.int8]) -> Cuts:
    """Cuts of all lattice edges between inside and outside."""
    cuts = []
    for step in np.concatenate([AXES, DIAGONALS]):
        node = _changing_edges(step, sign, lattice)
        cuts.append((node, node + (step * lattice.strides).sum(), body.fractions(step, node, sign, lattice)))
    node, other, fraction = (np.concatenate(column) for column in zip(*cuts, strict=True))
    order = np.lexsort([other, node])
    is_long = (lattice.coordinates(node) % 2 == lattice.coordinates(other) % 2).all(axis=1)
    return Cuts(node[order], other[order], fraction[order], is_long[order])


def _changing_edges(step: Int64Array, sign: NDArray[np.int8], lattice: Lattice) -> Int64Array:
    """First nodes of the edges along `step` whose ends differ in sign, shape (n,)."""
    grid = sign.reshape(lattice.shape)
    # One margin for all directions: the sign is -1 in the outer cells, which may be left out.
    inner = tuple(slice(2, n - 2) for n in lattice.shape)
    ahead = tuple(slice(2 + s, n - 2 + s) for s, n in zip(step, lattice.shape, strict=True))
    i, j, k = (index + 2 for index in np.nonzero(grid[inner] != grid[ahead]))
    is_node = (i % 2 == j % 2) & (j % 2 == k % 2)
    return np.ravel_multi_index((i[is_node], j[is_node], k[is_node]), lattice.shape).astype(np.int64)


def _warp(
    cuts: Cuts, sign: NDArray[np.int8], lattice: Lattice, limit: FloatArray
) -> tuple[Cuts, dict[int, FloatArray]]:
    """Move nodes onto cuts within `limit`, a share of the edge, nearest first; they get sign 0 and lose other cuts.

    Returns the remaining cuts and the grid coordinates of each moved node.
    """
    nearer_node = cuts.fraction < 0.5
    share = np.where(nearer_node, cuts.fraction, 1 - cuts.fraction)
    span = lattice.coordinates(cuts.other) - lattice.coordinates(cuts.node)
    distance = share * np.sqrt((span * span).sum(axis=1))
    violating = np.flatnonzero(share < limit)
    violating = violating[np.argsort(distance[violating], kind="stable")]
    near = np.where(nearer_node, cuts.node, cuts.other)[violating].tolist()
    far = np.where(nearer_node, cuts.other, cuts.node)[violating].tolist()
    places = _cut_places(cuts, lattice)
    warped_to: dict[int, FloatArray] = {}
    # One after the other: a moved node removes the cuts of its edges, which its neighbours then do not have.
    for cut, node, neighbour in zip(violating.tolist(), near, far, strict=True):
        if node not in warped_to and neighbour not in warped_to:
            warped_to[node] = places[cut]
    sign[list(warped_to)] = 0
    kept = (sign[cuts.node] != 0) & (sign[cuts.other] != 0)
    return Cuts(cuts.node[kept], cuts.other[kept], cuts.fraction[kept], cuts.is_long[kept]), warped_to


def _cut_places(cuts: Cuts, lattice: Lattice) -> FloatArray:
    """Grid coordinates of the cuts, shape (n_cut, 3)."""
    start, end = lattice.coordinates(cuts.node), lattice.coordinates(cuts.other)
    return start + cuts.fraction[:, None] * (end - start)


def _background_tets(lattice: Lattice, sign: NDArray[np.int8]) -> Int64Array:
    """Lattice tets with a node inside, shape (n, 4): two cube centres, then two corners of the face between them."""
    odd = [np.arange(1, n - 2, 2) for n in lattice.shape]
    centre = np.ravel_multi_index(np.meshgrid(*odd, indexing="ij"), lattice.shape).ravel().astype(np.int64)
    tets = []
    for axis in range(3):
        step = lattice.strides[axis]
        side, up = (lattice.strides[(axis + turn) % 3] for turn in (1, 2))
        ring = [step - side - up, step + side - up, step + side + up, step - side + up]
        for corner in range(4):
            offsets = np.array([0, 2 * step, ring[corner], ring[(corner + 1) % 4]])
            inside = np.zeros(len(centre), dtype=bool)
            for offset in offsets:
                inside |= sign[centre + offset] > 0
            tets.append(centre[inside][:, None] + offsets)
    return np.concatenate(tets)


def _prism_table() -> dict[tuple[bool, bool, bool], list[tuple[int, int, int, int]]]:
    """Tets of the prism 0 1 2 - 3 4 5 for each choice of diagonals (edge 01 is cut from 0 to 4, 12 from 1, 20 from 2).

    A split into three tets orders the columns; each diagonal runs from the bottom of the earlier to the top of the
    later column. The two cyclic choices admit no split.
    """
    table = {}
    for i, j, k in permutations(range(3)):
        place = {column: rank for rank, column in enumerate((i, j, k))}
        choice = (place[0] < place[1], place[1] < place[2], place[2] < place[0])
        table[choice] = [(i, j, k, k + 3), (i, j, j + 3, k + 3), (i, i + 3, j + 3, k + 3)]
    return table


_PRISM_TETS = _prism_table()


def _stencils(background: Int64Array, sign: NDArray[np.int8], cuts: Cuts, lattice: Lattice) -> Int64Array:
    """Inner part of each lattice tet, as tets of nodes and (n_grid + cut index), shape (n_tet, 4)."""
    side = sign[background]
    # Inside nodes first, then those on the surface, then those outside: the cases below need no permutations.
    order = np.argsort(-side, axis=1, kind="stable")
    corners = np.take_along_axis(background, order, axis=1)
    inside, outside = (side > 0).sum(axis=1), (side < 0).sum(axis=1)
    cut_keys = cuts.node * sign.size + cuts.other

    def cut(a: Int64Array, b: Int64Array) -> Int64Array:
        return sign.size + np.searchsorted(cut_keys, np.minimum(a, b) * sign.size + np.maximum(a, b))

    whole = corners[outside == 0]
    tips = corners[(inside == 1) & (outside > 0)]
    ends = tips[:, 1:]
    tips[:, 1:] = np.where(sign[ends] == 0, ends, cut(tips[:, :1], ends))
    a, b, zero, out = corners[(inside == 2) & (outside == 1)].T
    from_a = _diagonal_from_first(a, b, out, lattice)
    first, second = np.where(from_a, a, b), np.where(from_a, b, a)
    far = cut(second, out)
    pyramids = [np.column_stack([first, second, far, zero]), np.column_stack([first, far, cut(first, out), zero])]
    a, b, c, out = corners[inside == 3][outside[inside == 3] == 1].T
    choice = [_diagonal_from_first(p, q, out, lattice) for p, q in ((a, b), (b, c), (c, a))]
    capped = _prisms(np.column_stack([a, b, c, cut(a, out), cut(b, out), cut(c, out)]), np.column_stack(choice))
    a, b, c, d = corners[(inside == 2) & (outside == 2)].T
    from_a = _diagonal_from_first(a, b, c, lattice)
    to_a = ~_diagonal_from_first(a, b, d, lattice)
    # The third quad lies on the surface and is free, unless the other two diagonals turn the same way.
    choice = [from_a, np.where(from_a == to_a, ~from_a, True), to_a]
    wedges = _prisms(np.column_stack([a, cut(a, c), cut(a, d), b, cut(b, c), cut(b, d)]), np.column_stack(choice))
    return np.concatenate([whole, tips, *pyramids, capped, wedges])


def _prisms(corners: Int64Array, choice: NDArray[np.bool_]) -> Int64Array:
    """Tets of prisms, three each, from corners (n, 6) and diagonal choices (n, 3)."""
    parts = [np.empty((0, 4), dtype=np.int64)]
    for key, tets in _PRISM_TETS.items():
        chosen = corners[(choice == key).all(axis=1)]
        parts.extend(chosen[:, tet] for tet in tets)
    return np.concatenate(parts)


def _diagonal_from_first(a: Int64Array, b: Int64Array, out: Int64Array, lattice: Lattice) -> NDArray[np.bool_]:
    """True if the quad left of triangle (a, b inside; out) is cut from a to the cut of b-out, False from b; shape (n,).

    Both tets at a face must agree, so the rule knows the face alone (Labelle and Shewchuk 2007, section 3): the
    diagonal ends at the cut of the longer edge; of two equally long ones, it starts at the node that exceeds the
    cut in an even number of coordinates; if both do (in graded lattices alone), at the lower node. A node has
    three equally long edges in half pyramids alone, where these rules do not turn in a circle either.
    """
    from_a, from_b = (lattice.coordinates(nodes) - lattice.coordinates(out) for nodes in (a, b))
    longer = (from_b * from_b).sum(axis=1) - (from_a * from_a).sum(axis=1)
    even_a, even_b = ((steps > 0).sum(axis=1) % 2 == 0 for steps in (from_a, from_b))
    return np.where(longer != 0, longer > 0, np.where(even_a != even_b, even_a, a < b))


def _compressed(
    tets: Int64Array, warped_to: dict[int, FloatArray], cuts: Cuts, lattice: Lattice
) -> tuple[FloatArray, Int64Array]:
    """Points [m] of the used nodes and cuts, in that order, and the tets, numbered from 0."""
    used, renumbered = np.unique(tets, return_inverse=True)
    grid_size = int(np.prod(lattice.shape))
    nodes, used_cuts = used[used < grid_size], used[used >= grid_size] - grid_size
    places = lattice.coordinates(nodes).astype(np.float64)
    for index in np.flatnonzero(np.isin(nodes, np.array(list(warped_to), dtype=np.int64))).tolist():
        places[index] = warped_to[int(nodes[index])]
    places = np.concatenate([places, _cut_places(cuts, lattice)[used_cuts]])
    return lattice.origin + lattice.half_cell * places, renumbered.reshape(-1, 4).astype(np.int64)
