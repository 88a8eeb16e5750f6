"""The simulation: force exchange of an organ and an instrument at haptic rate, the clock, and recordings of both."""

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from msdm_core.arithmetic import matmul, solve
from msdm_core.errors import OrganError
from msdm_core.kernels.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT
from msdm_core.kernels.structure_kernels import FAULT_INVERTED_TET, KEPT_NAMES, OrganModel, OrganState
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import relax_arms, rest_state
from msdm_core.organ.fields import ContactPoints, TissueFields, contact_points, tissue_fields
from msdm_core.organ.measure import TissueLoad, inverted_tets, node_pressures, tissue_load
from msdm_core.organ.motion import SIGNAL, place_on_ground
from msdm_core.organ.stability import stable_dt
from msdm_core.organ.state import blank_state
from msdm_core.organ.stepping import describe_fault
from surgsim_env.coupling.exchange import StepsTaken, haptic_loop, step_outcome, step_plan, steps_taken
from surgsim_env.coupling.motion import draw_drive, go_on, hold, signals
from surgsim_env.coupling.mujoco_library import runs_compiled
from surgsim_env.instruments.instrument import Grasp, Instrument, read_grasp
from surgsim_env.instruments.make import make_instrument
from surgsim_env.instruments.tool_bodies import check_tool_masses, place_supports
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.model import substeps_needed

# What is drawn of an organ's motions, and saved.
DRAWN_FIELDS = ("cycle_start", "cycle_size", "delay")
# The tip may move this far beyond the organ's bounding box [m].
WORKSPACE_MARGIN = 0.04


class HapticRecord:
    """Time, wrench, taxels and tip pose at the end of each recorded haptic step; recording does not change the episode.

    After mj_step2 MuJoCo's coordinates belong to the end of the step and its poses to the start. The tip's pose is
    therefore computed from the coordinates in an MjData of the record's own; the instrument's data are not written.
    """

    def __init__(self, instrument: Instrument) -> None:
        """Start an empty record of an instrument."""
        self.instrument = instrument
        self._data = mujoco.MjData(instrument.model)
        self._time: list[float] = []
        self._wrench: list[FloatArray] = []
        self._taxels: list[FloatArray] = []
        self._position: list[FloatArray] = []
        self._orientation: list[FloatArray] = []
        self._touching: list[int] = []

    def __len__(self) -> int:
        return len(self._time)

    def note(self, time: float, wrench: FloatArray) -> None:
        """Add a finished step: its end [s] and the tissue's mean wrench on each tool [N, N m], shape (n_tool, 6)."""
        self._data.qpos[:] = self.instrument.data.qpos
        mujoco.mj_kinematics(self.instrument.model, self._data)
        position, orientation = self.instrument.tip_pose_in(self._data)
        if wrench.any():
            self._touching.append(len(self))
        self._time.append(time)
        self._wrench.append(wrench.copy())
        if self.instrument.patches is not None:
            self._taxels.append(self.instrument.patches.forces)
        self._position.append(position)
        self._orientation.append(orientation)

    def first_contact(self, start: int = 0) -> int | None:
        """Index of the first step of contact from `start` on; None without one."""
        later = bisect_left(self._touching, start)
        return self._touching[later] if later < len(self._touching) else None

    @property
    def time(self) -> FloatArray:
        """End of each haptic step since the reset [s], shape (n,)."""
        return np.array(self._time)

    @property
    def wrench(self) -> FloatArray:
        """Mean force [N] of the tissue, and torque about the centre of mass [N m], on each tool, (n, n_tool, 6)."""
        return np.array(self._wrench).reshape(-1, self.instrument.tool_count, 6)

    @property
    def taxels(self) -> FloatArray:
        """Force on each taxel [N] (`Simulation.taxels`), (n, n_patch, rows, columns, 3); 0 numbers without taxels."""
        return np.array(self._taxels).reshape(len(self), *self.instrument.taxel_shape)

    @property
    def tip_position(self) -> FloatArray:
        """Centre of the tip ball [m], shape (n, 3)."""
        return np.array(self._position).reshape(-1, 3)

    @property
    def tip_orientation(self) -> FloatArray:
        """Unit quaternion (w, x, y, z) from the tip's axes to the world's, shape (n, 4)."""
        return np.array(self._orientation).reshape(-1, 4)

    def tip_position_at(self, index: int) -> FloatArray:
        """Centre of the tip ball at the end of one step [m], shape (3,)."""
        return self._position[index].copy()


