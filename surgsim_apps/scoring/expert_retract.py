"""A scripted expert for SurgSim/Retract-v0 without state: each action is a function of the observation.

It performs the procedure of `surgsim_env.scripting.oracle`, but can act in any state of a learning agent, as DAgger
requires of an expert (Ross et al. 2011). It is written for the scene `lobe` with its own grasper, whose wrist turns
about one hinge.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import arctan2, norm
from surgsim_env.tasks import RetractTask, channel_slices

# Entries of the observation, of an instrument with one hinge: channels of numbers and vectors, then single numbers.
SLICES = channel_slices(RetractTask, tip_axes=6)
TIP, EDGE, TARGET = (SLICES[name] for name in ("tip_position", "edge_points", "target_place"))
POINTS_ALONG = slice(SLICES["tip_axes"].start + 3, SLICES["tip_axes"].stop)
GAP, GRIP, PULL, HOLDS, VISIBLE = (
    SLICES[name].start for name in ("opening", "grip_force", "pull_force", "holds", "visible")
)


@dataclass(frozen=True)
class RetractPlan:
    """Numbers of the procedure [m, s, N] on the scene `lobe`; without a reason given, chosen by trial.

    Fields:
        speed, turning: full scale of an action's velocity [m/s] and of the wrist [rad/s] (RetractTask)
        control_step: of the scene
        waiting_gap: of the waiting jaw from the free edge
        grasp_depth: of the tip behind the edge in a grasp; pads reach 7 mm beyond the tip (grasper.xml)
        nearest: least y of the tip in a grasp: the pads stop 2 mm before the bed's end at 38.5 mm
        half_thickness: from the top of a 12 mm lobe to its middle; its free edge sags slightly
        aligned: largest offset from the approach line for going straight in
        arrived: distance from the grasp for closing the jaw
        open_gap, near_grasp: a jaw narrower than open_gap (it opens to 20 mm) this near to the grasp goes on closing
        closed_gap, low: before the first lift (tip below `low`) it waits for grip; the jaw's stop is at 4 mm
        grip: force for lifting; pads press with at most 0.5 N
        risen, folded: goals of the tip with the edge, y and z: first up, then over
        seen_enough: visible share of the target for holding still; the task asks for 0.8
        in_sight: visible share of the target for knowing its place
        travel: speed with the lobe, and into the grasp [m/s]
        along_slack: of the tolerant expert's grasp along the edge
        height_free, height_waiting: its offset in height for going straight in, and for waiting before the edge
        closes_out, closes_in, closes_high: its distances from the grasp for closing: outwards, inwards, in height
        closing_reach: its near_grasp
        pull_most, push_most: force for giving way, with the edge between its pads and without; the plain expert peaks
            at 0.41 N in a mean episode, tissue tears at 1.2 N
    """

    speed: float = 0.02
    turning: float = 0.5
    control_step: float = 0.05
    waiting_gap: float = 0.016
    grasp_depth: float = 0.0065
    nearest: float = 0.0475
    half_thickness: float = 0.006
    aligned: float = 0.0015
    arrived: float = 0.0008
    open_gap: float = 0.0195
    near_grasp: float = 0.004
    closed_gap: float = 0.0045
    low: float = 0.012
    grip: float = 0.22
    risen: tuple[float, float] = (0.0465, 0.031)
    folded: tuple[float, float] = (0.024, 0.050)
    seen_enough: float = 0.9
    in_sight: float = 0.1
    travel: float = 0.015
    along_slack: float = 0.008
    height_free: float = 0.002
    height_waiting: float = 0.005
    closes_out: float = 0.001
    closes_in: float = 0.0015
    closes_high: float = 0.003
    closing_reach: float = 0.007
    pull_most: float = 0.7
    push_most: float = 0.45


PLAN = RetractPlan()


class RetractExpert:
    """Waits before the edge above the target, encloses and grips it, lifts, folds, and holds once enough is visible.

    It reads SI units: the environment is made with `scaled=False`.
    """

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The action (5,) for an observation (56,) in SI units."""
        now = np.asarray(observation, dtype=np.float64)
        velocity, turning, jaw = self._carry(now) if now[HOLDS] > 0.5 and now[GRIP] > 0.0 else self._approach(now)
        action = np.concatenate([velocity / PLAN.speed, [turning / PLAN.turning, jaw]])
        return action.clip(-1.0, 1.0).astype(np.float32)

    def act_all(self, observations: NDArray[np.floating], begins: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Actions (n, 5) for observations (n, 56) of several environments; `begins` is not used."""
        return np.array([self.act(observation) for observation in observations])

    def _aside(self, now: NDArray[np.float64]) -> float:
        """Place along the edge of the carried lobe [m]."""
        return float(now[TIP][0])

    def _carry(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        tip, still = now[TIP], np.zeros(3)
        closing = now[GRIP] < PLAN.grip and now[GAP] > PLAN.closed_gap and tip[2] < PLAN.low
        if closing or now[VISIBLE] >= PLAN.seen_enough:
            return still, 0.0, -1.0
        goal = PLAN.risen if tip[2] < PLAN.risen[1] - 0.002 and tip[1] > 0.040 else PLAN.folded
        return towards(np.array([self._aside(now), *goal]) - tip, PLAN.travel), _levelling(now), -1.0

    def _approach(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        tip, grasp = now[TIP], grasp_place(now)
        off = grasp - tip
        waiting = np.array([grasp[0], grasp[1] + PLAN.grasp_depth + PLAN.waiting_gap, grasp[2]])
        across = math.hypot(off[0], off[2])
        turning = _levelling(now)
        closing = now[GAP] < PLAN.open_gap and norm(off) < PLAN.near_grasp
        if norm(off) < PLAN.arrived or closing:
            return 0.2 * off / PLAN.control_step, turning, -1.0
        if across < PLAN.aligned or (across < 2.0 * PLAN.aligned and tip[1] < waiting[1] - 0.002):
            return towards(off, PLAN.travel), turning, 1.0
        if tip[1] < waiting[1] - 0.004:
            # Off its line: first straight away from the edge.
            return np.array([0.0, PLAN.speed, 0.0]), turning, 1.0
        return towards(waiting - tip, PLAN.speed), turning, 1.0


class TolerantExpert(RetractExpert):
    """A teacher of policies that see pictures: similar pictures get similar actions.

    It does not know the hidden target's place. It grasps near the middle of the edge, approaches it in a funnel, so
    that it need not be aligned to a millimetre, and shifts the lobe above the target once some of that is in sight. It
    leaves the wrist alone: the jaw begins level, and a picture does not show a tilt of two degrees. At a hard pull it
    gives way, back the way it came, with an open jaw if that does not hold the edge: the force reveals a policy's
    mistakes.
    """

    def __init__(self, *, grasp_along: float) -> None:
        """Grasp the edge near a place along it [m]."""
        self._grasp_along = grasp_along

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """As `RetractExpert.act`, without turning the wrist."""
        action = super().act(observation)
        action[3] = 0.0
        return action

    def _carry(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        if now[PULL] > PLAN.pull_most:
            return towards(np.array([now[TIP][0], *PLAN.risen]) - now[TIP], PLAN.travel), 0.0, -1.0
        return super()._carry(now)

    def _aside(self, now: NDArray[np.float64]) -> float:
        return float(now[TIP][0] if now[VISIBLE] < PLAN.in_sight else now[TARGET][0])

    def _approach(self, now: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
        if now[PULL] > PLAN.push_most:
            return np.array([0.0, PLAN.travel, 0.0]), 0.0, 1.0
        tip = now[TIP]
        nearest = float(np.clip(tip[0], self._grasp_along - PLAN.along_slack, self._grasp_along + PLAN.along_slack))
        off = grasp_place(now, nearest) - tip
        arrived = abs(off[2]) < PLAN.closes_high and -PLAN.closes_out < off[1] < PLAN.closes_in
        closing = now[GAP] < PLAN.open_gap and float(norm(off)) < PLAN.closing_reach
        if arrived or closing:
            return 0.2 * off / PLAN.control_step, _levelling(now), -1.0
        share = (math.hypot(off[0], off[2]) - PLAN.height_free) / (PLAN.height_waiting - PLAN.height_free)
        out = (PLAN.grasp_depth + PLAN.waiting_gap) * min(max(share, 0.0), 1.0)
        return towards(off + np.array([0.0, out, 0.0]), PLAN.travel), _levelling(now), 1.0


def grasp_place(now: NDArray[np.float64], along: float | None = None) -> NDArray[np.float64]:
    """Place of the tip in a grasp of the free edge [m] (3,), from the observed points of the edge.

    It lies above the target, or at a place along the edge [m].
    """
    edge = now[EDGE].reshape(5, 3)
    along = float(now[TARGET][0]) if along is None else along
    border = float(np.interp(along, edge[:, 0], edge[:, 1]))
    top = float(np.interp(along, edge[:, 0], edge[:, 2]))
    return np.array([along, max(border - PLAN.grasp_depth, PLAN.nearest), top - PLAN.half_thickness])


def towards(gap: NDArray[np.float64], speed: float) -> NDArray[np.float64]:
    """A velocity along a remaining way [m], slower on its last millimetre, because the tip lags behind its command."""
    distance = float(norm(gap))
    return gap * (min(speed, 0.6 * distance / PLAN.control_step) / max(distance, 1e-9))


def _levelling(now: NDArray[np.float64]) -> float:
    """Angular velocity of the wrist that levels the jaw [rad/s]; above 0 its pads sink."""
    _, y, z = now[POINTS_ALONG]
    return -0.6 * float(arctan2(-z, -y)) / PLAN.control_step
