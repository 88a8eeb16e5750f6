"""Two tets that tests write into files of any format, by meshio alone."""

import meshio
import numpy as np
import pytest

FORMATS = [("a.vtu", None), ("a.vtk", None), ("a.msh", None), ("a.msh", "gmsh22"), ("a.mesh", None)]
every_format = pytest.mark.parametrize(("name", "file_format"), FORMATS)
POINTS = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100], [100, 100, 100]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def written(path, points=POINTS, cells=None, file_format=None, **more):
    meshio.Mesh(points, cells or [("tetra", TETS)], **more).write(path, file_format=file_format)
    return path
