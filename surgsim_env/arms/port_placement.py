"""Where a scene has its port if it does not say, and that a port is not inside the organ."""

import math

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.arms.port import Port
from surgsim_env.palpable_face import PalpableFace, tangent_axes

# A port lies 10 to 20 cm from its target, and instrument ports some 8 cm beside the camera's: 13 cm away and 30 degrees
# off the approach is 6.5 cm beside it (port placement for da Vinci: docs/arms.md).
PORT_DISTANCE = 0.13
PORT_TILT = math.radians(30.0)


def default_port(face: PalpableFace) -> Port:
    """A port above the palpable face: 13 cm from its middle, seen from there 30 degrees off the approach."""
    corners = face.points[face.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    target = area @ corners.mean(axis=1) / area.sum()
    aside, _ = tangent_axes(face.approach)
    out = math.cos(PORT_TILT) * -face.approach + math.sin(PORT_TILT) * aside
    x, y, z = (target + PORT_DISTANCE * out).tolist()
    u, v, w = (-out).tolist()
    return Port((x, y, z), (u, v, w))


def inside_surface(point: ArrayLike, points: FloatArray, triangles: IntArray) -> bool:
    """Whether a point [m] lies within a closed surface, by its solid angle (van Oosterom & Strackee 1983)."""
    a, b, c = (points[triangles[:, corner]] - np.asarray(point, dtype=np.float64) for corner in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    triple = (a * np.cross(b, c)).sum(axis=1)
    rest = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return bool(abs(2.0 * np.arctan2(triple, rest).sum()) > 2.0 * math.pi)


def check_port_outside(port: Port, name: str, points: FloatArray, triangles: IntArray) -> None:
    """Refuse a port inside an organ, whose closed surface has points (n, 3) [m] and triangles (m, 3).

    Raises:
        ValueError: names the port, its place and the organ.
    """
    if inside_surface(port.point, points, triangles):
        place = ", ".join(f"{value * 1e3:.1f}" for value in port.point)
        raise ValueError(f"the port at ({place}) mm lies inside the organ of {name}: move it out through the body wall")
