"""The Cartesian grasper of a scene: a jaw on a wrist hinge, steered by the velocity of the point between its pads."""

import math

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.instrument import SLIDES, Instrument, read_model
from surgsim_env.jaw import Jaw
from surgsim_env.scenes import Scene
from surgsim_env.supports import add_supports
from surgsim_env.tool_bodies import make_servo

FINGERS = ("finger_upper", "finger_lower")
# Up: the pads of a jaw at rest face each other along it, as near as can be; this where the jaw points along it.
UP, UP_ELSE = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


class Grasper(Instrument):
    """A jaw at the end of a shaft along the scene's approach; a hinge across the jaw turns it, slides carry all.

    The hinge lies behind the tip. Once a control step `command_velocity` finds the slides' places that put the tip
    where it shall be at the step's end, the hinge turned, and commands the steady speeds that lead there.
    """

    turning_size = 1

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip may move in the box from lower to upper [m], and waits in its far corner.

        Raises:
            ValueError: the scene's tip_direction asks the hinge for more than its range.
        """
        approach = np.asarray(scene.instrument.approach)
        self._rotation = frame_along(approach)
        model = _compile(scene, self._rotation)
        super().__init__(model, lower, upper, model.site("tip").id)
        # From the hinge to the tip at pitch 0, in the wrist's frame.
        self._reach = model.site("tip").pos.copy()
        self._start_pitch = self._pitch_towards(scene.instrument.tip_direction or scene.instrument.approach)
        self._control_step = scene.timing.control_step
        self.parked = upper
        limits = self.model.jnt_range.T
        self.servo = make_servo(limits[0], limits[1], np.arange(6), np.arange(6, 12))
        self._set_jaw(Jaw(self, FINGERS, np.array([4, 5])))
        self._short = False

    @property
    def workspace_limited(self) -> bool:
        """Whether the box or the hinge's range kept the tip from going where it was told."""
        return self._short or super().workspace_limited

    @property
    def pitch(self) -> float:
        """Angle of the wrist hinge [rad]; above 0 the jaw's tip is lifted."""
        return float(self.data.qpos[3])

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], the jaw open and pointing as the scene says."""
        self._rest()
        self._short = False
        joints = np.append(position - self._tip_from_hinge(self._start_pitch), self._start_pitch)
        self.data.qpos[:4] = joints
        self.data.ctrl[:4] = joints
        assert self.jaw is not None
        self.jaw.rest()
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Set the tip's velocity [m/s] (3,) and that of the wrist hinge [rad/s] (1,); above 0 it lifts the jaw's tip.

        Good for one control step; held for longer, the joints go on at the same speeds.
        """
        duration, joints = self._control_step, self.data.ctrl[:4]
        low, high = self.servo.lower[3], self.servo.upper[3]
        turned = joints[3] + float(self.turning_of(turning)[0]) * duration
        pitch = min(max(turned, low), high)
        wanted = joints[:3] + self._tip_from_hinge(joints[3]) + np.asarray(velocity, dtype=np.float64) * duration
        held = np.clip(wanted, self.lower, self.upper)
        self._short = bool(pitch != turned or (held != wanted).any())
        self.servo.command[:3] = (held - self._tip_from_hinge(pitch) - joints[:3]) / duration
        self.servo.command[3] = (pitch - joints[3]) / duration

    def get_state(self) -> FloatArray:
        """All of the instrument's state, command included, as one vector."""
        return np.append(super().get_state(), float(self._short))

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        super().set_state(state[:-1])
        self._short = bool(state[-1])

    def _tip_from_hinge(self, pitch: float) -> FloatArray:
        """From the hinge to the tip at an angle of the hinge [rad], world frame [m], (3,)."""
        _, y, z = self._reach
        c, s = math.cos(pitch), math.sin(pitch)
        return self._rotation @ np.array([0.0, c * y - s * z, s * y + c * z])

    def _pitch_towards(self, direction: tuple[float, float, float]) -> float:
        """Angle of the hinge at which the jaw points in a direction, as near as it can [rad]."""
        _, y, z = self._rotation.T @ np.asarray(direction)
        pitch = math.atan2(y, -z)
        low, high = self.model.joint("pitch").range
        if not low <= pitch <= high:
            raise ValueError(
                f"instrument.tip_direction {direction} asks the grasper's wrist for {math.degrees(pitch):.0f} degrees "
                f"off instrument.approach; its range is {math.degrees(low):.0f} to {math.degrees(high):.0f}"
            )
        return pitch


def frame_along(direction: FloatArray) -> FloatArray:
    """A right-handed frame whose -z is a direction and whose y is as near to up as can be, as columns (3, 3)."""
    z = -direction / np.linalg.norm(direction)
    up = UP if abs(z @ UP) < 0.9 else UP_ELSE
    y = up - (up @ z) * z
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _compile(scene: Scene, rotation: FloatArray) -> mujoco.MjModel:
    spec = read_model(scene.instrument.model)
    spec.option.timestep = scene.timing.haptic_step
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    spec.body("wrist").quat = quaternion
    for name in SLIDES:
        # The box is the tip's: where the slides are then depends on the hinge.
        spec.joint(f"slide_{name}").range = [-10.0, 10.0]
    add_supports(spec, scene.supports)
    return spec.compile()
