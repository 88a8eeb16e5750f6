"""Fine surface of an organ for pictures, from labels or a surface file."""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import cos, dot, matmul, norm
from msdm_core.mesh import FloatArray, TetMesh, find_carriers, merge_vertices, surface_volume
from msdm_core.meshing import SmoothedShare
from surgsim_apps.patient.surface_files import Triangles, bodies_of
from surgsim_env.rendering import BEND, smooth_normals
from surgsim_env.scene import FineSurface, MeshSource, TetFile

# Most triangles: 240 kB for each picture of a page in the browser.
TRIANGLES_MOST = 40_000
# Longest edge over that of the smallest cells: as with the smoothed boundary of a mesh.
EDGE_PER_CELL = 0.5
# Vertices with a triangle turned by more than 30 degrees from their normal stay sharp.
CREASE_COSINE = cos(np.radians(30.0))
# Growth of a grid, or of the longest edge, from one try to the next.
GROWTH = 1.1
# Area of a triangle over its edge squared.
EQUILATERAL = np.sqrt(3.0) / 4.0
# Triangles of a surface net per area of a cell's face, about.
TRIANGLES_PER_FACE = 3.0
# Steps of Newton's method from a net's vertices to the level.
NEWTON_STEPS = 3
CORNERS = np.array(list(product((0, 1), repeat=3)))
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """Fine surface carried by a mesh.

    Fields:
        vertices: [m]                                                               (n_vertex, 3)
        triangles: outward                                                          (n_triangle, 3)
        apart: largest distance of a vertex from the tets' boundary [m]
        moved: number of vertices too far from it to be carried, moved onto it
    """

    vertices: FloatArray
    triangles: Triangles
    apart: float
    moved: int

    @property
    def text(self) -> str:
        """The surface in words."""
        text = f"{len(self.triangles)} triangles, up to {self.apart * 1e3:.1f} mm from the tets' boundary"
        return text + (f"; {self.moved} vertices that were farther from it lie on it" if self.moved else "")

    def turned(self, origin: FloatArray, frame: FloatArray) -> "SurfaceFit":
        """The surface with each point p at (p - origin) frame, for an origin [m] (3,) and axes as columns (3, 3)."""
        return replace(self, vertices=matmul(self.vertices - origin, frame))

    def write(self, path: Path) -> None:
        """Write it as a PLY file in metres."""
        import trimesh

        trimesh.Trimesh(self.vertices, self.triangles, process=False).export(path, file_type="ply")


def surface_file(mesh_file: Path) -> Path:
    """Path of an organ's fine surface, beside the file of its mesh."""
    return mesh_file.with_name(f"{mesh_file.stem}_surface.ply")


def mesh_source(mesh_file: Path, surface: SurfaceFit | None) -> MeshSource:
    """A scene's source of the tets in a file beside it, with their fine surface, if any."""
    fine = None if surface is None else FineSurface(surface_file(mesh_file).name, "m")
    return MeshSource(tets=TetFile(mesh_file.name, "m"), fine_surface=fine)


def fitted_surface(
    vertices: FloatArray, triangles: Triangles, mesh: TetMesh, cell_size: float, triangles_most: int = TRIANGLES_MOST
) -> SurfaceFit:
    """Closed surface with edges of at most EDGE_PER_CELL, for dents to show, and a largest number of triangles.

    Parts thinner than a cell have no tets: vertices too far from the mesh's boundary to be carried move to its nearest
    point, and are counted.

    Args:
        vertices: of the organ's surface [m], (n_vertex, 3).
        triangles: outward, (n_triangle, 3).
        mesh: in the same axes.
        cell_size: edge of the smallest cells [m].
        triangles_most: largest number of triangles.
    """
    vertices, triangles = fewer_triangles(vertices, triangles, triangles_most)
    # Shorter edges would make too many triangles in any case.
    longest = max(
        EDGE_PER_CELL * cell_size, float(np.sqrt(surface_area(vertices, triangles) / (EQUILATERAL * triangles_most)))
    )
    finer = split_edges(vertices, triangles, longest)
    while len(finer[1]) > triangles_most and len(finer[1]) > len(triangles):
        longest *= GROWTH
        finer = split_edges(vertices, triangles, longest)
    vertices, triangles = finer
    carriers = find_carriers(vertices, mesh)
    placed = np.where(carriers.beyond[:, None], carriers.nearest, vertices)
    distance = carriers.distance[~carriers.beyond]
    return SurfaceFit(placed, triangles, float(distance.max(initial=0.0)), int(carriers.beyond.sum()))


