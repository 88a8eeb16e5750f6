"""An arm as the instrument of a scene: steered by its tip's velocity through inverse kinematics."""

from pathlib import Path

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.arms.arm import load_arm
from surgsim_env.arms.inverse_kinematics import PoseSolution, follow, reach_pose, turn_towards
from surgsim_env.arms.model import position_actuator, speed_actuator
from surgsim_env.arms.port_placement import check_port_outside, default_port
from surgsim_env.arms.wrist_sensor import WristSensor
from surgsim_env.instrument import Instrument
from surgsim_env.tool_bodies import make_servo

# A place counts as reached by the tip within this [m]; how it points is as the joints allow.
PLACE_TOLERANCE = 1e-6
# Where the tip waits before the first reset: this far above the middle of the palpable face [m].
PARKED_GAP = 0.010
# How many places of the palpable face are tried when an arm is set up.
PLACES_TRIED = 24


class ArmInstrument(Instrument):
    """An arm at a scene's port whose tip is steered by its velocity and points along the scene's approach.

    Once a control step `command_velocity` finds the joint values that put the tip where it shall be at the step's end
    (`inverse_kinematics.follow`) and commands the steady joint speeds that lead there; the servo integrates them at
    haptic rate, as the probe's does. Joint targets start from where the last ones ended, so that the path has no drift.

    Fields:
        arm: the arm as a mechanism
        wrist: its force sensor, None where the model has none
        direction: where the tip shall point (3,)
    """

    def __init__(self, anatomy: Anatomy, lower: FloatArray, upper: FloatArray) -> None:
        """Set the scene's arm up at its port; the tip may move in the box from lower to upper [m].

        Raises:
            ValueError: a wrong description or model, a port inside the organ, a palpable face out of reach.
        """
        scene = anatomy.scene
        port = scene.port or default_port(anatomy.face)
        check_port_outside(port, f"scene {scene.name!r}", anatomy.mesh.points, anatomy.mesh.boundary_triangles)
        beside = scene.folder / scene.instrument.model
        self.arm = load_arm(
            beside if beside.is_file() else scene.instrument.model,
            port,
            tip_radius=scene.instrument.tip_radius,
            timestep=scene.timing.haptic_step,
        )
        arm, model = self.arm, self.arm.model
        super().__init__(model, lower, upper, arm.tip_site)
        pairs = [(position_actuator(model, name), speed_actuator(model, name)) for name in arm.joints]
        position, speed = np.array(pairs, dtype=np.int64).T.copy()
        self.servo = make_servo(arm.lower, arm.upper, position, speed)
        self._jaw = [position_actuator(model, name) for name in arm.description.jaw]
        self._control_step = scene.timing.control_step
        self._approach = anatomy.face.approach
        self.direction = self._approach.copy()
        self._short = False
        self.wrist = WristSensor.of(model)
        self.parked = _middle(anatomy) - (scene.instrument.tip_radius + PARKED_GAP) * self._approach
        self._check_reach(anatomy)
        self.place(self.parked)

    @property
    def workspace_limited(self) -> bool:
        """Whether the box, a joint's limit or its speed limit kept the tip from going where it was told."""
        return self._short or bool(self.servo.limited[0])

    @property
    def joint_positions(self) -> FloatArray:
        """Values of the driven joints [rad or m], (n,)."""
        return self.data.qpos[self.arm.qpos]

    @property
    def trocar_residual(self) -> float:
        """Distance of the shaft's axis from the trocar where the joints are now [m]."""
        return self.arm.trocar_residual(self.joint_positions)

    def place(self, position: FloatArray) -> None:
        """Put the tip at rest at a position [m], pointing along the approach as far as the joints allow, jaw closed.

        Raises:
            ValueError: the tip does not reach there (says by how much, and the port).
        """
        found = self._reach(position)
        if not _placed(found):
            raise ValueError(f"{self._where()} cannot put its tip at {_millimetres(position)}: {_missing(found)}")
        self._rest()
        self.direction = self._approach.copy()
        self._short = False
        self.arm.write(self.data, found.joints)
        self.data.ctrl[self.servo.position] = found.joints
        mujoco.mj_forward(self.model, self.data)

    def command_velocity(self, velocity: FloatArray, turning: FloatArray | None = None) -> None:
        """Set the velocity of the tip [m/s] (3,), and how the direction it points in turns [rad/s] (3,).

        Good for one control step; held for longer, the joints go on at the same speeds.
        """
        duration = self._control_step
        if turning is not None and np.any(turning):
            self.direction = _rotated(self.direction, np.asarray(turning, dtype=np.float64) * duration)
        joints = self.data.ctrl[self.servo.position]
        if not np.isfinite(joints).all():
            # MuJoCo is about to say so itself.
            self.servo.command[:] = 0.0
            return
        start = self.arm.tip_pose(joints).position
        wanted = start + np.asarray(velocity, dtype=np.float64) * duration
        held = np.clip(wanted, self.lower, self.upper)
        still = (
            not np.any(velocity) and np.linalg.norm(turn_towards(self.arm.tip_direction(joints), self.direction)) < 1e-6
        )
        if still:
            self._short = False
            self.servo.command[:] = 0.0
            return
        step = follow(self.arm, joints, held, self.direction, duration)
        self._short = step.limited or bool((held != wanted).any())
        self.servo.command[:] = (step.joints - joints) / duration

    def command_jaw(self, angle: float) -> None:
        """Set the jaw's opening angle [rad], shared by its fingers.

        Raises:
            ValueError: no jaw, or an angle outside its range.
        """
        lower, upper = self.arm.jaw_range
        if not self._jaw:
            raise ValueError(f"{self._where()} has no jaw: it carries a {self.arm.description.kind}")
        if not lower <= angle <= upper:
            raise ValueError(f"{self._where()}: jaw angle {angle:g} rad is outside its range {lower:g} to {upper:g}")
        self.data.ctrl[self._jaw] = angle / len(self._jaw)

    def get_state(self) -> FloatArray:
        """All of the instrument's state, command and wanted direction included, as one vector."""
        return np.concatenate([super().get_state(), [float(self._short)], self.direction])

    def set_state(self, state: FloatArray) -> None:
        """Restore what `get_state` gave, to the bit."""
        super().set_state(state[:-4])
        self._short = bool(state[-4])
        self.direction = state[-3:].copy()

    def _reach(self, position: FloatArray) -> PoseSolution:
        """Joint values for a place, pointing along the approach if they can, else as near to it as they come."""
        found = reach_pose(self.arm, position, direction=self._approach, starts=2)
        if _placed(found):
            return found
        return reach_pose(self.arm, position, starts=4)

    def _check_reach(self, anatomy: Anatomy) -> None:
        """The tip comes to the parking place and to places all over the palpable face."""
        face = anatomy.face
        corners = face.points[face.triangles]
        thick = np.flatnonzero(face.thickness >= face.thickness_smallest)
        tried = thick[np.linspace(0, len(thick) - 1, min(PLACES_TRIED, len(thick))).astype(int)]
        radius = anatomy.scene.instrument.tip_radius
        for place in [self.parked, *(corners[tried].mean(axis=1) - radius * self._approach)]:
            found = self._reach(place)
            if not _placed(found):
                raise ValueError(
                    f"{self._where()} does not reach the palpable face of scene {anatomy.scene.name!r} at "
                    f"{_millimetres(place)}: {_missing(found)}; move its [port]"
                )

    def _where(self) -> str:
        return f"arm {self.arm.description.name!r} at its port {_millimetres(np.array(self.arm.port.point))}"


