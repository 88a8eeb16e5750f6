"""A mesh of the drawn scene whose vertices, normals and triangles are replaced for each picture."""

from dataclasses import dataclass

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, IntArray

# MuJoCo accepts no empty or flat mesh: until the first picture a mesh consists of copies of this tetrahedron.
_TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]])
_TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)


@dataclass(frozen=True, eq=False)
class Shape:
    """The shape of a mesh in one picture, in the world's axes.

    Fields:
        vertices: [m]                                                               (n_vertex, 3)
        normals: unit, outward                                                      (n_vertex, 3)
        faces: vertices of the triangles, outward                                   (n_face, 3)
    """

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray


def add_mesh(spec: mujoco.MjSpec, name: str, material: str, vertex_count: int, face_count: int) -> None:
    """Add a mesh and its geom, with room for `vertex_count` vertices and `face_count` triangles."""
    corner = np.resize(np.arange(4), max(vertex_count, 4))
    faces = np.resize(_TETRAHEDRON_FACES.ravel(), 3 * max(face_count, 4))
    mesh = spec.add_mesh(name=name)
    mesh.uservert = _TETRAHEDRON[corner].ravel()
    mesh.usernormal = np.resize([0.0, 0.0, 1.0], 3 * len(corner))
    mesh.userface = faces
    mesh.userfacenormal = faces
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=material, contype=0, conaffinity=0
    )


class DrawnMesh:
    """One mesh of a compiled model, which can be changed and uploaded."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self.mesh = model.mesh(name).id
        self.geom = model.geom(name).id
        self._room = int(model.mesh_vertnum[self.mesh]), int(model.mesh_facenum[self.mesh])
        self._face_count = self._room[1]
        assert model.mesh_normalnum[self.mesh] == self._room[0]

    def holds(self, shape: Shape) -> bool:
        """Whether a shape fits into the mesh."""
        return len(shape.vertices) <= self._room[0] and len(shape.faces) <= self._room[1]

    def upload(self, shape: Shape, context: mujoco.MjrContext) -> None:
        """Replace the shape of the mesh; the geom's frame is the world's."""
        assert self.holds(shape)
        model, mesh, count = self._model, self.mesh, len(shape.vertices)
        for array, address, values in (
            (model.mesh_vert, model.mesh_vertadr, shape.vertices),
            (model.mesh_normal, model.mesh_normaladr, shape.normals),
        ):
            array[address[mesh] : address[mesh] + count] = values
        first = model.mesh_faceadr[mesh]
        for array in (model.mesh_face, model.mesh_facenormal):
            array[first : first + len(shape.faces)] = shape.faces
        self._face_count = len(shape.faces)
        self.show(True, context)

    def show(self, shown: bool, context: mujoco.MjrContext) -> None:
        """Hide the mesh from the next picture, or show it again."""
        self._model.mesh_facenum[self.mesh] = self._face_count if shown else 0
        mujoco.mjr_uploadMesh(self._model, context, self.mesh)