def fewer_triangles(vertices: FloatArray, triangles: Triangles, triangles_most: int) -> tuple[FloatArray, Triangles]:
    """Surface with a largest number of triangles: vertices in a cell of a grid become their mean.

    Rossignac & Borrel 1993, with the finest grid that suffices; a surface with few triangles stays unchanged.
    """
    if len(triangles) <= triangles_most:
        return vertices, triangles
    cell = np.sqrt(TRIANGLES_PER_FACE * surface_area(vertices, triangles) / triangles_most) / GROWTH
    low = vertices.min(axis=0)
    while True:
        place = np.floor((vertices - low) / cell).astype(np.int64)
        _, group = np.unique(place, axis=0, return_inverse=True)
        group = group.ravel()
        kept = group[triangles]
        whole = (kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])
        # Sheets that fall together cancel in pairs.
        _, first, count = np.unique(np.sort(kept[whole], axis=1), axis=0, return_index=True, return_counts=True)
        kept = kept[whole][np.sort(first[count % 2 == 1])]
        if len(kept) <= triangles_most:
            break
        cell *= GROWTH
    size = np.bincount(group)
    mean = np.column_stack([np.bincount(group, vertices[:, axis]) / size for axis in range(3)])
    return merge_vertices(mean, kept)


def surface_area(vertices: FloatArray, triangles: NDArray[np.integer]) -> float:
    """Area of a surface with vertices [m] (n_vertex, 3) and triangles (n_triangle, 3) [m^2]."""
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(norm(normals, axis=1).sum())


