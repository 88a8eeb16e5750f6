"""Inverse kinematics by damped least squares, tasks in order of priority, within joint and speed limits.

The order is: trocar (for an arm without a fixed remote centre), position of the tip, direction of the tip. Each task
uses only the null space of those before it (Siciliano & Slotine 1991). A joint that would exceed a limit is held there
and the others are solved again (saturation in the null space, Flacco et al. 2012, joint by joint).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import arctan2, cos, eigh, matmul, norm, sin, svd
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.arm.arm import Arm
from surgsim_env.scene.palpable_surface import tangent_axes

# Share of the largest singular value below which others leave the null space unchanged; damping limits them.
RANK_SHARE = 1e-6
DAMPING_LEAST = 1e-12
# Largest joint motion in one Newton step of `solve_pose`, in seconds at the speed limits.
STRIDE = 0.15
ITERATIONS = 100
# Tolerances of a reached pose: [m], [rad].
POSITION_TOLERANCE = 1e-9
ANGLE_TOLERANCE = 1e-6
# Shares of the path tried by `follow` before it stands still.
SHARES = (1.0, 0.5, 0.25, 0.125)
# Largest turn rate of the tip in `follow` [rad/s], and its Newton steps with a turn; the others correct the position.
TURN_RATE = 1.0
TURNING_STEPS, NEWTON_STEPS = 2, 9


@dataclass(frozen=True)
class KinematicTask:
    """Linear condition on joint steps (n,): jacobian (m, n) times the steps equals error (m,)."""

    jacobian: FloatArray
    error: FloatArray


@dataclass(frozen=True)
class PoseSolution:
    """Result of a search for joint values.

    Args:
        joints: values [rad or m], (n,).
        position_error: distance of the tip from its target [m].
        angle_error: angle between the tip's direction (or frame) and its target [rad]; 0 without a target.
        trocar_error: distance of the shaft's axis from the trocar beyond the arm's `trocar_play` [m].
        reached: True if all three are within tolerance.
    """

    joints: FloatArray
    position_error: float
    angle_error: float
    trocar_error: float
    reached: bool


@dataclass(frozen=True)
class Target:
    """Target position of the tip [m] (3,), and at most one of its direction (3,) and its frame (3, 3)."""

    position: FloatArray
    direction: FloatArray | None = None
    rotation: FloatArray | None = None


def prioritised_step(tasks: list[KinematicTask], lower: FloatArray, upper: FloatArray, scale: FloatArray) -> FloatArray:
    """Joint steps within [lower, upper] (n,) for the tasks in order of priority; scale (n,) weights the joints."""
    step = np.zeros(len(scale))
    free = np.ones(len(scale), dtype=bool)
    while free.any():
        held = [
            KinematicTask(task.jacobian[:, free], task.error - matmul(task.jacobian[:, ~free], step[~free]))
            for task in tasks
        ]
        step[free] = _cascade(held, scale[free])
        beyond = np.maximum(lower - step, step - upper) / scale
        worst = int(np.argmax(np.where(free, beyond, -np.inf)))
        if beyond[worst] <= 1e-15:
            break
        step[worst] = min(max(step[worst], lower[worst]), upper[worst])
        free[worst] = False
    return step


def _cascade(tasks: list[KinematicTask], scale: FloatArray) -> FloatArray:
    """Steps of free joints: each task by damped least squares in the null space of those before it.

    The damping grows with the error (Sugihara 2011), lambda^2 = |e|^2 + DAMPING_LEAST: steps to far targets are
    small and near ones converge at Newton's rate.
    """
    step = np.zeros(len(scale))
    idle = np.eye(len(scale))
    for task in tasks:
        jacobian = task.jacobian * scale
        left, size, right = svd(matmul(jacobian, idle))
        missing = task.error - matmul(jacobian, step)
        damping = float(matmul(missing, missing)) + DAMPING_LEAST
        step = step + matmul(right.T, size / (size * size + damping) * matmul(left.T, missing))
        moved = right[size > RANK_SHARE * max(float(size.max(initial=0.0)), 1e-9)]
        idle = idle - matmul(moved.T, moved)
    return step * scale


def tip_tasks(arm: Arm, joints: FloatArray, target: Target) -> list[KinematicTask]:
    """Tasks of the trocar (unless the mechanism keeps it), position and direction of the tip, at joint values (n,)."""
    tasks = []
    if not arm.remote_centre_fixed:
        error, jacobian = arm.trocar_task(joints)
        tasks.append(KinematicTask(jacobian, error))
    jacobian = arm.tip_jacobian(joints)
    tasks.append(KinematicTask(jacobian[:3], target.position - arm.tip_pose(joints).position))
    if target.rotation is not None:
        tasks.append(KinematicTask(jacobian[3:], _turn_between(arm.tip_pose(joints).rotation, target.rotation)))
    elif target.direction is not None:
        now = arm.tip_direction(joints)
        across = np.stack(tangent_axes(now))
        tasks.append(KinematicTask(matmul(across, jacobian[3:]), matmul(across, turn_towards(now, target.direction))))
    return tasks


def turn_towards(now: FloatArray, goal: FloatArray) -> FloatArray:
    """Smallest rotation vector from one unit vector to another, (3,) [rad]."""
    axis = np.cross(now, goal)
    sine, cosine = float(norm(axis)), float(matmul(now, goal))
    if sine < 1e-12:
        # Opposite vectors: any perpendicular axis.
        return np.zeros(3) if cosine > 0.0 else np.pi * tangent_axes(now)[0]
    return axis / sine * arctan2(sine, cosine)


def _turn_between(now: FloatArray, goal: FloatArray) -> FloatArray:
    """Rotation vector from one frame (3, 3) to another, (3,) [rad]."""
    turn = matmul(goal, now.T)
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine, cosine = float(norm(axis)), 0.5 * (float(np.trace(turn)) - 1.0)
    if sine < 1e-9 and cosine < 0.0:
        return np.pi * eigh(0.5 * (turn + turn.T))[1][:, -1]
    return axis * (arctan2(sine, cosine) / sine if sine > 1e-12 else 1.0)


def _judge(arm: Arm, joints: FloatArray, target: Target) -> PoseSolution:
    pose = arm.tip_pose(joints)
    position = float(norm(target.position - pose.position))
    angle = 0.0
    if target.rotation is not None:
        angle = float(norm(_turn_between(pose.rotation, target.rotation)))
    elif target.direction is not None:
        angle = float(norm(turn_towards(arm.tip_direction(joints), target.direction)))
    trocar = max(arm.trocar_residual(joints) - arm.trocar_play, 0.0)
    reached = position <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE and trocar <= POSITION_TOLERANCE
    return PoseSolution(joints, position, angle, trocar, reached)


def _target(position: ArrayLike, direction: ArrayLike | None, rotation: ArrayLike | None) -> Target:
    unit = None if direction is None else np.asarray(direction, dtype=np.float64)
    if unit is not None:
        unit = unit / norm(unit)
    frame = None if rotation is None else np.asarray(rotation, dtype=np.float64)
    return Target(np.asarray(position, dtype=np.float64), unit, frame)


def solve_pose(
    arm: Arm,
    position: ArrayLike,
    *,
    direction: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    start: ArrayLike | None = None,
    iterations: int = ITERATIONS,
) -> PoseSolution:
    """Joint values within the limits for the tip at a position [m], by damped Newton steps from a start (n,).

    Args:
        arm: with the tip.
        position: of the tip [m], (3,).
        direction: of the tip (3,), or
        rotation: frame of the tip (3, 3).
        start: initial joint values, home by default; others may converge better.
        iterations: largest number of steps.
    """
    target = _target(position, direction, rotation)
    joints = (arm.home if start is None else np.asarray(start, dtype=np.float64)).clip(arm.lower, arm.upper)
    best = _judge(arm, joints, target)
    still = 0
    for _ in range(iterations):
        if best.reached or still > 12:
            break
        stride = STRIDE * arm.speed_limit
        lower, upper = np.maximum(arm.lower - joints, -stride), np.minimum(arm.upper - joints, stride)
        step = prioritised_step(tip_tasks(arm, joints, target), lower, upper, arm.speed_limit)
        joints = (joints + step).clip(arm.lower, arm.upper)
        solution = _judge(arm, joints, target)
        still = 0 if _total_error(solution) < 0.999 * _total_error(best) else still + 1
        best = min(best, solution, key=_total_error)
    return best


def _total_error(solution: PoseSolution) -> float:
    """Sum of the errors [m]; 1 rad of direction counts as 10 mm."""
    return solution.trocar_error + solution.position_error + 0.01 * solution.angle_error


def reach_pose(
    arm: Arm,
    position: ArrayLike,
    *,
    direction: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    starts: int = 6,
) -> PoseSolution:
    """Best `solve_pose` from home and, until the pose is reached, from other fixed starts."""
    best = solve_pose(arm, position, direction=direction, rotation=rotation)
    shares = np.random.default_rng(0).random((starts, arm.joint_count))
    for share in shares:
        if best.reached:
            break
        start = arm.lower + (0.1 + 0.8 * share) * (arm.upper - arm.lower)
        solution = solve_pose(arm, position, direction=direction, rotation=rotation, start=start)
        best = min(best, solution, key=_total_error)
    return best


@dataclass(frozen=True)
class FollowStep:
    """Step along a path: joint values at its end (n,), and True if limits shortened it."""

    joints: FloatArray
    limited: bool


def follow(
    arm: Arm,
    joints: FloatArray,
    position: FloatArray,
    direction: FloatArray | None,
    duration: float,
    *,
    rotation: FloatArray | None = None,
) -> FollowStep:
    """Joint values after `duration` [s] for the tip at a nearby position [m], turned as far as possible.

    The tip turns to a direction (3,) or to a frame `rotation` (3, 3), within joint and speed limits. If the limits do
    not permit the position, the tip goes an eighth to half of the path, or stays, and never leaves the line. A trocar
    without a fixed remote centre has the highest priority.
    """
    pose = arm.tip_pose(joints)
    now = pose.position
    reach = arm.speed_limit * duration
    lower, upper = np.maximum(arm.lower, joints - reach), np.minimum(arm.upper, joints + reach)
    if direction is not None:
        direction = _turned(arm.tip_direction(joints), direction, TURN_RATE * duration)
    if rotation is not None:
        rotation = frame_towards(pose.rotation, rotation, TURN_RATE * duration)
    for share in SHARES:
        solution = _newton(arm, joints, Target(now + share * (position - now), direction, rotation), lower, upper)
        if solution is not None:
            return FollowStep(solution, share < 1.0)
    return FollowStep(joints.copy(), True)


def _turned(now: FloatArray, goal: FloatArray, most: float) -> FloatArray:
    """Unit vector turned towards another by at most an angle [rad], (3,)."""
    turn = turn_towards(now, goal)
    angle = float(norm(turn))
    if angle <= most:
        return goal
    across = np.cross(turn / angle, now)
    return cos(most) * now + sin(most) * across


def frame_towards(now: FloatArray, goal: FloatArray, most: float) -> FloatArray:
    """Frame turned towards another by at most an angle [rad], (3, 3)."""
    turn = _turn_between(now, goal)
    angle = float(norm(turn))
    return goal if angle <= most else matmul(turn_matrix(turn * (most / angle)), now)


def turn_matrix(turn: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a rotation vector [rad] (3,), by Rodrigues' formula."""
    angle = float(norm(turn))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * matmul(cross, cross)


def _newton(arm: Arm, start: FloatArray, target: Target, lower: FloatArray, upper: FloatArray) -> FloatArray | None:
    """Newton steps to a near target within limits; None if position or trocar is not reached."""
    joints, placed = start, Target(target.position)
    for iteration in range(NEWTON_STEPS):
        turning = iteration < TURNING_STEPS and (target.direction is not None or target.rotation is not None)
        tasks = tip_tasks(arm, joints, target if turning else placed)
        if not turning and all(norm(task.error) <= POSITION_TOLERANCE for task in tasks):
            return joints
        step = prioritised_step(tasks, lower - joints, upper - joints, arm.speed_limit)
        joints = (joints + step).clip(lower, upper)
    return None
