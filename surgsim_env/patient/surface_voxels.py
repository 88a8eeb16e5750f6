"""Which voxels lie inside a surface: exactly for closed ones, by a vote of lines for broken ones."""

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh import FloatArray
from msdm_core.surface import line_hits

VOXELS_MOST = 150_000_000
# Shift of the grid [voxels], so that no line runs through a vertex or along an edge of an aligned surface.
SHIFT = 1e-6 * np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])


def voxels_inside(
    vertices: FloatArray, triangles: NDArray[np.int64], step: float, *, vote: bool = False
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Voxels whose centres lie inside, shape (n_x, n_y, n_z), and the first one's place (3,); centres are place * step.

    Args:
        vertices: [m], shape (n_vertex, 3).
        triangles: shape (n_triangle, 3).
        step: edge of the voxels [m].
        vote: for surfaces with holes or that cross themselves: what most of the three lines through a voxel say, of
            those that leave the body as often as they enter it. Else lines along x alone.
    """
    first = np.floor(vertices.min(axis=0) / step).astype(np.int64) - 1
    shape = np.ceil(vertices.max(axis=0) / step).astype(np.int64) + 2 - first
    if np.prod(shape.astype(np.float64)) > VOXELS_MOST:
        raise MeshError(
            f"the surface's box has {np.prod(shape.astype(np.float64)):.3g} voxels of {step:.3g} m; at most "
            f"{VOXELS_MOST:.3g} are made: use larger cells"
        )
    places = vertices / step - first + SHIFT
    if not vote:
        winding, _ = _winding(places, triangles, 0, shape)
        return winding % 2 == 1, first
    inside, voters = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        winding, closed = _winding(places, triangles, axis, shape)
        inside += (winding != 0) & closed
        voters += closed
    return 2 * inside > voters, first


def _winding(
    places: FloatArray, triangles: NDArray[np.int64], axis: int, shape: NDArray[np.int64]
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """How often lines along an axis have entered less left the body, and whether they end outside (broadcastable)."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    a, b, c = (places[corner] for corner in triangles.T)
    leaving = np.cross(b - a, c - a)[:, axis] > 0
    crossed = np.zeros((shape[axis], shape[u], shape[v]), dtype=np.int16)
    for chosen, change in ((leaving, -1), (~leaving, 1)):
        if not chosen.any():
            continue
        # line_hits takes every second line of its unit.
        row, column, at = line_hits(2.0 * places[:, u], 2.0 * places[:, v], places[:, axis], triangles[chosen], 0)
        np.add.at(crossed, (np.ceil(at).astype(np.int64), row // 2, column // 2), change)
    winding = np.cumsum(crossed, axis=0, dtype=np.int16)
    closed = np.broadcast_to(winding[-1:] == 0, winding.shape)
    # (axis, u, v) is a turn of (x, y, z).
    back = [(0 - axis) % 3, (1 - axis) % 3, (2 - axis) % 3]
    return winding.transpose(back), closed.transpose(back)