def split_edges(vertices: FloatArray, triangles: Triangles, longest: float) -> tuple[FloatArray, Triangles]:
    """Surface with edges up to a length [m]: longer ones are halved, in both triangles beside them.

    The new vertex lies BEND of the way from the edge to the tangent planes of its ends (Boubekeur & Alexa 2008): flat
    triangles of a smooth scan show no facets. At creases it lies on the edge.
    """
    while True:
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        # A single number sorts faster than two.
        keys, side_edge = np.unique(sides[:, 0] * len(vertices) + sides[:, 1], return_inverse=True)
        edges = np.column_stack([keys // len(vertices), keys % len(vertices)])
        long = norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > longest
        if not long.any():
            return vertices, triangles
        halves = len(vertices) - 1 + np.cumsum(long)
        vertices = np.concatenate([vertices, _halves(vertices, triangles, edges[long])])
        middle = np.where(long, halves, -1)[side_edge].reshape(-1, 3)
        triangles = np.concatenate(list(_parts(triangles, middle)))


def _halves(vertices: FloatArray, triangles: Triangles, edges: Triangles) -> FloatArray:
    """A point for the middle of each edge (n, 2) [m], (n, 3)."""
    normals = smooth_normals(vertices, triangles.astype(np.int32))
    corners = vertices[triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = dot(normals[triangles], facing[:, None])
    turned = along < CREASE_COSINE * norm(facing, axis=1)[:, None]
    smooth = np.ones(len(vertices))
    smooth[triangles[turned]] = 0.0
    ends = vertices[edges]
    middle = ends.mean(axis=1)
    height = dot(middle[:, None] - ends, normals[edges]) * smooth[edges]
    return middle - BEND * 0.5 * (height[:, :, None] * normals[edges]).sum(axis=1)


def _parts(triangles: Triangles, middle: Triangles) -> list[Triangles]:
    """The triangles, divided at the middles (n, 3) of their sides 01, 12, 20; -1 for a side that stays."""
    count = (middle >= 0).sum(axis=1)
    parts = [triangles[count == 0]]
    # Turned until the only halved side, or the only whole one, is the first.
    for halved, odd in ((1, middle >= 0), (2, middle < 0)):
        chosen = count == halved
        turn = (odd[chosen].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(triangles[chosen], turn, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[chosen], turn, axis=1).T
        if halved == 1:
            parts += [np.column_stack([a, ab, c]), np.column_stack([ab, b, c])]
        else:
            parts += [np.column_stack([bc, c, ca]), np.column_stack([a, b, bc]), np.column_stack([a, bc, ca])]
    (a, b, c), (ab, bc, ca) = triangles[count == 3].T, middle[count == 3].T
    for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        parts.append(np.column_stack(corners))
    return parts


def level_surface(
    field: SmoothedShare, volume: float, area: float, triangles_most: int = TRIANGLES_MOST
) -> tuple[FloatArray, Triangles]:
    """Largest level set of a smoothed label that encloses a volume.

    A surface net (Gibson 1998): a vertex in each cell of a grid crossed by the level, a quadrangle across each crossed
    line of the grid; Newton's method then moves the vertices onto the level.

    Args:
        field: the smoothed label.
        volume: to be enclosed [m^3].
        area: of the surface, about [m^2]; the grid's cells follow from it.
        triangles_most: number of triangles for the choice of the cells; the surface may have a few more.

    Returns:
        Vertices [m] (n_vertex, 3) and outward triangles (n_triangle, 3), in the field's axes.
    """
    level = field.level_of(volume)
    # Cells finer than the field's blocks show nothing.
    step = max(float(field.step.min()), float(np.sqrt(TRIANGLES_PER_FACE * area / triangles_most)))
    # Beyond the blocks the field is 0.
    low, extent = field.start - 1.5 * step, np.array(field.values.shape) * field.step + 3.0 * step
    shape = np.ceil(extent / step).astype(np.int64)
    y, z = (np.arange(count) * step for count in shape[1:])
    plane = np.stack(np.meshgrid(y, z, indexing="ij"), axis=-1).reshape(-1, 2)
    values = np.empty(shape, dtype=np.float32)
    for number in range(shape[0]):
        places = low + np.column_stack([np.full(len(plane), number * step), plane])
        values[number] = (field.at(places) - level).reshape(shape[1:])
    vertices, quads = _surface_net(values)
    vertices = low + step * vertices
    for _ in range(NEWTON_STEPS):
        vertices = vertices + _towards_level(field, level, vertices, 0.5 * step)
    body, triangles = bodies_of(vertices, _triangles_of(vertices, quads))[0]
    return body, triangles if surface_volume(body, triangles) > 0.0 else triangles[:, ::-1]


def _surface_net(values: NDArray[np.float32]) -> tuple[FloatArray, Triangles]:
    """Vertices in grid coordinates (n, 3) and quadrangles (m, 4) of the net between positive and other values."""
    inside = values > 0.0
    a, b, c = (side - 1 for side in values.shape)
    count = np.zeros((a, b, c), dtype=np.int8)
    for x, y, z in CORNERS:
        count += inside[x : x + a, y : y + b, z : z + c]
    cells = np.argwhere((count > 0) & (count < 8))
    number = np.full(count.shape, -1, dtype=np.int64)
    number[tuple(cells.T)] = np.arange(len(cells))
    corner = np.stack([values[tuple((cells + offset).T)] for offset in CORNERS], axis=1).astype(np.float64)
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in EDGES:
        crossed = (corner[:, a] > 0.0) != (corner[:, b] > 0.0)
        share = corner[crossed, a] / (corner[crossed, a] - corner[crossed, b])
        total[crossed] += CORNERS[a] + share[:, None] * (CORNERS[b] - CORNERS[a])
        crossings += crossed
    quads = []
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        first, second = np.moveaxis(inside, axis, 0)[:-1], np.moveaxis(inside, axis, 0)[1:]
        lines = np.argwhere(np.moveaxis(first != second, 0, axis))
        # Seen against the axis the four cells around a line run anticlockwise.
        around = [number[tuple((lines - back).T)] for back in (u + v, v, 0 * u, u)]
        quad = np.column_stack(around)
        leaves = inside[tuple(lines.T)]
        quads.append(np.where(leaves[:, None], quad, quad[:, ::-1]))
    return cells + total / crossings[:, None], np.concatenate(quads)


def _towards_level(field: SmoothedShare, level: float, places: FloatArray, step: float) -> FloatArray:
    """Newton's step along the slope to the level, of at most `step` [m], (n, 3)."""
    slope = np.column_stack([(field.at(places + shift) - field.at(places - shift)) for shift in step * np.eye(3)])
    slope /= 2.0 * step
    move = slope * ((level - field.at(places)) / np.maximum((slope * slope).sum(axis=1), 1e-300))[:, None]
    size = norm(move, axis=1, keepdims=True)
    return move * np.minimum(1.0, step / np.maximum(size, 1e-300))


def _triangles_of(vertices: FloatArray, quads: Triangles) -> Triangles:
    """Triangles of quadrangles divided along the shorter diagonal."""
    a, b, c, d = quads.T
    short = norm(vertices[a] - vertices[c], axis=1) <= norm(vertices[b] - vertices[d], axis=1)
    ac, bd = quads[short], quads[~short]
    return np.concatenate([ac[:, [0, 1, 2]], ac[:, [0, 2, 3]], bd[:, [0, 1, 3]], bd[:, [1, 2, 3]]])
