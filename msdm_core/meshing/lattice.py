"""The grid of half cells around a closed surface: which points lie inside, and where lines cross the surface.

Lattice coordinates count HALF cells, so that the nodes are the integer points whose coordinates are all even or all
odd. A node's number is its row-major place in the enclosing integer grid.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.surface import line_hits

FloatArray = NDArray[np.float64]
Int64Array = NDArray[np.int64]

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
        """What one step along each axis adds to a node number, shape (3,)."""
        return np.array([self.shape[1] * self.shape[2], self.shape[2], 1], dtype=np.int64)

    def coordinates(self, nodes: Int64Array) -> Int64Array:
        """Grid coordinates of nodes, shape (..., 3)."""
        return np.stack(np.unravel_index(nodes, self.shape), axis=-1)


def lattice_around(vertices: FloatArray, cell_size: float, width: int = 1) -> Lattice:
    """The lattice with cube edge `cell_size` [m] that has a corner node at the middle of the bounding box.

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
    """Fraction of each edge at which the surface crosses it, the middle crossing of several, shape (n,).

    Args:
        step: from node to node, (3,), or (n, 3) for edges of one direction but several lengths; its largest
            component is positive, the others are as large or zero.
        node: first node of each edge, shape (n,).
        grid_vertices: of the surface, in grid coordinates.
        triangles: of the surface.
        lattice: the grid.
    """
    one = np.atleast_2d(step)[0]
    along = int(np.argmax(one))
    across = [axis for axis in range(3) if axis != along]
    length = step[..., along]
    # Coordinates that are constant along the line number it; on a diagonal they can be negative.
    shear = one[across] // one[along]
    reach = 2 * max(lattice.shape)
    nodes = lattice.coordinates(node)
    start = nodes[:, along]
    lines = nodes[:, across] - shear * start[:, None]
    projected = grid_vertices[:, across] - shear * grid_vertices[:, [along]]
    row, column, at = [], [], []
    # Nodes are all even or all odd: so are the lines along an axis, and along a diagonal of the cube all are even.
    for parity in (0,) if shear.all() else (0, 1):
        hits = line_hits(projected[:, 0], projected[:, 1], grid_vertices[:, along], triangles, parity)
        for column_list, values in zip((row, column, at), hits, strict=True):
            column_list.append(values)
    hit_at = np.concatenate(at)
    hit_line = (np.concatenate(row) + reach) * (4 * reach) + np.concatenate(column) + reach
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
