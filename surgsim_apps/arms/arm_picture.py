"""A picture of one arm with its meshes, its shaft in a trocar."""

import math
from itertools import product
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.mesh import FloatArray
from surgsim_env.instruments import Arm
from surgsim_env.rendering import Camera, draw_arm_still, shown_geoms

SIZE, FIELD_OF_VIEW = (1600, 1200), 30.0
# Share of the picture that the arm fills.
SHARE = 0.94
# The view is from beside the arm, by these amounts from the trocar's side and from above.
AHEAD, ABOVE = 0.5, 0.35
TROCAR_RADIUS, TROCAR_COLOUR = 0.008, (0.95, 0.75, 0.2, 1.0)
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def draw_arm(arm: Arm, joints: ArrayLike) -> NDArray[np.uint8]:
    """A picture (1200, 1600, 3) of an arm at joint values (n,) [rad or m], its trocar as a yellow ball.

    Raises:
        NoGLError: there is no OpenGL; names the packages that are missing.
    """
    data = mujoco.MjData(arm.model)
    arm.write(data, joints)
    mujoco.mj_kinematics(arm.model, data)
    up = arm.port.rotation[:, 2]
    points = np.concatenate([_box_corners(arm.model, data), [arm.trocar]])
    aside = np.cross(up, arm.trocar - points.mean(axis=0))
    # Of an arm whose middle is above the trocar every side shows as much.
    length = float(np.linalg.norm(aside))
    aside = aside / length if length > 1e-6 else arm.port.rotation[:, 1]
    direction: Any = aside + AHEAD * np.cross(aside, up) + ABOVE * up
    camera = filling_camera(points, direction, up, FIELD_OF_VIEW, SIZE[0] / SIZE[1], SHARE)
    ball = np.append(arm.trocar, TROCAR_RADIUS)
    return draw_arm_still(arm.model, data, ball, TROCAR_COLOUR, camera, SIZE)


def filling_camera(
    points: FloatArray, direction: FloatArray, up: FloatArray, fov: float, aspect: float, share: float
) -> Camera:
    """Nearest camera in a direction with all points [m] (n, 3) in the middle share of its picture.

    With x a point's place across the view, z towards the camera, c and d the camera's, and t the share times the
    tangent of half the angle of view, |x - c| <= t (d - z) for all points where t d is at least max(x + t z) - c and
    max(t z - x) + c.
    """
    rotation = Camera.looking(direction, np.zeros(3), up, fov).rotation
    seen = points @ rotation
    room = share * math.tan(math.radians(0.5 * fov)) * np.array([aspect, 1.0])
    high, low = ((sign * seen[:, :2] + room * seen[:, 2:]).max(axis=0) for sign in (1.0, -1.0))
    position = rotation @ np.append(0.5 * (high - low), (0.5 * (high + low) / room).max())
    return Camera.looking(position, position - rotation[:, 2], up, fov)


def _box_corners(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Corners [m] (n, 3) of boxes around the geoms that are shown."""
    # A plane has no bounds.
    shown = [geom for geom in shown_geoms(model) if model.geom_rbound[geom] > 0.0]
    boxes = model.geom_aabb[shown]
    local = boxes[:, None, :3] + CORNERS * boxes[:, None, 3:]
    rotation = data.geom_xmat[shown].reshape(-1, 3, 3)
    return (data.geom_xpos[shown][:, None] + np.einsum("gij,gcj->gci", rotation, local)).reshape(-1, 3)
