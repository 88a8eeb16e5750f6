"""Approach of a probe to an organ's segmented lesions."""

import numpy as np

from msdm_core.arithmetic import cos, matmul, norm, sin
from msdm_core.material import Lesion, Material, lesion_extent
from msdm_core.mesh import FloatArray, NearestTriangle, node_normals
from surgsim_apps.patient.meshers import PatientMesh
from surgsim_env.scene import Scene, Vector

# Directions spread evenly over the sphere (Fibonacci lattice), 9 degrees apart.
DIRECTIONS = 500
# Margin of a faced lesion to the border of the palpable face [degrees]: no site lies near its rim.
MARGIN_DEG = 15.0
ROUNDING = 1e-9


def facing_approach(patient: PatientMesh, usual: Vector, face_angle_deg: float) -> Vector:
    """Approach of length 1 that faces most segmented lesions, nearest to the usual one.

    A lesion is faced if the inward normal at the surface point nearest to its centre is within the angle of the
    palpable face, less MARGIN_DEG, of the approach.

    Args:
        patient: the organ.
        usual: the approach without lesions, of any length.
        face_angle_deg: of the palpable face [degrees].
    """
    first = np.array(usual) / norm(usual)
    inward = _inward_normals(patient)
    if len(inward) == 0:
        return usual
    least = cos(np.radians(face_angle_deg - MARGIN_DEG)) - ROUNDING
    # A direction between two lesions may face both, unlike any of the lattice.
    between = (inward[:, None] + inward[None]).reshape(-1, 3)
    length = norm(between, axis=1)
    between = between[length > ROUNDING] / length[length > ROUNDING, None]
    candidates = np.concatenate([first[None], between, _sphere()])
    faced = (matmul(candidates, inward.T) >= least).sum(axis=1)
    best = np.flatnonzero(faced == faced.max())
    chosen = candidates[best[int(np.argmax(matmul(candidates[best], first)))]]
    x, y, z = chosen.tolist()
    return x, y, z


def faced_note(patient: PatientMesh, scene: Scene) -> list[str]:
    """A note on lesions not faced by the scene's approach, if any."""
    cosines = matmul(_inward_normals(patient), np.asarray(scene.instrument.approach))
    angle = scene.palpation.face_angle_deg
    hidden = [name for name, cosine in zip(patient.lesions, cosines) if cosine < cos(np.radians(angle))]
    if not hidden:
        return []
    approach = ", ".join(f"{part:.2f}" for part in scene.instrument.approach)
    return [
        f"the approach {approach} does not face {', '.join(hidden)}: the nearest surface is turned away by over "
        f"{angle:g} degrees; it may not be felt (--approach)"
    ]


def _inward_normals(patient: PatientMesh) -> FloatArray:
    """Inward unit normal at the surface point nearest to each lesion's centre (n_lesion, 3)."""
    mesh = patient.mesh
    triangles = mesh.boundary_triangles
    normals, nearest = node_normals(mesh.points, triangles), NearestTriangle(mesh.points[triangles])
    inward = np.zeros((len(patient.lesions), 3))
    for row, name in zip(inward, patient.lesions, strict=True):
        centre, _ = lesion_extent(mesh, Lesion(region=name, material=Material(1.0, 1.0), name=name))
        triangle, weights = nearest(centre)
        outward = matmul(weights, normals[triangles[triangle]])
        row[:] = -outward / norm(outward)
    return inward


def _sphere() -> FloatArray:
    """Unit vectors spread evenly over the sphere, (DIRECTIONS, 3)."""
    turn = np.arange(DIRECTIONS) * np.pi * (3.0 - np.sqrt(5.0))
    z = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    radius = np.sqrt(1.0 - z * z)
    return np.column_stack([radius * cos(turn), radius * sin(turn), z])
