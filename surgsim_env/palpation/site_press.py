"""A press at one site as a few control steps, so that compiled code, or lanes of organs side by side, make it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.lane_group import LaneGroup
from surgsim_env.palpation.scan import AVERAGE_TIME, HOLD_TIME, PRESS_SPEED
from surgsim_env.scenes import Limits, Scene
from surgsim_env.simulation import Simulation

# The mean over the end of the hold is taken from readings this far apart [s].
READING_TIME = 0.010


@dataclass(frozen=True)
class PressPhase:
    """A part of a press.

    Args:
        count: haptic steps.
        inward: the tip goes in; else it rests.
        force_limit: ends it with the haptic step whose force passes this [N].
        read: force and depth are read at its end.
    """

    count: int
    inward: bool
    force_limit: float
    read: bool = False


@dataclass(frozen=True, eq=False)
class PressResult:
    """What came of a press.

    Fields:
        force: of the tissue on the tip, mean of the readings at the end of the hold [N]           (3,)
        depth: of the tip below the resting surface along the normal, likewise [m]
        force_peak: largest contact force of any haptic step [N]
        stopped: the way in ended by force before it ended by depth
        fault: what the simulation came to, or an empty string
        duration: simulated time [s]
        workspace_limited: the instrument could not go where it was told, in any part of the press
    """

    force: FloatArray
    depth: float
    force_peak: float
    stopped: bool
    fault: str
    duration: float
    workspace_limited: bool = False


def stop_force(limits: Limits) -> float:
    """The contact force that ends the way in [N]: half way from the soft to the hard limit.

    So that no press passes the hard limit by being made as it is told, however stiff what lies under it.
    """
    return 0.5 * (limits.soft_force + limits.hard_force)


def press_phases(scene: Scene) -> tuple[PressPhase, ...]:
    """The press of `palpation.scan`, as control steps: in to the scene's depth or `stop_force`, hold, read."""
    dt, longest = scene.timing.haptic_step, scene.timing.haptic_steps_per_control
    inward = round((scene.palpation.clearance + scene.palpation.press_depth) / (PRESS_SPEED * dt))
    apart, readings = max(1, round(READING_TIME / dt)), round(AVERAGE_TIME / READING_TIME)
    still = round(HOLD_TIME / dt) - (readings - 1) * apart
    hard, stop = scene.limits.hard_force, stop_force(scene.limits)
    phases = [PressPhase(count, True, stop) for count in _parts(inward, longest)]
    phases += [PressPhase(count, False, hard) for count in _parts(still, longest)]
    phases[-1] = PressPhase(phases[-1].count, False, hard, read=True)
    return (*phases, *[PressPhase(apart, False, hard, read=True)] * (readings - 1))


def _parts(count: int, most: int) -> list[int]:
    whole, rest = divmod(count, most)
    return [most] * whole + [rest] * (rest > 0)


class SitePress:
    """One press under way: for each phase `begin`, a control step of its simulation, `end`."""

    def __init__(self, simulation: Simulation, point: FloatArray, normal: FloatArray) -> None:
        """Put the organ at rest and the tip over a surface point [m] (3,), along its unit outward normal (3,)."""
        scene = simulation.anatomy.scene
        self.simulation, self.point, self.normal = simulation, point, normal
        self._radius = scene.instrument.tip_radius
        self._hard_force = scene.limits.hard_force
        self._readings: list[tuple[FloatArray, float]] = []
        self._force_peak = 0.0
        self._stopped = self._over = self._limited = False
        simulation.restart(point + normal * (self._radius + scene.palpation.clearance))

    def begin(self, phase: PressPhase) -> bool:
        """Command what a phase asks for; False where this press has no such phase any more."""
        if self._over or (phase.inward and self._stopped):
            return False
        # A velocity is good for one control step: an arm's joint speeds are found anew.
        velocity = -PRESS_SPEED * self.normal if phase.inward else np.zeros(3)
        self.simulation.instrument.command_velocity(velocity)
        return True

    def end(self, phase: PressPhase, force_peak: float) -> None:
        """Note what a phase came to, whose largest contact force was `force_peak` [N]."""
        self._force_peak = max(self._force_peak, force_peak)
        self._limited |= self.simulation.instrument.workspace_limited
        if self.simulation.fault or not self.simulation.end_control_step():
            self._over = True
            return
        self._stopped |= phase.inward and force_peak > phase.force_limit
        self._over = force_peak > self._hard_force
        if phase.read or self._over:
            below = (self.point - self.simulation.instrument.tip_position) @ self.normal + self._radius
            self._readings.append((self.simulation.contact_force, float(below)))

    def result(self) -> PressResult:
        """What came of it; after a fault force and depth are 0."""
        fault = self.simulation.fault
        readings = self._readings if not fault else [(np.zeros(3), 0.0)]
        return PressResult(
            force=np.mean([force for force, _ in readings], axis=0),
            depth=float(np.mean([depth for _, depth in readings])),
            force_peak=self._force_peak,
            stopped=self._stopped,
            fault=fault,
            duration=self.simulation.time,
            workspace_limited=self._limited,
        )


def press_alone(press: SitePress, phases: Sequence[PressPhase]) -> PressResult:
    """Make a press with its simulation alone."""
    for phase in phases:
        if press.begin(phase):
            press.end(phase, press.simulation.control_step(phase.count, phase.force_limit))
    return press.result()


def press_in_lanes(group: LaneGroup, presses: Sequence[SitePress | None], phases: Sequence[PressPhase]) -> None:
    """Make a press with each simulation of a group side by side, None for none; `result` tells what came of each."""
    for phase in phases:
        moving = [press for press in presses if press is not None and press.begin(phase)]
        if not moving:
            continue
        group.control_step(np.array([press in moving for press in presses]), phase.count, phase.force_limit)
        for press in moving:
            # It was made among others: this only tells what came of it.
            press.end(phase, press.simulation.control_step(phase.count, phase.force_limit))
