"""Meshes whose faces follow the surfaces of an organ and its regions, by fTetWild (Hu et al. 2020; extra `tetwild`)."""

import contextlib
import tempfile
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.surface import check_surface
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import largest_body_mesh
from msdm_core.meshing.region_tags import voxels_at
from msdm_core.meshing.segmentation_meshing import SmoothedShare, smoothed_share
from surgsim_env.patient.label_cleaning import CleanLabels
from surgsim_env.patient.label_source import CONVENTION
from surgsim_env.patient.patient_mesh import PatientMesh, region_volumes
from surgsim_env.patient.surface_files import ClosedSurface, bodies_of
from surgsim_env.patient.voxels import voxels_inside

# Ratio of fTetWild's target edge to the lattice's cell that gives about as many tets.
EDGE_PER_CELL = 0.9
# Largest distance of its surface from the given one over the bounding box's diagonal: fTetWild's default.
EPSILON = 1e-3
# Voxels along a region's longest extent, by which its tets are found.
REGION_VOXELS = 160


def tetwild_mesh(surfaces: Sequence[ClosedSurface], cell_size: float) -> TetMesh:
    """Tets inside the first surface, which encloses the others; these are regions, tagged from 2 in their order.

    fTetWild is not deterministic: the same surfaces give a different mesh each time.

    Raises:
        MeshError: fTetWild is not installed, or makes no tets.
    """
    try:
        import pytetwild  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MeshError(f"--mesher tetwild needs pytetwild ({error}): pip install 'surgsim[tetwild]'") from None
    starts = np.cumsum([0, *(len(one.vertices) for one in surfaces)])
    vertices = np.concatenate([one.vertices for one in surfaces])
    triangles = np.concatenate([one.triangles + start for one, start in zip(surfaces, starts, strict=False)])
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    share = EDGE_PER_CELL * cell_size / diagonal
    # fTetWild leaves a file, __tracked_surface.stl, in the current folder.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        nodes, tets = pytetwild.tetrahedralize(
            vertices, triangles.astype(np.int32), edge_length_fac=share, epsilon=EPSILON, optimize=True, quiet=True
        )[:2]
    if not len(tets):
        raise MeshError(f"fTetWild made no tets of {surfaces[0].name}; use --mesher lattice")
    nodes, tets = np.asarray(nodes, dtype=np.float64), np.asarray(tets, dtype=np.int64)
    body = largest_body_mesh(nodes, tets, f"a cell_size below {cell_size:g} m")
    tags = np.ones(body.tet_count, dtype=np.int32)
    middles = body.points[body.tets].mean(axis=1)
    for tag, one in enumerate(surfaces[1:], start=2):
        tags[_inside(one, middles)] = tag
        if not (tags == tag).any():
            raise MeshError(f"region {one.name!r} holds no tet: use smaller cells, or leave it out")
    return TetMesh(body.points, body.tets, tags, tuple((n, one.name) for n, one in enumerate(surfaces, start=1)))


def mesh_labels_conforming(labels: CleanLabels, source: str, cell_size: float) -> PatientMesh:
    """Mesh an image's labels: level sets of the smoothed labels are the surfaces that fTetWild fills."""
    image = labels.image
    volumes = {tag: float(np.count_nonzero(labels.tags == tag)) * image.voxel_volume for tag in _tags(labels)}
    whole = sum(volumes.values())
    organ = _smoothed(labels, 1, cell_size)
    surfaces = [
        ClosedSurface(labels.names[0], *_level_surface(organ, whole)),
        *(
            ClosedSurface(labels.names[tag - 1], *_level_surface(_smoothed(labels, tag, cell_size), volumes[tag]))
            for tag in _tags(labels)[1:]
        ),
    ]
    placed = tetwild_mesh(surfaces, cell_size)
    mesh = TetMesh(image.geometry.places(placed.points), placed.tets, placed.region, placed.region_names)
    return PatientMesh(
        mesh=mesh,
        lesions=labels.lesions,
        volumes=region_volumes(mesh, labels.names, whole, volumes),
        cell_size=cell_size,
        mesher="tetwild",
        convention=CONVENTION,
        sources=(source,),
        notes=(*image.notes, *labels.notes),
        is_scan=True,
        smoothing=organ.smoothing,
        smoothing_change=organ.volume_above(0.5) / whole - 1.0,
    )


def _tags(labels: CleanLabels) -> list[int]:
    return list(range(1, len(labels.names) + 1))


def _smoothed(labels: CleanLabels, tag: int, cell_size: float) -> SmoothedShare:
    """A smoothed label; for tag 1 the whole organ."""
    mask = labels.tags > 0 if tag == 1 else labels.tags == tag
    return smoothed_share(mask, np.zeros(3, dtype=np.int64), labels.image.geometry.spacing, cell_size)


def _level_surface(field: SmoothedShare, volume: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """The largest closed level set of a smoothed label, at the level that encloses a volume [m^3]."""
    try:
        from skimage.measure import marching_cubes  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MeshError("--mesher tetwild of labels needs scikit-image: pip install 'surgsim[tetwild]'") from None
    vertices, faces = marching_cubes(field.values, field.level_of(volume))[:2]
    points = field.start + np.asarray(vertices, dtype=np.float64) * field.step
    return check_surface(*bodies_of(points, np.asarray(faces, dtype=np.int64))[0])


def _inside(surface: ClosedSurface, places: FloatArray) -> NDArray[np.bool_]:
    step = float(np.ptp(surface.vertices, axis=0).max()) / REGION_VOXELS
    inside, first = voxels_inside(surface.vertices, surface.triangles, step)
    return voxels_at(places, inside, first, np.full(3, step))
