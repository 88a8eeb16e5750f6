"""Closed-form kinematics of the patient-side manipulator (PSM) of the da Vinci research kit, from one table.

The numbers are those of jhu-dvrk/sawIntuitiveResearchKit, share/arm/psm.json and
share/tool/LARGE_NEEDLE_DRIVER_400006.json.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import cos, matmul, sin
from msdm_core.mesh.tet_mesh import FloatArray

RIGHT = 0.5 * math.pi


@dataclass(frozen=True)
class Link:
    """One row of a modified Denavit-Hartenberg table (Craig): Rx(alpha) Tx(a) Rz(theta) Tz(d), its joint and limits.

    Args:
        joint: its name.
        alpha: twist about x [rad].
        a: length along x [m].
        theta: angle about z at joint value 0 [rad].
        d: offset along z at joint value 0 [m].
        prismatic: whether the joint adds to d and not to theta.
        lower, upper: limits of the joint [rad, or m where it is prismatic].
    """

    joint: str
    alpha: float
    a: float
    theta: float
    d: float
    prismatic: bool
    lower: float
    upper: float

    def transform(self, value: float) -> FloatArray:
        """Pose of the link in the one before it at a joint value [rad or m], (4, 4)."""
        theta, d = (self.theta, self.d + value) if self.prismatic else (self.theta + value, self.d)
        ca, sa, ct, st = float(cos(self.alpha)), float(sin(self.alpha)), float(cos(theta)), float(sin(theta))
        return np.array(
            [
                [ct, -st, 0.0, self.a],
                [st * ca, ct * ca, -sa, -sa * d],
                [st * sa, ct * sa, ca, ca * d],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )


def _degrees(lower: float, upper: float) -> tuple[float, float]:
    return math.radians(lower), math.radians(upper)


# The yaw's +-91 degrees are the mechanism's; psm.json has a software bound of +-270 there.
PSM_LINKS = (
    Link("yaw", RIGHT, 0.0, RIGHT, 0.0, False, *_degrees(-91.0, 91.0)),
    Link("pitch", -RIGHT, 0.0, -RIGHT, 0.0, False, *_degrees(-53.0, 53.0)),
    Link("insertion", RIGHT, 0.0, 0.0, -0.4318, True, 0.0, 0.24),
    Link("roll", 0.0, 0.0, 0.0, 0.4162, False, *_degrees(-260.0, 260.0)),
    Link("wrist_pitch", -RIGHT, 0.0, -RIGHT, 0.0, False, *_degrees(-80.0, 80.0)),
    Link("wrist_yaw", -RIGHT, 0.0091, -RIGHT, 0.0, False, *_degrees(-80.0, 80.0)),
)
# Orientation of the tip's frame in the last link's (`tooltip-offset`): its z points out of the tip.
TIP_ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def psm_frames(joints: ArrayLike) -> FloatArray:
    """Poses of the six links in the port's frame at joint values [rad, m] (6,), shape (6, 4, 4).

    T_i = T_(i-1) Rx(alpha_i) Tx(a_i) Rz(theta_i) Tz(d_i). Yaw and pitch turn about axes through the origin and the
    insertion runs along a line through it: the origin is the remote centre, and the shaft meets it at any values.
    """
    pose = np.eye(4)
    frames = []
    for link, value in zip(PSM_LINKS, np.asarray(joints, dtype=np.float64).tolist(), strict=True):
        pose = matmul(pose, link.transform(value))
        frames.append(pose)
    return np.array(frames)
