"""Two tets that tests write into files of any format, by meshio alone."""

import meshio
import numpy as np

POINTS = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100], [100, 100, 100]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def written(path, points=POINTS, cells=None, file_format=None, **more):
    meshio.Mesh(points, cells or [("tetra", TETS)], **more).write(path, file_format=file_format)
    return path
