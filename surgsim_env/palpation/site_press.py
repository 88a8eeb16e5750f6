"""Presses along the surface normal in phases, executed by one simulation, in lanes or in threads."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from msdm_core.arithmetic import log, matmul, norm
from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.measure import TissueLoad
from surgsim_env.coupling.lane_group import LaneGroup, core_count
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.coupling.tracking import SurfaceTracker
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.model import Limits, Scene

# Speed of the tip inward [m/s], longest rest at depth [s], and averaging time of force at the end of the rest [s].
PRESS_SPEED = 0.04
HOLD_TIME = 0.10
AVERAGE_TIME = 0.04
# Interval between commands of a tip on a moving surface [s].
FOLLOWING_TIME = 0.010
# Interval of the averaged readings of `press_phases` [s]; `recorded_phases` reads in each haptic step.
READING_TIME = 0.010
# Number of averaged readings.
READINGS = round(AVERAGE_TIME / READING_TIME)

# Part of the way inward, in final depths, on which the slope of a press is measured; beyond it the tip brakes.
SLOPE_DEPTHS = (0.75, 0.97)

Tool = TypeVar("Tool")
Result = TypeVar("Result")


@dataclass(frozen=True)
class PressPhase:
    """Part of a press, executed in one call.

    Args:
        count: haptic steps.
        inward: True for motion inward, False for rest.
        force_limit: contact force [N] beyond which the phase ends.
        read: True for a reading of force and depth at its end.
        command: haptic steps from the phase's start until the next command of the instrument's velocity; 0 continues
            the previous command.
        settles: True for a press that ends here if its last READINGS readings agree.
    """

    count: int
    inward: bool
    force_limit: float
    read: bool = False
    command: int = 0
    settles: bool = False


@dataclass(frozen=True, eq=False)
class PressResult:
    """Outcome of a press.

    Fields:
        force: of the tissue on the tip, mean of the last READINGS readings [N]                    (3,)
        depth: of the tip below the rest surface (carried by its ground) along the normal, mean of the same readings [m]
        force_peak: largest contact force of any haptic step [N]
        stopped: True if force ended the motion inward before depth did
        fault: fault of the simulation, or an empty string
        duration: simulated time [s]
        workspace_limited: True if the instrument was stopped at a limit in a phase
        taxels: forces on the taxels, mean of the last READINGS readings [N]       (n_patch, rows, columns, 3)
        taxel_places: of the last reading, from the tip's pole [m]                 (n_patch, rows, columns, 3)
    """

    force: FloatArray
    depth: float
    force_peak: float
    stopped: bool
    fault: str
    duration: float
    workspace_limited: bool = False
    taxels: FloatArray | None = None
    taxel_places: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Press:
    """Press recorded in each haptic step.

    Fields:
        site, normal: surface point [m] and unit outward normal at rest                            (3,)
        depth: of the tip below the rest surface at the end [m]
        force: along the normal, mean over the end of the hold [N]
        force_peak: largest contact force of any haptic step [N]
        curve: depth [m] and force along the normal [N] at each haptic step of contact             (n, 2)
        volume_ratio_smallest: of any tet at any substep
        load: largest contact pressure and strain of the tissue at the end
        end: reason of an early end (the hard limit or a fault); empty for a complete press
        duration: simulated time [s]
        far_travel: largest displacement at the end of a node in the organ's half farther from the site [m]
    """

    site: FloatArray
    normal: FloatArray
    depth: float
    force: float
    force_peak: float
    curve: FloatArray
    volume_ratio_smallest: float
    load: TissueLoad
    end: str
    duration: float
    far_travel: float

    @property
    def slope(self) -> float:
        """dF/dd at the end of a complete press [N/m]: n F / d, n of F ~ d^n fitted to the last of the way inward."""
        low, high = SLOPE_DEPTHS
        share = self.curve[:, 0] / self.depth
        depth, force = log(self.curve[(share > low) & (share < high)]).T
        away = depth - depth.mean()
        return float((away * force).sum() / (away * away).sum()) * self.force / self.depth


def stop_force(limits: Limits) -> float:
    """Contact force [N] at the end of `press_phases`' motion inward: half way from the soft to the hard limit.

    A press executed as commanded then stays below the hard limit on tissue of any stiffness.
    """
    return 0.5 * (limits.soft_force + limits.hard_force)


def press_phases(scene: Scene) -> tuple[PressPhase, ...]:
    """Press in few control steps: inward to the scene's depth or `stop_force`, and a hold, read every READING_TIME."""
    inward, hold, longest = _step_counts(scene)
    apart = max(1, round(READING_TIME / scene.timing.haptic_step))
    stop, hard = stop_force(scene.limits), scene.limits.hard_force
    ways = [PressPhase(count, True, stop, command=count) for count in _parts(inward, longest)]
    # Tissue that relaxes feels different after a different time.
    settles = not scene.motions and scene.material.relaxation is None
    rest = PressPhase(apart, False, hard, read=True, settles=settles, command=apart)
    return (*ways, *[rest] * (hold // apart))


def recorded_phases(scene: Scene) -> tuple[PressPhase, ...]:
    """Press with a reading in each haptic step, ended early by the hard limit alone."""
    inward, hold, longest = _step_counts(scene)
    return tuple(
        PressPhase(1, step < inward, scene.limits.hard_force, True, longest * (step == inward or step % longest == 0))
        for step in range(inward + hold)
    )


def _step_counts(scene: Scene) -> tuple[int, int, int]:
    """Haptic steps of the motion inward and of the hold, and the largest number for a command."""
    dt = scene.timing.haptic_step
    inward = round((scene.palpation.clearance + scene.palpation.press_depth) / (PRESS_SPEED * dt))
    longest = max(1, round(FOLLOWING_TIME / dt)) if scene.motions else scene.timing.haptic_steps_per_control
    return inward, round(HOLD_TIME / dt), longest


def _parts(count: int, most: int) -> list[int]:
    whole, rest = divmod(count, most)
    return [most] * whole + [rest] * (rest > 0)


class SitePress:
    """Press in progress: for each phase `begin`, a control step of its simulation, `end`.

    `readings` holds force [N] (3,) and depth [m] of each phase with a reading, and of a phase beyond the hard limit.
    A phase that `settles` ends the press once force, and depth times force over depth, have changed by at most the
    sensor's noise within AVERAGE_TIME.
    """

    def __init__(
        self,
        simulation: Simulation,
        point: FloatArray,
        normal: FloatArray,
        *,
        elapsed: float = 0.0,
        tracks: bool = True,
    ) -> None:
        """Put the organ at rest and the tip above a point of the resting surface, along its unit outward normal (3,).

        Args:
            simulation: of the organ and the tool.
            point: [m], shape (3,).
            normal: shape (3,).
            elapsed: time of the organ's motions since their draw [s].
            tracks: True for a tip on the moving surface, by a camera's markers (`SurfaceTracker`), False for a press at
                the resting point.
        """
        scene = simulation.anatomy.scene
        self.simulation, self.point, self.normal = simulation, point, normal
        self.readings: list[tuple[FloatArray, float]] = []
        self.force_peak = 0.0
        self._taxels: list[FloatArray] = []
        self._taxel_places: FloatArray | None = None
        self._radius = scene.instrument.tip_radius
        self._hard_force = scene.limits.hard_force
        self._stopped = self._over = self._limited = False
        moves = tracks and bool(scene.motions)
        start = point + simulation.ground_shift(point, elapsed) if moves else point
        simulation.restart(start + normal * (self._radius + scene.palpation.clearance), elapsed=elapsed)
        self._tracker = SurfaceTracker(simulation, np.unique(simulation.anatomy.face.triangles)) if moves else None
        # Displacement of the tip with the surface [m], its time [s], and the velocity from then on [m/s].
        self._carried, self._carried_until, self._velocity = start - point, 0.0, np.zeros(3)

    def begin(self, phase: PressPhase) -> bool:
        """Command the instrument for a phase; False for a skipped phase: the press is over, or stopped inward."""
        if self._over or (phase.inward and self._stopped):
            return False
        # A velocity is valid for one control step: an arm's joint speeds are solved anew.
        if phase.command:
            velocity = -PRESS_SPEED * self.normal if phase.inward else np.zeros(3)
            duration = phase.command * self.simulation.haptic_dt
            self.simulation.instrument.command_velocity(velocity + self._surface_velocity(duration))
        return True

    def _surface_velocity(self, duration: float) -> FloatArray:
        """Velocity of the tip with the surface over a duration [s] [m/s], (3,)."""
        if self._tracker is None:
            return self._velocity
        now = self.simulation.time
        self._carried = self._carried + (now - self._carried_until) * self._velocity
        self._carried_until = now
        if now > 0.0:
            self._tracker.look()
        self._velocity = (self._tracker.displacement(duration) - self._carried) / duration
        return self._velocity

    def end(self, phase: PressPhase) -> None:
        """Record an executed phase."""
        force_peak = self.simulation.force_peak
        self.force_peak = max(self.force_peak, force_peak)
        self._limited |= self.simulation.instrument.workspace_limited
        if self.simulation.fault or not self.simulation.end_control_step():
            self._over = True
            return
        self._stopped |= phase.inward and force_peak > phase.force_limit
        self._over = force_peak > self._hard_force
        if phase.read or self._over:
            surface = self.point + self.simulation.ground_shift(self.point)
            below = matmul(surface - self.simulation.instrument.tip_reading, self.normal) + self._radius
            self.readings.append((self.simulation.contact_force, float(below)))
            if (patches := self.simulation.instrument.patches) is not None:
                self._taxels.append(patches.forces)
                self._taxel_places = patches.places - self._pole
            self._over |= phase.settles and self._settled()

    def _settled(self) -> bool:
        """True if the readings of AVERAGE_TIME agree to the noise of the sensor."""
        last = self.readings[-READINGS:]
        force = np.array([matmul(force, self.normal) for force, _ in last])
        depth = np.array([depth for _, depth in last])
        if len(last) < READINGS or not depth.mean() > 0.0:
            return False
        spread = max(np.ptp(force), np.ptp(depth) * force.mean() / depth.mean())
        return bool(spread <= self.simulation.anatomy.scene.sensor.noise)

    def result(self) -> PressResult:
        """Outcome so far; after a fault force and depth are 0."""
        fault = self.simulation.fault
        readings = self.readings[-READINGS:] if not fault else [(np.zeros(3), 0.0)]
        return PressResult(
            force=np.mean([force for force, _ in readings], axis=0),
            depth=float(np.mean([depth for _, depth in readings])),
            force_peak=self.force_peak,
            stopped=self._stopped,
            fault=fault,
            duration=self.simulation.time,
            workspace_limited=self._limited,
            taxels=np.mean(self._taxels[-READINGS:], axis=0) if self._taxels and not fault else None,
            taxel_places=self._taxel_places,
        )

    @property
    def centre(self) -> FloatArray:
        """Centre of pressure from the tip's pole, sum f (x - pole) / sum f [m], (3,).

        f is the force of each contact point on the tool against the scene's approach in the next substep.
        """
        points = self.simulation.contact_points()
        push = -matmul(points.force, self.simulation.anatomy.face.approach)
        return matmul(push, points.place - self._pole) / push.sum()

    @property
    def _pole(self) -> FloatArray:
        """Point of the tip's ball that faces the organ [m], (3,)."""
        return self.simulation.instrument.tip_position - self._radius * self.normal


def press_alone(press: SitePress, phases: Sequence[PressPhase]) -> PressResult:
    """Execute a press with its simulation alone."""
    for phase in phases:
        if press.begin(phase):
            press.simulation.control_step(phase.count, phase.force_limit)
            press.end(phase)
    return press.result()


def press_in_lanes(group: LaneGroup, presses: Sequence[SitePress], phases: Sequence[PressPhase]) -> None:
    """Execute presses with simulations of a group in lanes; read `SitePress.result` after it."""
    for phase in phases:
        if moving := [press for press in presses if press.begin(phase)]:
            group.control_step([press.simulation for press in moving], phase.count, phase.force_limit)
        for press in moving:
            press.end(phase)


def press(simulation: Simulation, site: FloatArray, normal: FloatArray) -> Press:
    """Press the resting organ of a simulation once, along the inward normal, to its scene's depth or hard limit."""
    scene = simulation.anatomy.scene
    site_press = SitePress(simulation, site, normal)
    result = press_alone(site_press, recorded_phases(scene))
    end = result.fault
    if not end and site_press.force_peak > scene.limits.hard_force:
        end = f"force limit {scene.limits.hard_force:g} N"
    curve = np.array([(depth, matmul(force, normal)) for force, depth in site_press.readings]).reshape(-1, 2)
    # Without a reading before a fault depth and force are 0, as in `SitePress.result`.
    last = curve[-1 if end else -round(AVERAGE_TIME / simulation.haptic_dt) :] if len(curve) else np.zeros((1, 2))
    return Press(
        site=site,
        normal=normal,
        depth=float(last[:, 0].mean()),
        force=float(last[:, 1].mean()),
        force_peak=result.force_peak,
        curve=curve[curve[:, 1] > 0.0],
        volume_ratio_smallest=float(simulation.organ_state.volume_ratio_smallest[0]),
        load=simulation.tissue_load,
        end=end,
        duration=result.duration,
        far_travel=_far_travel(simulation, site),
    )


def _far_travel(simulation: Simulation, site: FloatArray) -> float:
    """`Press.far_travel` of the current state [m]."""
    rest = simulation.anatomy.mesh.points
    distance = norm(rest - site, axis=1)
    far = distance >= np.median(distance)
    moved = simulation.organ_state.node_position[far] - rest[far] - simulation.ground_shift(rest[far])
    return float(norm(moved, axis=1).max())


def scan(
    anatomy: Anatomy,
    organ_model: OrganModel,
    sites: FloatArray,
    normals: FloatArray,
    *,
    progress: Callable[[], None] = lambda: None,
) -> list[Press]:
    """Press each site of a resting organ on all cores; presses are independent, so their number changes no result.

    Args:
        anatomy: the scene's organ.
        organ_model: the pressed organ, with or without lesions.
        sites: surface points [m], shape (n_site, 3).
        normals: unit outward normals there, shape (n_site, 3).
        progress: called after each press.
    """

    def simulation() -> Simulation:
        own = Simulation(anatomy)
        own.reset(organ_model, sites[0] + normals[0] * 0.05)
        return own

    def pressed(own: Simulation, index: int) -> Press:
        result = press(own, sites[index], normals[index])
        progress()
        return result

    return in_threads(simulation, pressed, len(sites))


def in_threads(make: Callable[[], Tool], work: Callable[[Tool, int], Result], count: int) -> list[Result]:
    """Results of `work` for the numbers below `count`, on all cores; each thread makes a tool of its own for it.

    An error or Ctrl-C cancels the remaining calls.
    """
    own = threading.local()

    def run(number: int) -> Result:
        if not hasattr(own, "tool"):
            own.tool = make()
        return work(own.tool, number)

    # The kernels hold no interpreter lock.
    with ThreadPoolExecutor(core_count()) as pool:
        return list(pool.map(run, range(count)))
