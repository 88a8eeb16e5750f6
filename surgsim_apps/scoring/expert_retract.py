"""A scripted expert for SurgSim/Retract-v0 without state: each action is a function of the observation.

It performs the procedure of `surgsim_env.scripting.oracle`, but can act in any state that a learning agent reaches, as
DAgger requires of an expert (Ross et al. 2011). It is written for the scene `lobe` with its own grasper, whose wrist
turns about one hinge.
"""

import math

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import arctan2, norm
from surgsim_env.tasks import RetractTask, channel_slices

SPEED = 0.02  # [m/s] full scale of an action's velocity
TURNING = 0.5  # [rad/s] full scale of the wrist
CONTROL_STEP = 0.05  # [s]

# Entries of the observation, of an instrument with one hinge: channels of numbers and vectors, then single numbers.
SLICES = channel_slices(RetractTask, tip_axes=6)
TIP, EDGE, TARGET = (SLICES[name] for name in ("tip_position", "edge_points", "target_place"))
POINTS_ALONG = slice(SLICES["tip_axes"].start + 3, SLICES["tip_axes"].stop)
GAP, GRIP, PULL, HOLDS, VISIBLE = (
    SLICES[name].start for name in ("opening", "grip_force", "pull_force", "holds", "visible")
)

# Distance of the waiting jaw from the free edge; depth of its middle over the edge in a grasp [m].
WAITING_GAP, GRASP_DEPTH = 0.016, 0.0065
# Least distance of the pads from the bed's end [m].
NEAREST = 0.0475
# From the lobe's top to the middle of its thickness, for a free edge that sags slightly [m].
HALF_THICKNESS = 0.006
# Largest offset from the approach line; distance from the goal at which the jaw closes [m].
ALIGNED, ARRIVED = 0.0015, 0.0008
# A jaw that has begun to close (gap below OPEN_GAP) within NEAR_GRASP of the grasp keeps closing [m].
OPEN_GAP, NEAR_GRASP = 0.0195, 0.004
GRIP_FORCE = 0.22  # [N] it lifts above this grip
# Goals of the tip with the edge, y and z [m]: first up, then over.
RISEN, FOLDED = (0.0465, 0.031), (0.024, 0.050)
SEEN_ENOUGH = 0.9
# Share of the target that must be visible for its place to be seen.
IN_SIGHT = 0.1
CARRYING_SPEED, APPROACH_SPEED = 0.015, 0.015
# For a teacher of policies that see pictures: how far from the middle along the edge it grasps; the offset in height up
# to which it goes straight in, and from which it waits before the edge; how far from the grasp it closes the jaw, too
# far out, too far in and in height; and how far off a jaw that has begun to close goes on [m].
ALONG_SLACK, HEIGHT_FREE, HEIGHT_WAITING = 0.008, 0.002, 0.005
CLOSES_OUT, CLOSES_IN, CLOSES_HIGH, CLOSING_REACH = 0.001, 0.0015, 0.003, 0.007
# Pull above which it gives way [N], with the edge between its pads and without: `RetractExpert` peaks at 0.41 N in a
# mean episode, tissue tears at 1.2 N.
PULL_MOST, PUSH_MOST = 0.7, 0.45


