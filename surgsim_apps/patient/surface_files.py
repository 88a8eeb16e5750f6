"""Surfaces of an organ and its regions from STL, OBJ and PLY files, and the voxels inside them."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msdm_core.errors import MeshError
from msdm_core.mesh import FloatArray, check_surface, line_hits, merge_vertices, surface_volume
from msdm_core.mesh_files import LengthUnit, metres_per_unit
from surgsim_apps.patient.materials import check_name, is_lesion

Triangles = NDArray[np.int64]
# Voxels along one cell when a surface is rebuilt.
MENDING_VOXELS = 6
# Shift of the grid [voxels], so that no line runs through a vertex or along an edge of an aligned surface.
SHIFT = 1e-6 * np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])


@dataclass(frozen=True, eq=False)
class ClosedSurface:
    """Closed surface: vertices [m] (n_vertex, 3), outward triangles (n_triangle, 3), and its region's name."""

    name: str
    vertices: FloatArray
    triangles: Triangles

    @property
    def volume(self) -> float:
        """Enclosed volume [m^3]."""
        return surface_volume(self.vertices, self.triangles)


@dataclass(frozen=True, eq=False)
class BrokenSurface:
    """Surface without a body until it is rebuilt (`--mend`): vertices [m], triangles and its fault."""

    name: str
    vertices: FloatArray
    triangles: Triangles
    fault: str


def region_name(file: Path) -> str:
    """Name of a region: the file's name without extensions, with underscores for characters outside names."""
    stem = re.sub(r"(\.seg)?\.(nii\.gz|[^.]*)$", "", file.name, flags=re.IGNORECASE)
    kept = re.sub(r"[^A-Za-z0-9_ .-]", "_", stem)[:40]
    return check_name(kept.strip(" .-") or "organ", str(file))


def read_organ_surface(file: Path, length_unit: LengthUnit, *, mend: bool) -> ClosedSurface | BrokenSurface:
    """Largest body of a surface file.

    Warns:
        UserWarning: bodies that are left out, and the warnings of `read_surface`.

    Raises:
        MeshError: a surface that is open, crosses itself or is no manifold, unless `mend` is set.
    """
    from msdm_core.mesh_files import read_surface

    vertices, triangles = read_surface(file, length_unit=length_unit)
    bodies, name = bodies_of(vertices, triangles.astype(np.int64)), region_name(file)
    try:
        closed = ClosedSurface(name, *check_surface(*bodies[0]))
    except MeshError as error:
        if not mend:
            raise MeshError(f"{file}: {error}; or --mend rebuilds it from voxels") from None
        return BrokenSurface(name, *merge_vertices(vertices, triangles), fault=str(error))
    if len(bodies) > 1:
        warnings.warn(_left_out(file, bodies, metres_per_unit(length_unit)), stacklevel=2)
    return closed


def _left_out(file: Path, bodies: Sequence[tuple[FloatArray, Triangles]], metres: float) -> str:
    """Note on the bodies beside the first: names in the file, inside or outside of it, volumes."""
    import trimesh

    split: dict[str, Any] = {"split_objects": True, "split_groups": True}
    solids = trimesh.load_scene(file, process=False, skip_materials=True, **split).geometry

    def name(place: FloatArray) -> str:
        distances = {solid: np.abs(mesh.vertices * metres - place).sum(axis=1).min() for solid, mesh in solids.items()}
        return repr(min(distances, key=distances.__getitem__)) if len(distances) > 1 else "nameless"

    shown = [
        f"{name(body[0][0])}, {'inside' if _is_inside(body[0][0], *bodies[0]) else 'outside'} it, "
        f"{abs(surface_volume(*body)) * 1e6:.3g} ml"
        for body in bodies[1:6]
    ]
    return (
        f"{file.name}: {len(bodies) - 1} surface(s) beside the largest ({name(bodies[0][0][0])}) were left out: "
        f"{'; '.join(shown)}{'; ...' if len(bodies) > 6 else ''}; to make one a region, save it alone, named after the "
        f"region, and give both: surgsim organ {file.name} NAME{file.suffix}"
    )


def _is_inside(point: FloatArray, vertices: FloatArray, triangles: Triangles) -> bool:
    """True for a point (3,) inside a closed surface, by the crossings of a line along z."""
    apart = vertices - point
    # Of the lines at even coordinates only that through the point is near.
    u, v, w = (apart / np.abs(apart).max() + SHIFT).T
    return bool(np.count_nonzero(line_hits(u, v, w, triangles, 0)[2] > 0) % 2)