class Simulation:
    """An organ and an instrument in contact; advanced by `control_step` or `haptic_step`, read by tasks.

    Fields:
        drive: the course of the organ's motions since the reset
        compiled: whether haptic steps run compiled or in Python, with the same bits
        force_peak: largest total force of the tissue in the last control step [N]
        pull_peak: largest pull of a jaw in it, the size of the sum of its fingers' forces [N]
        fault: what ended the last steps, or ""
        node_dose: integral of contact pressure over time at each node since the reset [Pa s], (n_node,), where the
            scene limits the dose: a control step adds its duration times the pressure at its end
    """

    def __init__(self, anatomy: Anatomy) -> None:
        """Set up the healthy organ and the instrument of a scene, with the tip parked away from the organ.

        Raises:
            OrganError: the scene's number of substeps is too small for its organ, or a tool too light for its contact.
            ValueError: an invalid description of an arm, or a port from which it does not reach the palpable face.
        """
        scene = anatomy.scene
        self.anatomy = anatomy
        self.contact = scene.contact.law
        self.haptic_dt = scene.timing.haptic_step
        self.substep_count = scene.timing.substep_count
        self.substep_dt = self.haptic_dt / self.substep_count
        margin = WORKSPACE_MARGIN + scene.instrument.tip_radius
        lower, upper = anatomy.box[0] - margin, anatomy.box[1] + margin
        self.instrument: Instrument = make_instrument(anatomy, lower, upper)
        healthy = anatomy.organ()
        surface_area = float(healthy.surface_rest_area.sum())
        check_tool_masses(scene.name, self.instrument, self.contact, surface_area, self.substep_count)
        self._wrench = np.zeros((self.instrument.tool_count, 6))
        self._step = self._motion_start = 0
        self.fault = ""
        self.compiled = runs_compiled()
        self.force_peak = self.pull_peak = 0.0
        self._record: HapticRecord | None = None
        # The motions that stop in apnoea.
        self._breath = [number for number, motion in enumerate(scene.motions) if motion.stops_in_apnoea]
        self.draw_motion(np.random.default_rng(0))
        self.organ_model: OrganModel
        self.organ_state: OrganState
        self.reset(healthy, self.instrument.parked)

    @property
    def time(self) -> float:
        """Simulated time since the reset [s]."""
        return self._step * self.haptic_dt

    @property
    def contact_wrench(self) -> FloatArray:
        """Mean force [N] of the tissue and torque about the centre of mass [N m] on each tool, last haptic step."""
        return self._wrench.copy()

    @property
    def contact_force(self) -> FloatArray:
        """Force of the tissue on all tools together in the last haptic step [N], shape (3,)."""
        return self._wrench[:, :3].sum(axis=0)

    @property
    def grasp(self) -> Grasp | None:
        """The jaw's hold on tissue in the last haptic step; None for an instrument without a jaw."""
        return read_grasp(self.instrument.jaw, self._wrench, self.contact.friction)

    @property
    def tissue_load(self) -> TissueLoad:
        """Largest contact pressure and strain of the organ at the end of the last haptic step."""
        return tissue_load(self.organ_model, self.organ_state, self.instrument.shapes, self.contact)

    def contact_points(self) -> ContactPoints:
        """Points of the organ's surface in contact, with their forces in the next substep.

        Raises:
            OrganDivergedError: a fault in that substep.
        """
        shapes = self.instrument.shapes
        return contact_points(self.organ_model, self.organ_state, shapes, self.contact, self.substep_dt)

    @property
    def tissue_dose(self) -> float:
        """Largest of `node_dose` [Pa s]."""
        return float(self.node_dose.max())

    @property
    def damage(self) -> FloatArray:
        """Damage index of each node, its dose over the scene's limit, (n_node,); 0 where the scene has none."""
        return self.node_dose / (self.anatomy.scene.limits.dose or math.inf)

    def fields(self) -> TissueFields:
        """Contact traction, stress, stretch and energy of the organ as it is now, with the contact of the next substep.

        Raises:
            OrganDivergedError: a fault in that substep.
        """
        return tissue_fields(self.organ_model, self.organ_state, self.instrument.shapes, self.contact, self.substep_dt)

    @property
    def taxels(self) -> FloatArray | None:
        """Force of the tissue on each taxel in the last haptic step [N], `TaxelPatches.forces`; None without taxels.

        Their sum is that of `contact_wrench` on the contact shapes with a patch.
        """
        patches = self.instrument.patches
        return None if patches is None else patches.forces

    @property
    def rest_position(self) -> FloatArray:
        """Positions of the organ's nodes at rest [m], (n_node, 3): as scanned, or settled under gravity."""
        return self._rest_position.copy()

    @property
    def contact_centre(self) -> FloatArray | None:
        """Area-weighted centre of the contact patch on the surface AT REST [m], shape (3,); None without contact."""
        model = self.organ_model
        engaged = self.organ_state.contact_engaged.any(axis=0).reshape(-1, QUADRATURE_COUNT)
        if not engaged.any():
            return None
        corners = model.node_rest_position[model.surface_triangles]
        weights = engaged * model.surface_rest_area[:, None]
        points = matmul(QUADRATURE_BARYCENTRIC, corners)
        return (weights[:, :, None] * points).sum(axis=(0, 1)) / weights.sum()

    def covers(self, point: FloatArray) -> bool:
        """True for a point [m] (3,) inside the organ or on its surface: its coordinates in a tet are not negative."""
        corners = self.organ_state.node_position[self.organ_model.tet_nodes]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        shares = solve(edges, (point - corners[:, 0])[:, :, None])[:, :, 0]
        return bool(((shares.min(axis=1) >= 0.0) & (shares.sum(axis=1) <= 1.0)).any())

    def take_anatomy(self, anatomy: Anatomy) -> None:
        """Go on with another member of the scene's family; its organ comes with the next `reset`."""
        self.anatomy = anatomy

    def reset(self, organ_model: OrganModel, tip_position: FloatArray, *, elapsed: float = 0.0) -> None:
        """Start with an organ at rest, and with the tip at rest at a position [m]; arguments as of `restart`.

        Raises:
            OrganError: the scene's number of substeps is too small for this organ (says how many it needs); the
                simulation keeps its present organ.
        """
        self._check_step(organ_model)
        self.organ_model = organ_model
        self.organ_state = rest_state(organ_model, shape_count=len(self.instrument.shapes.shape_radius))
        # The organ at rest, as scanned or settled under gravity, and its sticking friction on supports.
        self._rest_position = self.organ_state.node_position.copy()
        self._rest_stretch = self.organ_state.support_stretch.copy()
        self.node_dose = np.zeros(len(organ_model.node_mass))
        self.restart(tip_position, elapsed=elapsed)

    def restart(self, tip_position: FloatArray, *, elapsed: float = 0.0) -> None:
        """Return the same organ to rest, place the tip at a position [m], and reset the clock; the dose stays.

        The motions begin again as they were drawn; a breath that is held stays so.

        Args:
            tip_position: [m], shape (3,).
            elapsed: time of the organ's motions since they were drawn [s]; the organ rests on its moving ground.
        """
        state = self.organ_state
        state.node_position[:] = self._rest_position
        state.support_stretch[:] = self._rest_stretch
        relax_arms(self.organ_model, state)
        state.node_velocity[:] = 0.0
        state.node_force[:] = 0.0
        state.contact_engaged[:] = 0
        state.contact_stretch[:] = 0.0
        state.contact_passed[:] = 0
        state.motion[:] = 0.0
        self._step, self._motion_start = 0, round(elapsed / self.haptic_dt)
        # The haptic steps that the dose has.
        self._dosed_step = 0
        self._begin_course()
        self._rest_on_ground()
        self._place_supports()
        state.volume_ratio_smallest[:] = 1.0
        self.instrument.place(tip_position)
        self.instrument.read_shapes()
        self._wrench[:] = 0.0
        self.instrument.shapes.taxel_force[:] = 0.0
        self.fault = ""
        self.force_peak = self.pull_peak = 0.0

    def haptic_step(self) -> bool:
        """Advance by one haptic step; False, with `fault` saying why, on divergence of the organ."""
        self.control_step(1)
        return not self.fault

    def control_step(self, count: int, force_limit: float = math.inf, pull_limit: float = math.inf) -> float:
        """Advance by `count` haptic steps, fewer after a `fault` or beyond a limit.

        Args:
            count: number of haptic steps.
            force_limit: the step whose total force of the tissue exceeds it is the last [N].
            pull_limit: the same for the pull of a jaw, the size of the sum of its fingers' forces [N].

        Returns:
            The largest total force of the tissue in these steps [N]; `pull_peak` is the largest pull.
        """
        self.force_peak = self.pull_peak = 0.0
        advance, instrument = haptic_loop(compiled=self.compiled), self.instrument
        # A recording reads the instrument after each step.
        for size in [count] if self._record is None else [1] * count:
            self.begin_motion()
            # After a fault the wrench of the last good step stays.
            outcome = step_outcome(1, instrument.tool_count)._replace(wrench=self._wrench[None])
            advance(
                self.organ_model,
                self.organ_state,
                self.contact,
                instrument.shapes,
                instrument.response,
                instrument.views(compiled=self.compiled),
                self.drive,
                step_plan(self.organ_model.alpha, self.substep_dt, self.substep_count, size, force_limit, pull_limit),
                outcome,
            )
            taken = steps_taken(self.organ_model, self.organ_state, outcome, 0)
            self._count(taken)
            if self._record is not None and taken.step_count:
                self._record.note(self.time, self._wrench)
            if taken.ended:
                break
        return self.force_peak

    @contextmanager
    def recording(self) -> Iterator[HapticRecord]:
        """Record the haptic steps of a `with` block; each is then a call of its own, with the same bits."""
        self._record = HapticRecord(self.instrument)
        try:
            yield self._record
        finally:
            self._record = None

    def begin_in_lanes(self) -> None:
        """Begin a control step in a group of lanes; it is not recorded."""
        self.force_peak = self.pull_peak = 0.0
        self.begin_motion()

    def end_in_lanes(self, wrench: FloatArray, taken: StepsTaken) -> None:
        """End a control step in a group of lanes, which has advanced the states of organ and instrument.

        Args:
            wrench: of the last good haptic step [N, N m], shape (n_tool, 6).
            taken: the result.
        """
        self._wrench[:] = wrench
        self._count(taken)

    def _count(self, taken: StepsTaken) -> None:
        """Advance the clock by haptic steps, and note their fault and their largest forces."""
        self._step += taken.step_count
        self.fault = taken.fault or self.fault
        self.force_peak = max(self.force_peak, taken.force_peak)
        self.pull_peak = max(self.pull_peak, taken.pull_peak)

    def draw_motion(self, rng: np.random.Generator) -> None:
        """Draw the course of the organ's motions from now on; without motions nothing is drawn."""
        self.drive = self._drawn = draw_drive(self.anatomy.scene.motions, self.haptic_dt, rng)
        self._breath_ends = False

    @property
    def motion_time(self) -> float:
        """Time since the motions were drawn [s]."""
        return (self._motion_start + self._step) * self.haptic_dt

    @property
    def holds_breath(self) -> bool:
        """True where the motions of breath rest, or will after their present cycle."""
        return not np.array_equal(self.drive.cycle_size, self._drawn.cycle_size)

    def hold_breath(self, held: bool) -> None:
        """Let the motions of breath rest after their present cycle (True), or begin a new one (False)."""
        if held and not self.holds_breath:
            self._hold()
        elif not held and self.holds_breath:
            self.drive = go_on(self.drive, self._drawn.cycle_size, self._breath, self.motion_time)
            self._breath_ends = False

    def begin_motion(self) -> None:
        """Let the drive of motions go on from the present time."""
        if self._breath_ends:
            self._hold()
        self.drive.step_count[0] = self._motion_start + self._step
        self._place_supports()

    def ground_shift(self, points: ArrayLike, elapsed: float | None = None) -> FloatArray:
        """Displacement of the ground from rest by the motions [m], of the shape of the points.

        Args:
            points: of the organ at rest [m], shape (n, 3) or (3,).
            elapsed: time since the motions were drawn [s]; None: now.
        """
        now = self.organ_state.motion[:, SIGNAL] if elapsed is None else signals(self.drive, elapsed)
        shift = np.zeros(np.shape(points))
        for signal, motion in zip(now, self.anatomy.ground_motions, strict=True):
            shift += signal * motion.shift(points).reshape(shift.shape)
        return shift

    def _place_supports(self) -> None:
        """Move the tools' supports with the ground; they stay there until the next call."""
        supports = self.anatomy.scene.supports
        if supports and self.anatomy.scene.motions:
            shift = self.ground_shift(np.array([support.position for support in supports]))
            place_supports(self.instrument.model, self.instrument.data, supports, shift)

    def _hold(self) -> None:
        """Let the breath end its present cycle and have none left afterwards, since cycles repeat."""
        self.drive = hold(self.drive, self._breath, self.motion_time)
        self._breath_ends = bool(self.drive.cycle_size[self._breath].any())

    def _begin_course(self) -> None:
        """Begin the motions as they were drawn, with the breath held if it is."""
        held, self.drive, self._breath_ends = self.holds_breath, self._drawn, False
        self.hold_breath(held)

    def _rest_on_ground(self) -> None:
        """Move the resting organ with its ground to its place at the start of the clock."""
        if not self.anatomy.scene.motions:
            return
        start = self._motion_start * self.haptic_dt
        now, soon = signals(self.drive, start), signals(self.drive, start + self.haptic_dt)
        place_on_ground(self.organ_model, self.organ_state, now, (soon - now) / self.haptic_dt)

    def end_control_step(self) -> bool:
        """Update the instrument's poses and the dose; False, with `fault` saying why, at an inverted tet or a warning.

        A substep checks the tets as they are at its start: those that the last one leaves are checked here.
        """
        self.instrument.refresh()
        if inverted_tets(self.organ_model, self.organ_state).size:
            self.fault = describe_fault(self.organ_model, self.organ_state, FAULT_INVERTED_TET)
        else:
            self.fault = self.instrument.warning()
        if self._measures_dose and not self.fault:
            pressure = node_pressures(self.organ_model, self.organ_state, self.instrument.shapes, self.contact)
            self.node_dose += (self._step - self._dosed_step) * self.haptic_dt * pressure
            self._dosed_step = self._step
        return not self.fault

    @property
    def _measures_dose(self) -> bool:
        return self.anatomy.scene.limits.dose is not None

    def get_state(self) -> dict[str, np.ndarray]:
        """All changing quantities, as arrays by name; the caller keeps the organ's model."""
        arrays = {f"organ_{name}": getattr(self.organ_state, name).copy() for name in self._kept_fields}
        motion = {f"motion_{name}": getattr(self.drive, name).copy() for name in DRAWN_FIELDS}
        motion["motion_cycle_size_drawn"] = self._drawn.cycle_size.copy()
        motion["motion_delay_drawn"] = self._drawn.delay.copy()
        motion["motion_start"] = np.array(self._motion_start)
        taxels = self.instrument.shapes.taxel_force
        return {
            **arrays,
            **(motion if self.anatomy.scene.motions else {}),
            **({"node_dose": self.node_dose.copy()} if self._measures_dose else {}),
            "instrument": self.instrument.get_state(),
            "rest_position": self._rest_position.copy(),
            "rest_stretch": self._rest_stretch.copy(),
            "wrench": self._wrench.copy(),
            **({"taxel_force": taxels.copy()} if len(taxels) else {}),
            "pull_peak": np.array(self.pull_peak),
            "step": np.array(self._step),
            "fault": np.array(self.fault),
        }

    def set_state(self, organ_model: OrganModel, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore arrays from `get_state`, to the bit; refused arrays change nothing.

        Args:
            organ_model: the organ that they belong to, of this scene.
            arrays: by name.

        Raises:
            ValueError: an entry that is missing, unknown or of another shape.
        """
        # Scratch arrays have the size of this organ.
        blank = blank_state(organ_model, shape_count=len(self.instrument.shapes.shape_radius))
        like = self.get_state() | {f"organ_{name}": getattr(blank, name) for name in self._kept_fields}
        if self._measures_dose:
            like["node_dose"] = organ_model.node_mass
        check_entries(arrays, {**like, "rest_position": blank.node_position, "rest_stretch": blank.support_stretch})
        self.organ_model = organ_model
        self.organ_state = blank._replace(**{name: arrays[f"organ_{name}"].copy() for name in self._kept_fields})
        if self.anatomy.scene.motions:
            drawn = {name: arrays[f"motion_{name}"].copy() for name in DRAWN_FIELDS}
            self.drive = self.drive._replace(**drawn)
            self._drawn = self.drive._replace(
                cycle_size=arrays["motion_cycle_size_drawn"].copy(), delay=arrays["motion_delay_drawn"].copy()
            )
            self._breath_ends = self.holds_breath
            self._motion_start = int(arrays["motion_start"])
        self.instrument.set_state(arrays["instrument"])
        self.instrument.read_shapes()
        self._rest_position = arrays["rest_position"].copy()
        self._rest_stretch = arrays["rest_stretch"].copy()
        self._wrench[:] = arrays["wrench"]
        if self.instrument.patches is not None:
            self.instrument.shapes.taxel_force[:] = arrays["taxel_force"]
        self.pull_peak = float(arrays["pull_peak"])
        self._step = self._dosed_step = int(arrays["step"])
        if self._measures_dose:
            self.node_dose = arrays["node_dose"].copy()
        self.fault = str(arrays["fault"])

    @property
    def _kept_fields(self) -> tuple[str, ...]:
        """KEPT_NAMES, without those of motions for an organ without any."""
        return KEPT_NAMES if self.anatomy.scene.motions else tuple(name for name in KEPT_NAMES if name != "motion")

    def _check_step(self, organ_model: OrganModel) -> None:
        limit = stable_dt(organ_model, self.contact)
        needed = substeps_needed(self.haptic_dt, limit)
        if needed > self.substep_count:
            raise OrganError(
                f"scene {self.anatomy.scene.name!r}: {self.substep_count} substeps of {self.substep_dt * 1e3:.3g} ms "
                f"are too long for this organ, whose stable step with contact is {limit * 1e3:.3g} ms: "
                f"set timing.substep_count = {needed}, timing.mass_scaling = true, or use softer lesions"
            )


def check_entries(arrays: Mapping[str, np.ndarray], like: Mapping[str, np.ndarray]) -> None:
    """Refuse arrays of other names or shapes than those of examples.

    Raises:
        ValueError: names the entry that is missing, unknown or different, and the rule.
    """
    for name in arrays:
        if name not in like:
            raise ValueError(f"the state's entry {name!r} is unknown; the entries are {', '.join(like)}")
    for name, example in like.items():
        if name not in arrays:
            raise ValueError(f"the state's entry {name!r} is missing")
        if arrays[name].shape != example.shape:
            raise ValueError(f"the state's entry {name!r} has shape {arrays[name].shape}; it must be {example.shape}")