class RetractExpert:
    """Waits before the edge above the target, encloses and grips it, lifts, folds, and holds once enough is visible.

    It reads SI units: the environment is made with `scaled=False`.
    """

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The action (5,) for an observation (56,) in SI units."""
        now = np.asarray(observation, dtype=np.float64)
        velocity, turning, jaw = self._carry(now) if self._grasped(now) else self._approach(now)
        return np.concatenate([velocity / SPEED, [turning / TURNING, jaw]]).clip(-1.0, 1.0).astype(np.float32)

    def act_all(self, observations: NDArray[np.floating], begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Actions (n, 5) for observations (n, 56) of several environments; `begins` is not used."""
        return np.array([self.act(observation) for observation in observations])

    def _grasped(self, now: NDArray[np.float64]) -> bool:
        return bool(now[HOLDS] > 0.5 and now[GRIP] > 0.0)

    def _aside(self, now: NDArray[np.float64]) -> float:
        """Where along the edge the lobe is carried [m]."""
        return float(now[TIP][0])

    def _carry(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        tip, still = now[TIP], np.zeros(3)
        if now[GRIP] < GRIP_FORCE and now[GAP] > 0.0045 and tip[2] < 0.012:
            return still, 0.0, -1.0
        if now[VISIBLE] >= SEEN_ENOUGH:
            return still, 0.0, -1.0
        goal = RISEN if tip[2] < RISEN[1] - 0.002 and tip[1] > 0.040 else FOLDED
        velocity = towards(np.array([self._aside(now), *goal]) - tip, CARRYING_SPEED)
        return velocity, _levelling(now), -1.0

    def _approach(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        tip, grasp = now[TIP], grasp_place(now)
        off = grasp - tip
        waiting = np.array([grasp[0], grasp[1] + GRASP_DEPTH + WAITING_GAP, grasp[2]])
        across = math.hypot(off[0], off[2])
        turning = _levelling(now)
        closing = now[GAP] < OPEN_GAP and norm(off) < NEAR_GRASP
        if norm(off) < ARRIVED or closing:
            return 0.2 * off / CONTROL_STEP, turning, -1.0
        if across < ALIGNED or (across < 2.0 * ALIGNED and tip[1] < waiting[1] - 0.002):
            return towards(off, APPROACH_SPEED), turning, 1.0
        if tip[1] < waiting[1] - 0.004:
            # Off its line: first straight away from the edge.
            return np.array([0.0, SPEED, 0.0]), turning, 1.0
        return towards(waiting - tip, SPEED), turning, 1.0


class TolerantExpert(RetractExpert):
    """A teacher of policies that see pictures: what it does changes little where a picture changes little.

    It does not know where the target is hidden. It grasps near the middle of the edge, approaches it in a funnel, so
    that it need not be aligned to a millimetre, and shifts the lobe above the target once some of that is in sight. It
    leaves the wrist as it is: the jaw begins level, and a picture does not show a tilt of two degrees. It gives way
    where it pulls hard, back to where it came from, and with an open jaw where that does not hold the edge: what a
    policy does wrong, the force tells it.
    """

    def __init__(self, *, grasp_along: float) -> None:
        """Grasp the edge within ALONG_SLACK of a place along it [m]."""
        self._grasp_along = grasp_along

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """As `RetractExpert.act`, without turning the wrist."""
        action = super().act(observation)
        action[3] = 0.0
        return action

    def _carry(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        if now[PULL] > PULL_MOST:
            return towards(np.array([now[TIP][0], *RISEN]) - now[TIP], CARRYING_SPEED), 0.0, -1.0
        return super()._carry(now)

    def _aside(self, now: NDArray[np.float64]) -> float:
        return float(now[TIP][0] if now[VISIBLE] < IN_SIGHT else now[TARGET][0])

    def _approach(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        if now[PULL] > PUSH_MOST:
            return np.array([0.0, APPROACH_SPEED, 0.0]), 0.0, 1.0
        tip = now[TIP]
        nearest = float(np.clip(tip[0], self._grasp_along - ALONG_SLACK, self._grasp_along + ALONG_SLACK))
        off = grasp_place(now, nearest) - tip
        arrived = abs(off[2]) < CLOSES_HIGH and -CLOSES_OUT < off[1] < CLOSES_IN
        closing = now[GAP] < OPEN_GAP and float(norm(off)) < CLOSING_REACH
        if arrived or closing:
            return 0.2 * off / CONTROL_STEP, _levelling(now), -1.0
        share = (math.hypot(off[0], off[2]) - HEIGHT_FREE) / (HEIGHT_WAITING - HEIGHT_FREE)
        out = (GRASP_DEPTH + WAITING_GAP) * min(max(share, 0.0), 1.0)
        return towards(off + np.array([0.0, out, 0.0]), APPROACH_SPEED), _levelling(now), 1.0


def grasp_place(now: NDArray[np.float64], along: float | None = None) -> NDArray[np.float64]:
    """Place where the tip grasps the free edge [m] (3,), from the observed points of the edge.

    It lies above the target, or at a place along the edge [m].
    """
    edge = now[EDGE].reshape(5, 3)
    along = float(now[TARGET][0]) if along is None else along
    border = float(np.interp(along, edge[:, 0], edge[:, 1]))
    top = float(np.interp(along, edge[:, 0], edge[:, 2]))
    return np.array([along, max(border - GRASP_DEPTH, NEAREST), top - HALF_THICKNESS])


def towards(gap: NDArray[np.float64], speed: float) -> NDArray[np.float64]:
    """A velocity along a remaining way [m], slower on its last millimetre, because the tip lags behind its command."""
    distance = float(norm(gap))
    return gap * (min(speed, 0.6 * distance / CONTROL_STEP) / max(distance, 1e-9))


def _levelling(now: NDArray[np.float64]) -> float:
    """Angular velocity of the wrist that levels the jaw [rad/s]; above 0 its pads sink."""
    _, y, z = now[POINTS_ALONG]
    return -0.6 * float(arctan2(-z, -y)) / CONTROL_STEP