def read_region_surfaces(file: Path, length_unit: LengthUnit, name: str) -> list[ClosedSurface]:
    """Closed surfaces of a region, largest first; several of a lesion are numbered.

    Raises:
        MeshError: a surface that is not closed, or several bodies of a region that is no lesion.
    """
    from msdm_core.mesh_files import read_surface

    vertices, triangles = read_surface(file, length_unit=length_unit)
    bodies = bodies_of(vertices, triangles.astype(np.int64))
    if len(bodies) > 1 and not is_lesion(name):
        raise MeshError(f"{file}: region {name!r} has {len(bodies)} surfaces, and one is taken: give a file for each")
    surfaces = []
    for number, body in enumerate(bodies, start=1):
        try:
            closed = check_surface(*body)
        except MeshError as error:
            raise MeshError(f"{file}: {error}") from None
        surfaces.append(ClosedSurface(name if len(bodies) == 1 else f"{name} {number}", *closed))
    return surfaces


def mended_voxels(surface: BrokenSurface, cell_size: float) -> tuple[NDArray[np.uint8], FloatArray, FloatArray, str]:
    """Broken surface rebuilt from voxels.

    Returns:
        Voxels, 1 inside and 0 outside (n_x, n_y, n_z); their spacing (3,) [m]; the first centre (3,) [m]; a note.

    Raises:
        MeshError: nothing in it is enclosed.
    """
    step = cell_size / MENDING_VOXELS
    inside, first = voxels_inside(surface.vertices, surface.triangles, step, vote=True)
    filled = ndimage.binary_fill_holes(inside)
    assert filled is not None
    if not filled.any():
        raise MeshError(
            f"{surface.name}: encloses nothing, also when mended ({surface.fault}): repair it in a mesh editor"
        )
    note = f"mended: {surface.name} was rebuilt from voxels of {step * 1e3:.3g} mm, for {surface.fault}"
    start = np.asarray(first * step, dtype=np.float64)
    return filled.astype(np.uint8), np.full(3, step), start, note


def bodies_of(vertices: FloatArray, triangles: Triangles) -> list[tuple[FloatArray, Triangles]]:
    """Connected parts of a surface, largest first."""
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    graph = coo_array((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    count, part = connected_components(graph, directed=False)
    if count == 1:
        return [(vertices, triangles)]
    owner = part[triangles[:, 0]]
    bodies = [merge_vertices(vertices, triangles[owner == body]) for body in np.unique(owner)]
    return sorted(bodies, key=lambda body: -abs(surface_volume(*body)))


def voxels_inside(
    vertices: FloatArray, triangles: NDArray[np.int64], step: float, *, vote: bool = False
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Voxels with centres inside (n_x, n_y, n_z), and the grid index of the first (3,); centres are index * step.

    Args:
        vertices: [m], shape (n_vertex, 3).
        triangles: shape (n_triangle, 3).
        step: edge of the voxels [m].
        vote: for surfaces with holes or self-intersections: majority of the lines along x, y and z through a voxel,
            counting lines with as many exits as entries. Otherwise lines along x alone decide.
    """
    first = np.floor(vertices.min(axis=0) / step).astype(np.int64) - 1
    shape = np.ceil(vertices.max(axis=0) / step).astype(np.int64) + 2 - first
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
    """Entries minus exits of lines along an axis up to each voxel; true for lines that end outside (broadcastable)."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    a, b, c = (places[corner] for corner in triangles.T)
    leaving = np.cross(b - a, c - a)[:, axis] > 0
    crossed = np.zeros((shape[axis], shape[u], shape[v]), dtype=np.int16)
    for chosen, change in ((leaving, -1), (~leaving, 1)):
        if not chosen.any():
            continue
        # line_hits traces the lines at even coordinates only.
        row, column, at = line_hits(2.0 * places[:, u], 2.0 * places[:, v], places[:, axis], triangles[chosen], 0)
        np.add.at(crossed, (np.ceil(at).astype(np.int64), row // 2, column // 2), change)
    winding = np.cumsum(crossed, axis=0, dtype=np.int16)
    closed = np.broadcast_to(winding[-1:] == 0, winding.shape)
    # (axis, u, v) is a cyclic permutation of (x, y, z).
    back = [(0 - axis) % 3, (1 - axis) % 3, (2 - axis) % 3]
    return winding.transpose(back), closed.transpose(back)
