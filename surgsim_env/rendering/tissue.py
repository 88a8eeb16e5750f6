"""Shapes of an organ and its lesions for a picture: drawn surface, cut-away section, lesions that move with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from msdm_core.material.regions import Lesion, lesion_extent
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from surgsim_env.rendering.cameras import cut_direction
from surgsim_env.rendering.cutting import clip_triangles, cut_tets
from surgsim_env.rendering.drawn_mesh import Shape
from surgsim_env.rendering.surface import DrawnSurface, smooth_normals
from surgsim_env.scene.anatomy import Anatomy


@dataclass(frozen=True, eq=False)
class LesionBall:
    """A lesion as an ellipsoid that moves with the tissue inside it: centre [m], half axes [m] and those nodes."""

    centre: FloatArray
    half_axes: FloatArray
    nodes: IntArray

    def centre_now(self, rest: FloatArray, node_position: FloatArray) -> FloatArray:
        """The centre moved by the mean displacement of the nodes inside [m], shape (3,)."""
        return self.centre + (node_position[self.nodes] - rest[self.nodes]).mean(axis=0)


class Tissue:
    """The shapes of an organ with given lesions as functions of its node positions."""

    def __init__(self, anatomy: Anatomy, surface: DrawnSurface, lesions: Sequence[Lesion], cut_away: bool) -> None:
        # Lesions are drawn as ellipsoids, tagged regions of the mesh too (`msdm_core.material.regions.lesion_extent`).
        self._rest, self._surface = anatomy.mesh.points, surface
        self.lesions = [lesion_ball(anatomy.mesh, lesion) for lesion in lesions]
        held = np.isin(surface.triangles, anatomy.anchors).all(axis=1)
        held = np.repeat(held, surface.splits**2)
        self._faces = {"organ": surface.faces[~held], "held": surface.faces[held]}
        self._cut = _CutAway(anatomy, surface, self.lesions, self._faces) if cut_away else None

    def shapes(self, node_position: FloatArray) -> dict[str, Shape]:
        """Surface and cut faces by their names in the scene, with the nodes at their positions [m] (n_node, 3)."""
        vertices, normals = self._surface.follow(node_position)
        if self._cut is None:
            return {name: Shape(vertices, normals, faces) for name, faces in self._faces.items()}
        return self._cut.surfaces(vertices, normals) | self._cut.sections(node_position)

    def lesion_centres(self, node_position: FloatArray) -> list[FloatArray]:
        """Present centres of the lesions [m]."""
        return [lesion.centre_now(self._rest, node_position) for lesion in self.lesions]


class _CutAway:
    """The cut through an organ: an upright plane through its first lesion, computed at rest, moving with the nodes."""

    def __init__(
        self,
        anatomy: Anatomy,
        surface: DrawnSurface,
        lesions: Sequence[LesionBall],
        faces: dict[str, IntArray],
    ) -> None:
        mesh = anatomy.mesh
        through, towards = cut_plane(anatomy, lesions)
        height = (surface.follow(mesh.points)[0] - through) @ towards
        self._surfaces = {name: clip_triangles(part, height) for name, part in faces.items()}
        mix, section = cut_tets(mesh, (mesh.points - through) @ towards)
        depth = np.full(len(mix.indptr) - 1, 1.0)
        for lesion in lesions:
            place = (mix @ mesh.points - lesion.centre) / lesion.half_axes
            depth = np.minimum(depth, np.linalg.norm(place, axis=1) - 1.0)
        self._sections: dict[str, tuple[csr_array, IntArray]] = {}
        for name, values in (("section", -depth), ("section_lesion", depth)):
            part, part_faces = clip_triangles(section, values)
            self._sections[name] = csr_array(part @ mix), part_faces

    def surfaces(self, vertices: FloatArray, normals: FloatArray) -> dict[str, Shape]:
        """The part of the drawn surface that the cut leaves."""
        shapes = {}
        for name, (mix, faces) in self._surfaces.items():
            turned = mix @ normals
            shapes[name] = Shape(mix @ vertices, turned / np.linalg.norm(turned, axis=1, keepdims=True), faces)
        return shapes

    def sections(self, node_position: FloatArray) -> dict[str, Shape]:
        """The cut faces of healthy tissue and of lesions."""
        shapes = {}
        for name, (mix, faces) in self._sections.items():
            vertices = mix @ node_position
            shapes[name] = Shape(vertices, smooth_normals(vertices, faces), faces)
        return shapes


def cut_plane(anatomy: Anatomy, lesions: Sequence[LesionBall]) -> tuple[FloatArray, FloatArray]:
    """A point of the cutting plane [m] and its unit normal, which points to the removed side."""
    face = anatomy.mesh.points[anatomy.face.triangles].mean(axis=(0, 1))
    return (lesions[0].centre if lesions else face), cut_direction(anatomy)


def lesion_ball(mesh: TetMesh, lesion: Lesion) -> LesionBall:
    """A lesion of an organ at rest as an ellipsoid; see `msdm_core.material.regions.lesion_extent`."""
    centre, half_axes = lesion_extent(mesh, lesion)
    distance = np.linalg.norm((mesh.points - centre) / half_axes, axis=1)
    nodes = np.flatnonzero(distance <= max(1.0, float(distance.min())))
    return LesionBall(centre, half_axes, nodes.astype(np.int32))
