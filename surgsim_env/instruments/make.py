"""Instruments of a scene: one arm, two, or a Cartesian tip on slides, a ball (probe) or a jaw (grasper)."""

import math
from pathlib import Path

import mujoco
import numpy as np

from msdm_core.arithmetic import arctan2, cos, matmul, norm, sin
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.instrument import Instrument, Jaw
from surgsim_env.instruments.tool_bodies import add_supports, frame_along, make_servo
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.load import pair_names, scenes_folder
from surgsim_env.scene.model import CARTESIAN, Scene

SLIDES = ("x", "y", "z")
FINGERS = ("finger_upper", "finger_lower")


class Probe(Instrument):
    """Cartesian probe of a scene; slide coordinates are the tip's position in the world."""

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip moves in the box from lower to upper [m] and is parked at `upper`."""
        model = _compile_probe(scene, lower, upper)
        super().__init__(model, lower, upper, model.site("tip").id)
        self.parked = upper
        self.servo = make_servo(lower, upper, np.arange(3), np.arange(3, 6))

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m] and reset all else."""
        self._rest()
        self.data.qpos[:3] = position
        self.data.ctrl[:3] = position
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command the tip's velocity [m/s] (3,); a probe does not turn."""
        self.turning_of(turning)
        self.servo.command[:] = velocity


class Grasper(Instrument):
    """Jaw on a shaft along the scene's approach, with a wrist hinge and three slides.

    The hinge is behind the tip. Once per control step `command_velocity` computes the slide positions for the tip's
    target at the end of the step, with the hinge turned, and commands constant speeds towards them.
    """

    turning_size = 1

    def __init__(self, scene: Scene, lower: FloatArray, upper: FloatArray) -> None:
        """Load the scene's model; the tip moves in the box from lower to upper [m] and is parked at `upper`.

        Raises:
            ValueError: the scene's tip_direction is beyond the hinge's range.
        """
        approach = np.asarray(scene.instrument.approach)
        self._rotation = frame_along(approach)
        model = _compile_grasper(scene, self._rotation)
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
        """True if the box or the hinge's range stopped the commanded motion of the tip."""
        return self._short or super().workspace_limited

    @property
    def pitch(self) -> float:
        """Angle of the wrist hinge [rad]; above 0 the jaw's tip is lifted."""
        return float(self.data.qpos[3])

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m], with the jaw open along the scene's tip direction."""
        self._rest()
        self._short = False
        joints = np.append(position - self._tip_from_hinge(self._start_pitch), self._start_pitch)
        self.data.qpos[:4] = joints
        self.data.ctrl[:4] = joints
        assert self.jaw is not None
        self.jaw.rest()
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Command the velocity of the tip [m/s] (3,) and of the hinge [rad/s] (1,); above 0 it lifts the jaw's tip.

        Valid for one control step; after it the joints continue at the same speeds.
        """
        duration, joints = self._control_step, self.data.ctrl[:4]
        low, high = self.servo.lower[3], self.servo.upper[3]
        target_pitch = joints[3] + float(self.turning_of(turning)[0]) * duration
        pitch = min(max(target_pitch, low), high)
        target = joints[:3] + self._tip_from_hinge(joints[3]) + np.asarray(velocity, dtype=np.float64) * duration
        held = np.clip(target, self.lower, self.upper)
        self._short = bool(pitch != target_pitch or (held != target).any())
        self.servo.command[:3] = (held - self._tip_from_hinge(pitch) - joints[:3]) / duration
        self.servo.command[3] = (pitch - joints[3]) / duration

    def get_state(self) -> FloatArray:
        """Whole state of the instrument, with its command, as a vector."""
        return np.append(super().get_state(), float(self._short))

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit."""
        super().set_state(state[:-1])
        self._short = bool(state[-1])

    def _tip_from_hinge(self, pitch: float) -> FloatArray:
        """Vector from the hinge to the tip at an angle of the hinge [rad], world frame, (3,) [m]."""
        _, y, z = self._reach
        c, s = float(cos(pitch)), float(sin(pitch))
        return matmul(self._rotation, np.array([0.0, c * y - s * z, s * y + c * z]))

    def _pitch_towards(self, direction: tuple[float, float, float]) -> float:
        """Angle of the hinge for a jaw along a direction as closely as possible [rad]."""
        _, y, z = matmul(self._rotation.T, np.asarray(direction))
        pitch = float(arctan2(y, -z))
        low, high = self.model.joint("pitch").range
        if not low <= pitch <= high:
            raise ValueError(
                f"instrument.tip_direction {direction} needs the grasper's wrist at {math.degrees(pitch):.0f} degrees "
                f"from instrument.approach; its range is {math.degrees(low):.0f} to {math.degrees(high):.0f}"
            )
        return pitch


