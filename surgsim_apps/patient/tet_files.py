"""Patient's organ from a file of tets: the tets as they are, or their surfaces, to be filled anew."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh import (
    FloatArray,
    IntArray,
    TetMesh,
    check_surface,
    connected_tets,
    in_sweep_order,
    merge_vertices,
    outer_faces,
    outward_facing,
    surface_cell,
    used_nodes,
)
from msdm_core.mesh_files import LengthUnit
from surgsim_apps.patient.label_image import LabelName
from surgsim_apps.patient.materials import is_lesion
from surgsim_apps.patient.meshers import FILE_CONVENTION, PatientMesh, PatientSurfaces, region_volumes
from surgsim_apps.patient.surface_files import ClosedSurface, Triangles, bodies_of, region_name
from surgsim_env.scene import Vector


@dataclass(frozen=True, eq=False)
class PatientTets:
    """Tets of an organ with named regions.

    Fields:
        mesh: tags from 1 on, the organ's own first, all of them named; in metres
        source: name of the file
    """

    mesh: TetMesh
    source: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the regions, the organ's own first."""
        return tuple(name for _, name in self.mesh.region_names)

    @property
    def volume(self) -> float:
        """Volume of the whole organ [m^3]."""
        return float(self.mesh.volumes.sum())

    def face_cell(self, approach: Vector, face_angle_deg: float) -> float:
        """Edge of cubic cells with tets as large as at the face towards a direction [m]."""
        triangles = self.mesh.boundary_triangles
        facing = outward_facing(self.mesh.points, triangles, approach, face_angle_deg)
        if not facing.any():
            raise MeshError(f"{self.source}: no part of its surface faces the approach {approach}: give another")
        return surface_cell(self.mesh, triangles[facing])


def read_tets(
    file: Path, length_unit: LengthUnit | None, labels: Sequence[LabelName], cell_data: str | None = None
) -> PatientTets:
    """Tets of a file, with names for their regions; nameless tets around them, and those of tag 0, are left out.

    Args:
        file: vtu, vtk, msh or mesh.
        length_unit: may be left out for files that state it.
        labels: names of the tags, the organ's first. Without them the file's names are taken, the largest region being
            the organ; a single region is named after the file.
        cell_data: name of the array with the tags, as in `read_mesh`.

    Raises:
        MeshError: a file that is no organ, tags without names inside of the named ones, names without tets.

    Warns:
        UserWarning: tags that are left out, and the warnings of `read_mesh`.
    """
    from msdm_core.mesh_files import read_mesh

    mesh = read_mesh(file, length_unit=length_unit, cell_data=cell_data)
    present = np.unique(mesh.region).tolist()
    named: dict[int | str, str] = (
        dict(mesh.region_names) if not labels else {label.value: label.name for label in labels}
    )
    if len(present) == 1 and not labels:
        named = {present[0]: named.get(present[0], region_name(file))}
    known = ", ".join(map(str, present))
    absent = [f"{name}={tag}" for tag, name in named.items() if tag not in present]
    if absent and labels:
        raise MeshError(f"{file}: --labels {','.join(absent)}: no tet has this tag; the tags are {known}")
    order = [tag for tag in named if tag in present]
    if not labels:
        order.sort(key=lambda tag: -float(mesh.volumes[mesh.region == tag].sum()))
    tags = np.zeros(mesh.tet_count, dtype=np.int32)
    for number, tag in enumerate(order, start=1):
        tags[mesh.region == tag] = number
    nameless = [tag for tag in _enclosed(mesh, tags == 0) if tag] if order else [tag for tag in present if tag]
    if nameless:
        raise MeshError(
            f"{file}: the tags {', '.join(map(str, nameless))} of {known} have no name: give --labels NAME=TAG,... "
            "with the organ first, such as liver=1,lesion=2; tags around the named ones need none"
        )
    outside = [tag for tag in present if tag not in order]
    if outside:
        sizes = [f"{tag} ({mesh.volumes[mesh.region == tag].sum() * 1e6:.4g} ml)" for tag in outside]
        warnings.warn(f"{file}: tets of tag {', '.join(sizes)} have no name and are left out as outside", stacklevel=2)
    names = tuple((number, named[tag]) for number, tag in enumerate(order, start=1))
    try:
        kept = TetMesh(*used_nodes(mesh.points, mesh.tets[tags > 0]), tags[tags > 0], names)
    except MeshError as error:
        raise MeshError(f"{file}, without the tets outside: {error}") from None
    return PatientTets(in_sweep_order(kept), file.name)


def _enclosed(mesh: TetMesh, chosen: NDArray[np.bool_]) -> list[int]:
    """Tags of chosen tets (n_tet,) in parts away from the surface of the mesh."""
    if not chosen.any():
        return []
    _, part = connected_tets(mesh.tets[chosen])
    reaching = part[np.isin(np.flatnonzero(chosen), mesh.boundary_tets)]
    return np.unique(mesh.region[chosen][~np.isin(part, reaching)]).tolist()


def patient_of_tets(tets: PatientTets, cell_size: float) -> PatientMesh:
    """Organ with the tets of a file, with cells of a size at the pressed face [m]."""
    mesh, names = tets.mesh, tets.names
    volumes = {tag: float(mesh.volumes[mesh.region == tag].sum()) for tag, _ in mesh.region_names}
    return PatientMesh(
        mesh=mesh,
        lesions=tuple(name for name in names[1:] if is_lesion(name)),
        volumes=region_volumes(mesh, names, tets.volume, volumes),
        cell_size=cell_size,
        coarsening=1,
        mesher="the file's tets",
        convention=FILE_CONVENTION,
        sources=(tets.source,),
        notes=(),
        is_scan=False,
    )


def surfaces_of_tets(tets: PatientTets) -> PatientSurfaces:
    """Surfaces of the organ and of its regions, to be filled with tets anew.

    Raises:
        MeshError: a region whose tets enclose no single body each, such as tets that share an edge alone.
    """
    mesh, names = tets.mesh, tets.names
    organ = ClosedSurface(names[0], *_closed(mesh.points, mesh.boundary_triangles, f"{tets.source}: {names[0]}"))
    inner = []
    for tag, name in mesh.region_names[1:]:
        bodies = bodies_of(mesh.points, outer_faces(mesh.tets[mesh.region == tag])[0].astype(np.int64))
        for number, body in enumerate(bodies, start=1):
            numbered = name if len(bodies) == 1 else f"{name} {number}"
            inner.append(ClosedSurface(numbered, *_closed(*body, f"{tets.source}: {numbered}")))
    return PatientSurfaces(organ, tuple(inner), (tets.source,))


def _closed(points: FloatArray, triangles: IntArray | Triangles, name: str) -> tuple[FloatArray, Triangles]:
    try:
        return check_surface(*merge_vertices(points, triangles))
    except MeshError as error:
        raise MeshError(f"{name}: {error}; leave --remesh out to keep its tets") from None
