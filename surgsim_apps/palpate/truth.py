"""Places of hidden lesions on the surface: points of the pressable face from which a press strains them most."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.arithmetic import matmul, norm
from msdm_core.material import Lesion, lesion_extent
from msdm_core.mesh import FloatArray, IntArray, node_normals, triangle_lattice
from surgsim_env.scene import Anatomy, contact_radius

# Points of a grid along each axis of a lesion, and parts of each edge of a triangle.
GRID = 9
SPLITS = 3


@dataclass(frozen=True, eq=False)
class Truth:
    """A lesion seen from the surface.

    Fields:
        name: of the lesion
        centre: its centre [m]                                                  (3,)
        point: of the pressable face, from which it is felt most [m]            (3,)
        normal: unit outward normal there                                       (3,)
        radius: its largest half axis [m]
    """

    name: str
    centre: FloatArray
    point: FloatArray
    normal: FloatArray
    radius: float


def seen_from_surface(lesions: Sequence[Lesion], anatomy: Anatomy) -> list[Truth]:
    """Lesions with the pressable points of largest `felt_weights`.

    The point of the palpable face nearest to the centre, where no pressable point is better.
    """
    face, truths = anatomy.face, []
    points, normals = _spread(face.points, face.normals, face.triangles[face.thickness >= face.thickness_smallest])
    for lesion in lesions:
        centre, half_axes = lesion_extent(anatomy.mesh, lesion)
        point, normal = face.project(centre)
        weights = felt_weights(anatomy, lesion, points, normals)
        least = felt_weights(anatomy, lesion, point[None], normal[None])[0] if is_pressable(anatomy, point) else -1.0
        for index in np.argsort(-weights):
            if weights[index] <= least:
                break
            if is_pressable(anatomy, points[index]):
                point, normal = points[index], normals[index]
                break
        truths.append(Truth(lesion.name, centre, point, normal, float(half_axes.max())))
    return truths


def is_pressable(anatomy: Anatomy, point: FloatArray) -> bool:
    """True if a point of the palpable face [m] (3,) may be a site: open, away from the border and from supports."""
    face = anatomy.face
    inside = face.rim_distance(point) >= face.margin and face.is_open(point)
    return inside and bool(anatomy.clear_of_supports(point[None])[0])


def surface_points(anatomy: Anatomy) -> tuple[FloatArray, FloatArray]:
    """Points all over the organ's surface [m] and unit outward normals there, each (n_point, 3)."""
    mesh = anatomy.mesh
    return _spread(mesh.points, node_normals(mesh.points, mesh.boundary_triangles), mesh.boundary_triangles)


def felt_weights(anatomy: Anatomy, lesion: Lesion, points: FloatArray, normals: FloatArray) -> FloatArray:
    """Share of a press's strain energy in a lesion at each point, up to a common factor, shape (n_point,).

    A force P on an incompressible half space stresses it radially: s_RR = -3 P cos(a) / (2 pi R^2) at a
    distance R in a direction a from its line (Boussinesq 1885 with nu = 1/2), an energy density in proportion to
    (cos(a) / R^2)^2. To first order a stiff inclusion changes the force by the energy in its volume. The contact
    spreads the load: R^2 becomes R^2 + a^2 with the contact's radius a.

    Args:
        anatomy: the organ.
        lesion: in the organ.
        points: of the surface [m], shape (n_point, 3).
        normals: unit outward normals there, shape (n_point, 3).
    """
    scene = anatomy.scene
    spread = np.square(contact_radius(scene.instrument.tip_radius, scene.palpation.press_depth))
    centre, half_axes = lesion_extent(anatomy.mesh, lesion)
    line = (np.arange(GRID) + 0.5) * 2.0 / GRID - 1.0
    grid = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    inside = centre + grid[(grid * grid).sum(axis=1) <= 1.0] * half_axes
    weights = np.empty(len(points))
    for index, (point, normal) in enumerate(zip(points, normals, strict=True)):
        away = inside - point
        squared = (away * away).sum(axis=1)
        depth = np.maximum(-matmul(away, normal), 0.0)
        weights[index] = (depth * depth / (np.maximum(squared, 1e-18) * np.square(squared + spread))).sum()
    return weights


def _spread(points: FloatArray, normals: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    counts, _ = triangle_lattice(SPLITS)
    shares = counts / SPLITS
    places = matmul(shares, points[triangles]).reshape(-1, 3)
    normal = matmul(shares, normals[triangles]).reshape(-1, 3)
    # Corners and edges belong to several triangles.
    _, first = np.unique(np.round(places, 9), axis=0, return_index=True)
    first = np.sort(first)
    normal = normal[first]
    return places[first], normal / norm(normal, axis=1)[:, None]
