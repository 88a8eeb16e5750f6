"""Control of an instrument's arm: tip velocity to joint speeds by inverse kinematics."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import matmul, norm, svd
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.instruments.arm.inverse_kinematics import (
    PoseSolution,
    follow,
    frame_towards,
    reach_pose,
    turn_matrix,
    turn_towards,
)
from surgsim_env.instruments.arm.joint_deviation import JointDeviation
from surgsim_env.instruments.arm.model import CANNULA, WALL_JOINTS
from surgsim_env.instruments.instrument import Instrument, Jaw
from surgsim_env.instruments.tool_bodies import frame_along

# Tolerance of a reached position [m]; the direction is as the joints allow.
PLACE_TOLERANCE = 1e-6
# Largest angle of the commanded orientation of a tip with a jaw ahead of the actual one [rad].
TURN_AHEAD = 0.2


class SteeredArm:
    """Arm within an instrument's model, with commands of the tip's velocity and direction.

    Once per control step `command_velocity` computes the joint values for the tip's target at the end of the step
    (`inverse_kinematics.follow`) and commands constant joint speeds towards them; the servo integrates them at haptic
    rate. Joint targets continue from the last ones, so the path does not drift. With errors of the joints all this is
    computed from what the encoders say.

    For a tip without pads only the direction is controlled, and it may roll. For a jaw with pads the whole frame is
    controlled, with the pads facing each other vertically.

    Fields:
        arm: its kinematics, compiled alone
        lower, upper: the box of the tip [m]                                     (3,)
        jaw: None without one
        deviation: of the joints from their encoders
        goal: commanded direction of the tip (3,), or its frame if a jaw has pads (3, 3)
        short: True if the box, a joint's limit or its speed limit stopped the commanded motion
    """

    def __init__(
        self,
        arm: Arm,
        instrument: Instrument,
        places: NDArray[np.int64],
        *,
        direction: FloatArray,
        control_step: float,
        joint_errors: bool = False,
        jaw: Jaw | None = None,
        prefix: str = "",
    ) -> None:
        """Control an arm within the model of an instrument.

        Args:
            arm: its kinematics, at its port.
            instrument: with a servo for the arm's joints.
            places: indices of the arm's joints in the servo, (n,).
            direction: of the tip at the start, (3,).
            control_step: duration of a commanded velocity [s].
            joint_errors: True for the errors that the arm's description states, False for exact joints.
            jaw: of the arm.
            prefix: of the names of the arm's parts in the instrument's model.
        """
        model = instrument.model
        self.arm, self.jaw = arm, jaw
        self.lower, self.upper = instrument.lower, instrument.upper
        self._instrument, self._places, self._control_step = instrument, places, control_step
        followers = [arm.model.joint(joint).name for joint in arm.followers.joints]
        self._qpos = np.array([int(model.joint(prefix + name).qposadr[0]) for name in (*arm.joints, *followers)])
        instrument.servo.lower[places], instrument.servo.upper[places] = arm.lower, arm.upper
        self._tip = model.site(prefix + arm.model.site(arm.tip_site).name).id
        self._velocity = np.zeros(6)
        self.deviation = JointDeviation(arm.description.joint_errors if joint_errors else None)
        wall = arm.port.wall
        self._wall = None if wall is None else [model.joint(prefix + name).id for name in WALL_JOINTS]
        self._cannula = None if wall is None else int(model.joint(prefix + CANNULA).qposadr[0])
        self._starts = [direction / norm(direction)]
        if jaw is not None and jaw.has_pads:
            # Either pad may be the upper one.
            frame = matmul(frame_along(direction), _jaw_frame(arm).T)
            half_turn = turn_matrix(np.pi * self._starts[0])
            self._starts = [frame, matmul(half_turn, frame)]
        self.goal = self._starts[0].copy()
        self.short = False

    @property
    def tip_position(self) -> FloatArray:
        """Position of the tip [m], shape (3,): centre of the ball, or middle between the pads."""
        return self._instrument.data.site_xpos[self._tip].copy()

    @property
    def tip_reading(self) -> FloatArray:
        """Position of the tip by the joints' encoders [m], (3,); of exact joints `tip_position`."""
        if self.deviation.errors is None:
            return self.tip_position
        targets, time = self._targets, self._instrument.data.time
        encoders = self.joint_positions - targets + self.deviation.encoders(targets, time)
        return self.arm.tip_pose(encoders).position

    @property
    def tip_rotation(self) -> FloatArray:
        """Axes of the tip's frame as columns, world frame, (3, 3)."""
        return self._instrument.data.site_xmat[self._tip].reshape(3, 3).copy()

    @property
    def tip_velocity(self) -> FloatArray:
        """Velocity of the tip [m/s], shape (3,)."""
        data, site = self._instrument.data, mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(self._instrument.model, data, site, self._tip, self._velocity, 0)
        return self._velocity[3:].copy()

    @property
    def joint_positions(self) -> FloatArray:
        """Values of the driven joints [rad or m], (n,)."""
        return self._instrument.data.qpos[self._qpos[: self.arm.joint_count]]

    @property
    def _targets(self) -> FloatArray:
        """Targets of the driven joints' servos [rad or m], (n,)."""
        return self._instrument.data.ctrl[self._instrument.servo.position[self._places]]

    @property
    def trocar_residual(self) -> float:
        """Distance of the shaft's axis from the trocar at the current joint values [m]."""
        return self.arm.trocar_residual(self.joint_positions)

    @property
    def trocar_force(self) -> FloatArray | None:
        """Force of the wall's springs and dampers, as the shaft presses on the wall [N] (3,); None for a rigid wall."""
        if self._wall is None:
            return None
        model, data = self._instrument.model, self._instrument.data
        stiffness, damping = model.jnt_stiffness[self._wall], model.dof_damping[model.jnt_dofadr[self._wall]]
        stretch, speed = data.qpos[model.jnt_qposadr[self._wall]], data.qvel[model.jnt_dofadr[self._wall]]
        return matmul(self.arm.port.rotation, stiffness * stretch + damping * speed)

    @property
    def limited(self) -> bool:
        """True if the box, a joint's limit or its speed limit stopped the commanded motion of the tip."""
        return self.short or bool(self._instrument.servo.limited[self._places].any())

    @property
    def where(self) -> str:
        """Name and port of the arm in error messages."""
        return f"arm {self.arm.description.name!r} at its port {millimetres(np.array(self.arm.port.point))}"

    def place(self, position: FloatArray) -> None:
        """Place the tip at rest at a position [m], in the start direction as far as the joints allow.

        A jaw with pads is open. The caller brings MuJoCo's positions up to date.

        Raises:
            ValueError: the tip does not reach the position (gives the distance and the port).
        """
        solution, self.goal = self._reach(position)
        if not placed(solution):
            raise ValueError(f"{self.where} cannot put its tip at {millimetres(position)}: {missing(solution)}")
        self.short = False
        data, servo = self._instrument.data, self._instrument.servo
        data.qpos[self._qpos] = np.append(solution.joints, self.arm.followers.values(solution.joints))
        data.ctrl[servo.position[self._places]] = solution.joints
        servo.command[self._places] = 0.0
        self.deviation.begin(solution.joints, data.time)
        if self._cannula is not None:
            data.qpos[self._cannula] = self.arm.trocar_place(solution.joints)
        if self.jaw is not None:
            self.jaw.rest()

    def reach(self, position: FloatArray) -> PoseSolution:
        """Joint values for a position [m], with the tip as close to the start direction as possible."""
        return self._reach(position)[0]

    def command_velocity(self, velocity: FloatArray, turning: FloatArray) -> None:
        """Command the velocity [m/s] (3,) and the angular velocity [rad/s] (3,) of the tip.

        Valid for one control step; after it the joints continue at the same speeds.
        """
        duration, servo = self._control_step, self._instrument.servo
        targets, time = self._targets, self._instrument.data.time
        joints = self.deviation.encoders(targets, time)
        if not np.isfinite(targets).all():
            # MuJoCo's own warning ends the episode.
            servo.command[self._places] = 0.0
            return
        pose = self.arm.tip_pose(joints)
        if np.any(turning):
            self._turn_goal(turning * duration, pose.rotation)
        target = pose.position + np.asarray(velocity, dtype=np.float64) * duration
        held = np.clip(target, self.lower, self.upper)
        if not np.any(velocity) and self._points_well(joints, pose.rotation):
            self.short = False
        else:
            direction, frame = (None, self.goal) if self.goal.ndim == 2 else (self.goal, None)
            step = follow(self.arm, joints, held, direction, duration, rotation=frame)
            self.short, joints = step.limited or bool((held != target).any()), step.joints
        goal = self.deviation.follow(targets, joints, duration, time)
        servo.command[self._places] = (goal - targets) / duration

    def command_jaw(self, target: float) -> None:
        """Command the jaw to a target from -1 (closed) to 1 (open), approached at limited speed and held.

        Raises:
            ValueError: no jaw, or a target outside that range.
        """
        if self.jaw is None:
            raise ValueError(f"{self.where} has no jaw: it carries a {self.arm.description.kind}")
        self.jaw.command(target)

    def get_state(self) -> FloatArray:
        """State beyond MuJoCo's and the servo's: `goal`, `short` and the deviation's, as a vector."""
        return np.concatenate([self.goal.ravel(), [float(self.short)], self.deviation.get_state()])

    def set_state(self, state: FloatArray) -> None:
        """Restore a state from `get_state`, to the bit."""
        size = self.goal.size
        self.goal, self.short = state[:size].reshape(self.goal.shape).copy(), bool(state[size])
        self.deviation.set_state(state[size + 1 :])

    def _turn_goal(self, turn: FloatArray, rotation: FloatArray) -> None:
        if self.goal.ndim == 2:
            near = frame_towards(rotation, self.goal, TURN_AHEAD)
            left, _, right = svd(matmul(turn_matrix(turn), near))
            self.goal = matmul(left, right)
        else:
            quaternion, turned, angle = np.zeros(4), np.zeros(3), float(norm(turn))
            mujoco.mju_axisAngle2Quat(quaternion, turn / angle, angle)
            mujoco.mju_rotVecQuat(turned, self.goal, quaternion)
            self.goal = turned / norm(turned)

    def _points_well(self, joints: FloatArray, rotation: FloatArray) -> bool:
        if self.goal.ndim == 2:
            return bool(np.abs(rotation - self.goal).max() < 1e-6)
        return bool(norm(turn_towards(self.arm.tip_direction(joints), self.goal)) < 1e-6)

    def _reach(self, position: FloatArray) -> tuple[PoseSolution, FloatArray]:
        """Joint values for a position [m], and the chosen direction or frame of the start."""
        solutions: list[tuple[PoseSolution, FloatArray]] = []
        for start in self._starts:
            goal = {"rotation": start} if start.ndim == 2 else {"direction": start}
            solutions.append((reach_pose(self.arm, position, starts=2, **goal), start.copy()))
        # Of equal angles the joints nearest to home, as shares of their ranges.
        home, span = self.arm.home, self.arm.upper - self.arm.lower
        best = min(
            solutions, key=lambda pair: (round(pair[0].angle_error, 6), (np.abs(pair[0].joints - home) / span).sum())
        )
        if placed(best[0]):
            return best
        return reach_pose(self.arm, position, starts=4), best[1]


