"""Tetrahedral mesh of an organ: points, tets, regions and their incidences."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msdm_core.arithmetic import dot, norm
from msdm_core.errors import MeshError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Int64Array = NDArray[np.int64]

# Vertices of the face opposite each corner of a tet, ordered so that its normal points out of a positive tet.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int32)
TET_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], dtype=np.int32)

# Smallest volume / longest edge^3 of a tet (0.118 in a regular one).
DEGENERATE_VOLUME_RATIO = 1e-6


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A connected body of tetrahedra with positive volumes.

    Tets given inside out are reoriented. Arrays are copied to contiguous native float64 / int32 and made read-only.

    Args:
        points: node positions [m], shape (n_node, 3).
        tets: node indices of each tet, shape (n_tet, 4).
        region: integer tag of each tet, shape (n_tet,); all 0 when left out.
        region_names: (tag, name) pairs.

    Raises:
        MeshError: names the first offending node or tet, its value, the rule and the way out.
    """

    points: FloatArray
    tets: IntArray
    region: IntArray
    region_names: tuple[tuple[int, str], ...]
    # The mesh before it was moved.
    origin: "TetMesh | None" = field(init=False, default=None)
    # The mesh before all its lengths were multiplied by a factor.
    unscaled: "TetMesh | None" = field(init=False, default=None)

    def __init__(
        self,
        points: ArrayLike,
        tets: ArrayLike,
        region: ArrayLike | None = None,
        region_names: tuple[tuple[int, str], ...] | dict[int, str] = (),
    ) -> None:
        point_array = _checked_points(points)
        tet_array = _checked_tets(tets, len(point_array))
        negative = _signed_volumes(point_array, tet_array) < 0.0
        tet_array[negative] = tet_array[negative][:, [0, 1, 3, 2]]
        _check_one_body(tet_array)
        pairs = region_names.items() if isinstance(region_names, dict) else region_names
        object.__setattr__(self, "points", read_only(point_array))
        object.__setattr__(self, "tets", read_only(tet_array))
        object.__setattr__(self, "region", read_only(_checked_region(region, len(tet_array))))
        object.__setattr__(self, "region_names", tuple((int(tag), str(name)) for tag, name in pairs))

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @property
    def tet_count(self) -> int:
        """Number of tets."""
        return len(self.tets)

    def moved(self, points: ArrayLike) -> "TetMesh":
        """The same tets with their nodes at other places [m], (n_node, 3); both have their springs in the same order.

        Raises:
            MeshError: another number of points, or a tet turned inside out or flat; names it.
        """
        array = _checked_points(points)
        if array.shape != self.points.shape:
            raise MeshError(f"{len(array)} points for the {self.node_count} nodes of a mesh: give one for each node")
        inverted = np.flatnonzero(_signed_volumes(array, self.tets) < 0.0)
        if inverted.size:
            raise MeshError(f"tet {inverted[0]} (of {inverted.size}) is inside out after the move: move nodes less")
        other = object.__new__(TetMesh)
        kept = {name: getattr(self, name) for name in ("tets", "region", "region_names", "_edge_table", "_boundary")}
        origin = self if self.origin is None else self.origin
        vars(other).update(points=read_only(array), origin=origin, **kept)
        return other

    def scaled(self, factor: float) -> "TetMesh":
        """The mesh with all lengths times a factor, `moved`; springs fitted to a mesh fit it at every scale.

        Raises:
            MeshError: a factor that is not positive.
        """
        other = self.moved(self.points * factor)
        vars(other)["unscaled"] = self if self.unscaled is None else self.unscaled
        return other

    def region_tag(self, name: str) -> int:
        """Tag of a named region.

        Raises:
            MeshError: no region of that name; lists those of the mesh.
        """
        for tag, known in self.region_names:
            if known == name:
                return tag
        names = ", ".join(known for _, known in self.region_names) or "none"
        raise MeshError(f"region {name!r} is not in the mesh; its named regions: {names}")

    @cached_property
    def volumes(self) -> FloatArray:
        """Volume of each tet [m^3], shape (n_tet,)."""
        return read_only(tet_volumes(self.points, self.tets))

    @cached_property
    def edges(self) -> IntArray:
        """Unique edges, smaller node first, in lexicographic order, shape (n_edge, 2)."""
        return self._edge_table[0]

    @cached_property
    def tet_edges(self) -> IntArray:
        """Edge index of each of the six edges of each tet, in the order of TET_EDGES, shape (n_tet, 6)."""
        return self._edge_table[1]

    @cached_property
    def _edge_table(self) -> tuple[IntArray, IntArray]:
        pairs = np.sort(self.tets[:, TET_EDGES].reshape(-1, 2), axis=1).astype(np.int64)
        keys = pairs[:, 0] * self.node_count + pairs[:, 1]
        unique, inverse = np.unique(keys, return_inverse=True)
        edges = np.column_stack([unique // self.node_count, unique % self.node_count])
        return read_only(edges.astype(np.int32)), read_only(inverse.reshape(-1, 6).astype(np.int32))

    @cached_property
    def boundary_triangles(self) -> IntArray:
        """Triangles of the outer surface, normals outward, shape (n_triangle, 3)."""
        return self._boundary[0]

    @cached_property
    def boundary_tets(self) -> IntArray:
        """The tet behind each boundary triangle, shape (n_triangle,)."""
        return self._boundary[1]

    @cached_property
    def _boundary(self) -> tuple[IntArray, IntArray]:
        faces, tets = outer_faces(self.tets)
        return read_only(faces), read_only(tets)

    @cached_property
    def boundary_nodes(self) -> IntArray:
        """Sorted indices of the nodes on the outer surface, shape (n_boundary_node,)."""
        return read_only(np.unique(self.boundary_triangles).astype(np.int32))

    def __repr__(self) -> str:
        size = np.ptp(self.points, axis=0) * 1000
        return (
            f"TetMesh({self.node_count} nodes, {self.tet_count} tets, "
            f"{size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm, {self.volumes.sum() * 1e6:.4g} ml)"
        )


def tet_volumes(points: FloatArray, tets: NDArray[np.integer]) -> FloatArray:
    """Signed volume of each tet, V = (b - a) . ((c - a) x (d - a)) / 6 [m^3], shape (n_tet,)."""
    a, b, c, d = (points[tets[:, corner]] for corner in range(4))
    return dot(b - a, np.cross(c - a, d - a)) / 6.0


def outer_faces(tets: NDArray[np.integer]) -> tuple[IntArray, IntArray]:
    """Faces of a single tet each, (n, 3), outward for positive tets, and these tets, (n,)."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = np.sort(first[count == 1])
    return faces[outer].astype(np.int32), (outer // 4).astype(np.int32)


def used_nodes(points: FloatArray, tets: NDArray[np.integer]) -> tuple[FloatArray, NDArray[np.integer]]:
    """Points of tets, and the tets renumbered to them."""
    check_indices(tets, len(points), "tet", "nodes")
    used, renumbered = np.unique(tets, return_inverse=True)
    return points[used], renumbered.reshape(-1, 4)


def area_vectors(corners: FloatArray) -> FloatArray:
    """Area vector of each triangle, (b - a) x (c - a) / 2 [m^2], of corners (..., 3, 3) [m], shape (..., 3)."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    return 0.5 * np.cross(b - a, c - a)


def oriented_tets(points: FloatArray, tets: Int64Array) -> Int64Array:
    """Tets with their last two corners exchanged where the volume is negative, shape (n_tet, 4)."""
    return np.where((tet_volumes(points, tets) < 0)[:, None], tets[:, [0, 1, 3, 2]], tets)


def connected_parts(first: NDArray[np.integer], second: NDArray[np.integer], count: int) -> tuple[int, IntArray]:
    """Number of connected parts of `count` items, joined by pairs (first[i], second[i]), and each item's part."""
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)


def connected_tets(tets: NDArray[np.integer]) -> tuple[int, IntArray]:
    """Number of parts connected through faces, and the part of each tet, shape (n_tet,).

    Raises:
        MeshError: a face of more than two tets; names it.
    """
    faces = np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (np.diff(faces[order], axis=0) == 0).all(axis=1)
    crowded = np.flatnonzero(same[1:] & same[:-1])
    if crowded.size:
        tet = int(order[crowded[0]] // 4)
        raise MeshError(
            f"face {faces[order[crowded[0]]].tolist()} of tet {tet} is shared by more than 2 tets: "
            "remove the overlapping ones"
        )
    twins = np.flatnonzero(same)
    return connected_parts(order[twins] // 4, order[twins + 1] // 4, len(tets))


def part_sizes(part: IntArray) -> str:
    """Sizes of the six largest of several parts, for a message."""
    sizes = np.sort(np.bincount(part))[::-1]
    return ", ".join(map(str, sizes[:6])) + (", ..." if len(sizes) > 6 else "")


def read_only(array: NDArray) -> NDArray:
    """The array, made read-only."""
    array.setflags(write=False)
    return array


def protect_arrays(record: object) -> None:
    """Make the arrays of a record read-only, as all users of the process share it."""
    for value in vars(record).values():
        if isinstance(value, np.ndarray):
            read_only(value)


def check_finite(points: FloatArray, noun: str) -> None:
    """Refuse points (n, 3) with a coordinate that is not finite; `noun` names them in the message."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise MeshError(
            f"{noun} {bad[0]} is at {points[bad[0]].tolist()}; every coordinate must be finite: repair the file"
        )


def check_indices(items: NDArray, point_count: int, item_noun: str, point_noun: str) -> None:
    """Refuse items (n, k) with a point index out of range; the nouns name both in the message."""
    outside = np.flatnonzero(((items < 0) | (items >= point_count)).any(axis=1))
    if outside.size:
        raise MeshError(
            f"{item_noun} {outside[0]} uses {point_noun} {items[outside[0]].tolist()}; "
            f"indices must lie in 0..{point_count - 1}"
        )


def _checked_points(points: ArrayLike) -> FloatArray:
    array = np.array(points, dtype=np.float64, order="C")
    check_finite(array, "node")
    order = np.lexsort(array.T)
    twins = np.flatnonzero((np.diff(array[order], axis=0) == 0).all(axis=1))
    if twins.size:
        first, second = sorted((int(order[twins[0]]), int(order[twins[0] + 1])))
        raise MeshError(
            f"nodes {first} and {second} are duplicates at {array[first].tolist()}; "
            "every node needs a place of its own: merge duplicate nodes"
        )
    return array


def _checked_tets(tets: ArrayLike, node_count: int) -> IntArray:
    indices = np.asarray(tets)
    if indices.size == 0:
        raise MeshError("the mesh has no tets; an organ needs at least one: mesh the volume first (mesh_surface)")
    check_indices(indices, node_count, "tet", "nodes")
    array = np.array(indices, dtype=np.int32, order="C")
    unused = np.flatnonzero(np.bincount(array.ravel(), minlength=node_count) == 0)
    if unused.size:
        raise MeshError(
            f"node {unused[0]} (of {unused.size}) belongs to no tet; every node must: drop unused nodes before meshing"
        )
    return array


def _signed_volumes(points: FloatArray, tets: IntArray) -> FloatArray:
    """Volumes of tets, negative for tets inside out [m^3]; refuses flat ones."""
    # The powers of coordinates above 1e100 overflow: such a tet has no ratio and is refused.
    with np.errstate(over="ignore", invalid="ignore"):
        volumes = tet_volumes(points, tets)
        edge_lengths = norm(points[tets[:, TET_EDGES[:, 0]]] - points[tets[:, TET_EDGES[:, 1]]], axis=2)
        longest = edge_lengths.max(axis=1)
        ratios = np.abs(volumes) / (longest * longest * longest)
    flat = np.flatnonzero(~(ratios > DEGENERATE_VOLUME_RATIO))
    if flat.size:
        tet = int(flat[0])
        raise MeshError(
            f"tet {tet} (of {flat.size}) is degenerate: volume / longest edge^3 = {ratios[tet]:.2g}, "
            f"the rule is above {DEGENERATE_VOLUME_RATIO:g}: remesh, for instance with mesh_surface"
        )
    return volumes


def _check_one_body(tets: IntArray) -> None:
    # Springs at a single node or edge resist no bending: parts that meet there alone are joined by hinges.
    count, part = connected_tets(tets)
    if count > 1:
        raise MeshError(
            f"the mesh falls into {count} disconnected parts, which share no face, of {part_sizes(part)} tets; "
            "an organ is one body, and parts that meet in a node or an edge hang on a hinge: remesh, or keep one part"
        )


def _checked_region(region: ArrayLike | None, tet_count: int) -> IntArray:
    if region is None:
        return np.zeros(tet_count, dtype=np.int32)
    array = np.asarray(region)
    if array.shape != (tet_count,):
        raise MeshError(f"region has shape {array.shape}; the rule is one integer tag per tet, ({tet_count},)")
    with np.errstate(invalid="ignore"):
        tags = array.astype(np.int32)
    wrong = np.flatnonzero(tags != array)
    if wrong.size:
        raise MeshError(f"region of tet {wrong[0]} is {array[wrong[0]]}; tags are whole numbers of 32 bits")
    return tags