def _placed(found: PoseSolution) -> bool:
    return found.position_error <= PLACE_TOLERANCE and found.trocar_error <= PLACE_TOLERANCE


def _missing(found: PoseSolution) -> str:
    away, off = found.position_error * 1e3, found.trocar_error * 1e3
    return f"its tip stays {away:.3f} mm away, its shaft {off:.3f} mm off the trocar"


def _millimetres(point: FloatArray) -> str:
    return "(" + ", ".join(f"{value * 1e3:.1f}" for value in point) + ") mm"


def _middle(anatomy: Anatomy) -> FloatArray:
    """The place of the palpable face nearest to its middle [m], (3,)."""
    corners = anatomy.face.points[anatomy.face.triangles]
    return anatomy.face.project(corners.mean(axis=(0, 1)))[0]


def _rotated(direction: FloatArray, turn: FloatArray) -> FloatArray:
    quaternion, result = np.zeros(4), np.zeros(3)
    angle = float(np.linalg.norm(turn))
    mujoco.mju_axisAngle2Quat(quaternion, turn / angle, angle)
    mujoco.mju_rotVecQuat(result, direction, quaternion)
    return result / np.linalg.norm(result)


def is_arm(model: str) -> bool:
    """Whether a scene's instrument is an arm (a TOML file or a shipped arm's name), not an MJCF probe."""
    return Path(model).suffix != ".xml"