def _jaw_frame(arm: Arm) -> FloatArray:
    """Frame of the open jaw in the tip's frame: -z out of the tip, y between the fingers, (3, 3)."""
    data = mujoco.MjData(arm.model)
    arm.write(data, arm.home, math.fsum(arm.model.joint(name).range[1] for name in arm.description.jaw))
    mujoco.mj_kinematics(arm.model, data)
    first, second = (data.xipos[arm.model.body(arm.model.joint(name).bodyid[0]).id] for name in arm.description.jaw)
    rotation = data.site_xmat[arm.tip_site].reshape(3, 3)
    direction = matmul(rotation, np.asarray(arm.description.tip.direction))
    z = -direction / norm(direction)
    y = (first - second) - matmul(first - second, z) * z
    y /= norm(y)
    return matmul(rotation.T, np.stack([np.cross(y, z), y, z], axis=1))


def placed(solution: PoseSolution) -> bool:
    """True if the tip is at its position and the shaft in the trocar."""
    return solution.position_error <= PLACE_TOLERANCE and solution.trocar_error <= PLACE_TOLERANCE


def missing(solution: PoseSolution) -> str:
    """Remaining errors of joint values, for an error message."""
    away, off = solution.position_error * 1e3, solution.trocar_error * 1e3
    return f"its tip stays {away:.3f} mm away, its shaft {off:.3f} mm off the trocar"


def millimetres(point: FloatArray) -> str:
    """Position in millimetres, for a message."""
    return "(" + ", ".join(f"{value * 1e3:.1f}" for value in point) + ") mm"
