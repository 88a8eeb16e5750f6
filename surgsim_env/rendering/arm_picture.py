"""A picture of one arm with its meshes, its shaft in a trocar."""

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.renderer import DrawnCapsule, draw_still
from surgsim_env.rendering.scene_model import shown_geoms

SIZE, FIELD_OF_VIEW = (960, 720), 35.0
TROCAR_RADIUS, TROCAR_COLOUR = 0.008, (0.95, 0.75, 0.2, 1.0)


def draw_arm(arm: Arm, joints: ArrayLike) -> NDArray[np.uint8]:
    """A picture (720, 960, 3) of an arm at joint values (n,) [rad or m], its trocar as a yellow ball.

    Raises:
        NoGLError: there is no OpenGL; names the packages that are missing.
    """
    data = mujoco.MjData(arm.model)
    arm.write(data, joints)
    mujoco.mj_kinematics(arm.model, data)
    shown = shown_geoms(arm.model)
    places, radii = data.geom_xpos[shown], arm.model.geom_rbound[shown][:, None]
    # A plane has no bounding radius.
    low, high = (places - radii).min(axis=0, initial=np.inf), (places + radii).max(axis=0, initial=-np.inf)
    low, high = np.minimum(low, arm.trocar), np.maximum(high, arm.trocar)
    tip = arm.tip_pose(joints).position
    low, high = np.minimum(low, tip), np.maximum(high, tip)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    up = arm.port.rotation[:, 2]
    # From the side on which the arm is seen in its whole width, a little from above.
    aside = np.cross(up, arm.trocar - places.mean(axis=0))
    aside = aside / np.linalg.norm(aside) if np.linalg.norm(aside) > 1e-6 else arm.port.rotation[:, 1]
    direction = aside + 0.4 * up
    direction /= np.linalg.norm(direction)
    position = centre + 1.05 * radius / np.sin(np.radians(0.5 * FIELD_OF_VIEW)) * direction
    camera = Camera.looking(position, centre, up, FIELD_OF_VIEW)
    ball = DrawnCapsule(np.stack([arm.trocar, arm.trocar]), TROCAR_RADIUS, TROCAR_COLOUR)
    return draw_still(None, [(arm.model, data)], [ball], [camera], SIZE)[0]