def read_model(name: str) -> mujoco.MjSpec:
    """Read the model of a Cartesian instrument, one of CARTESIAN in scenes/instruments.

    Raises:
        ValueError: another name (lists the known ones).
    """
    known = sorted(f"{name}.xml" for name in CARTESIAN)
    if name not in known:
        raise ValueError(
            f"instrument {name!r} is unknown; the instruments are {', '.join(known)}, and arms by name or TOML file"
        )
    return mujoco.MjSpec.from_file(str(scenes_folder() / "instruments" / name))


def _compile_probe(scene: Scene, lower: FloatArray, upper: FloatArray) -> mujoco.MjModel:
    spec = read_model(scene.instrument.model)
    spec.option.timestep = scene.timing.haptic_step
    ball, shaft, tip = spec.geom("tip_ball"), spec.geom("tip_shaft"), spec.body("tip")
    radius = scene.instrument.tip_radius
    ball.size = [radius, 0.0, 0.0]
    start = radius + float(shaft.size[0])
    shaft.fromto = [0.0, 0.0, start, 0.0, 0.0, start + 0.1]
    spec.geom("tip_handle").fromto = [0.0, 0.0, start + 0.1, 0.0, 0.0, start + 0.23]
    tip.quat = _rotation_from_down(np.asarray(scene.instrument.approach))
    for axis, name in enumerate(SLIDES):
        spec.joint(f"slide_{name}").range = [lower[axis], upper[axis]]
    add_supports(spec, scene.supports, moving=bool(scene.motions))
    return spec.compile()


def _rotation_from_down(direction: FloatArray) -> FloatArray:
    """Quaternion (w, x, y, z) of the smallest rotation from -z to a direction."""
    unit = direction / norm(direction)
    down = np.array([0.0, 0.0, -1.0])
    quaternion = np.concatenate([[1.0 + matmul(down, unit)], np.cross(down, unit)])
    if norm(quaternion) < 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    return quaternion / norm(quaternion)


def _compile_grasper(scene: Scene, rotation: FloatArray) -> mujoco.MjModel:
    spec = read_model(scene.instrument.model)
    spec.option.timestep = scene.timing.haptic_step
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    spec.body("wrist").quat = quaternion
    for name in SLIDES:
        # The box limits the tip; the slides' positions depend on the hinge too.
        spec.joint(f"slide_{name}").range = [-10.0, 10.0]
    add_supports(spec, scene.supports, moving=bool(scene.motions))
    return spec.compile()


def make_instrument(anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> Instrument:
    """Load the instrument of an anatomy's scene; its tip may move in the box from lower to upper [m].

    Raises:
        ValueError: an unknown model; an arm with a wrong description or without reach of the palpable face.
    """
    scene = anatomy.scene
    if pair_names(scene.instrument.model) is not None:
        from surgsim_env.instruments.arm.pair import Pair

        return Pair(anatomy, lower, upper)
    if Path(scene.instrument.model).suffix != ".xml":
        from surgsim_env.instruments.arm.arm_instrument import ArmInstrument

        return ArmInstrument(anatomy, lower, upper)
    kind = Grasper if read_model(scene.instrument.model).body("jaw") is not None else Probe
    instrument = kind(scene, lower, upper)
    instrument.set_patches(scene.instrument, np.asarray(scene.instrument.approach))
    return instrument
