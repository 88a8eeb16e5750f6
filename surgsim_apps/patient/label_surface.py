"""Surface of one label of a scan."""

from pathlib import Path

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from msdm_core.meshing import smoothed_share
from surgsim_apps.patient.fine_surface import level_surface
from surgsim_apps.patient.label_image import LabelName, read_label_image

# Smoothing of the label as for cells of this size [m], and triangles of its surface, about: chosen for a body wall.
CELL_SIZE, TRIANGLES_MOST = 0.01, 20_000


def read_label_surface(file: Path, label: str) -> tuple[FloatArray, IntArray]:
    """Points (n, 3) [m] and triangles (m, 3) of a smoothed label's largest body, in LPS.

    Raises:
        MeshError: as `read_label_image`.
    """
    image = read_label_image(file, [LabelName("surface", int(label) if label.isdigit() else label)])
    field = smoothed_share(image.tags > 0, np.zeros(3, dtype=np.int64), image.geometry.spacing, CELL_SIZE)
    volume = np.count_nonzero(image.tags) * image.voxel_volume
    a, b, c = (np.array(image.tags.shape) * image.geometry.spacing).tolist()
    points, triangles = level_surface(field, volume, 2.0 * (a * b + b * c + c * a), TRIANGLES_MOST)
    return image.geometry.places(points), triangles.astype(np.int32)
