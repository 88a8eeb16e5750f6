"""Both states and the clock: an organ and an instrument that exchange forces at haptic rate."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from msdm_core.contact_kernels import QUADRATURE_BARYCENTRIC, QUADRATURE_COUNT
from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels import SCRATCH_FIELDS, OrganModel, OrganState
from msdm_core.mesh import FloatArray
from msdm_core.organ import blank_state, rest_state
from msdm_core.stability import stable_dt
from surgsim_env.anatomy import Anatomy
from surgsim_env.exchange import StepsTaken, compiled_steps, haptic_step
from surgsim_env.grasp import Grasp, read_grasp
from surgsim_env.haptic_kernels import pull_force
from surgsim_env.haptic_record import HapticRecord
from surgsim_env.instrument import Instrument
from surgsim_env.loop_choice import runs_compiled
from surgsim_env.scene_instrument import make_instrument
from surgsim_env.timing import substeps_needed
from surgsim_env.tool_mass import check_tool_masses

# What of an organ's state decides what comes next.
KEPT_FIELDS = tuple(name for name in OrganState._fields if name not in SCRATCH_FIELDS)
# How far beyond the organ's bounding box the tip may travel [m].
WORKSPACE_MARGIN = 0.04


class Simulation:
    """An organ and an instrument in contact; advanced by `control_step` or `haptic_step`, read by tasks.

    `compiled` says whether control steps run in one compiled call or in the plain loop: the bits are the same.
    `pull_peak` is the largest pull of a jaw in the last control step [N].
    """

    def __init__(self, anatomy: Anatomy) -> None:
        """Set up a scene's healthy organ and its instrument, the tip parked away from the organ.

        Raises:
            OrganError: the scene's number of substeps is too small for its organ, or a tool too light for its contact.
            ValueError: an arm that is wrongly described, or whose port does not let it reach the palpable face.
        """
        scene = anatomy.scene
        self.anatomy = anatomy
        self.contact = scene.contact.law
        self.haptic_dt = scene.timing.haptic_step
        self.substep_count = scene.timing.substep_count
        self.substep_dt = self.haptic_dt / self.substep_count
        margin = WORKSPACE_MARGIN + scene.instrument.tip_radius
        points = anatomy.mesh.points
        lower, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
        self.instrument: Instrument = make_instrument(anatomy, lower, upper)
        healthy = anatomy.organ()
        check_tool_masses(scene.name, self.instrument, self.contact, float(healthy.surface_rest_area.sum()))
        self._wrench = np.zeros((self.instrument.tool_count, 6))
        self._step = 0
        self.fault = ""
        self.compiled = runs_compiled()
        self.pull_peak = 0.0
        self._taken: StepsTaken | None = None
        self._record: HapticRecord | None = None
        self.organ_model: OrganModel
        self.organ_state: OrganState
        self.reset(healthy, self.instrument.parked)

    @property
    def time(self) -> float:
        """Simulated time since the reset [s]."""
        return self._step * self.haptic_dt

    @property
    def taken_over(self) -> bool:
        """Whether the next `control_step` has been made already, among others."""
        return self._taken is not None

    @property
    def contact_wrench(self) -> FloatArray:
        """Tissue's mean force [N] and torque about the centre of mass [N m] on each tool in the last haptic step."""
        return self._wrench.copy()

    @property
    def contact_force(self) -> FloatArray:
        """Sum of the tissue's force over all tools in the last haptic step [N], shape (3,)."""
        return self._wrench[:, :3].sum(axis=0)

    @property
    def grasp(self) -> Grasp | None:
        """What the jaw has hold of as of the last haptic step; None for an instrument without a jaw."""
        return read_grasp(self.instrument, self._wrench, self.contact.friction)

    @property
    def rest_position(self) -> FloatArray:
        """Where the organ's nodes rest [m], (n_node, 3): as scanned, or settled under gravity."""
        return self._rest_position.copy()

    @property
    def contact_centre(self) -> FloatArray | None:
        """Centre of the touched patch on the RESTING surface, by area [m], shape (3,); None without contact."""
        model = self.organ_model
        engaged = self.organ_state.contact_engaged.any(axis=0).reshape(-1, QUADRATURE_COUNT)
        if not engaged.any():
            return None
        corners = model.node_rest_position[model.surface_triangles]
        weights = engaged * model.surface_rest_area[:, None]
        return np.einsum("tq,qc,tcx->x", weights, QUADRATURE_BARYCENTRIC, corners) / weights.sum()

    def reset(self, organ_model: OrganModel, tip_position: FloatArray) -> None:
        """Start with an organ at rest and the tip at rest at a position [m].

        Raises:
            OrganError: the scene's fixed number of substeps is too small for this organ (says how many it needs); the
                simulation goes on with the organ it had.
        """
        self._check_step(organ_model)
        self.organ_model = organ_model
        self.organ_state = rest_state(organ_model, shape_count=len(self.instrument.shapes.shape_radius))
        # Where the organ rests: as scanned, or settled under gravity, and how it sticks to what it rests on.
        self._rest_position = self.organ_state.node_position.copy()
        self._rest_stretch = self.organ_state.support_stretch.copy()
        self.restart(tip_position)

    def restart(self, tip_position: FloatArray) -> None:
        """Back to the rest of the same organ with the tip somewhere else [m]; the clock starts again."""
        state = self.organ_state
        state.node_position[:] = self._rest_position
        state.support_stretch[:] = self._rest_stretch
        state.node_velocity[:] = 0.0
        state.node_force[:] = 0.0
        state.contact_engaged[:] = 0
        state.contact_stretch[:] = 0.0
        state.contact_passed[:] = 0
        state.volume_ratio_smallest[:] = 1.0
        self.instrument.place(tip_position)
        self._wrench[:] = 0.0
        self._step = 0
        self.fault = ""
        self.pull_peak = 0.0
        self._taken = None

    def haptic_step(self) -> bool:
        """Advance by one haptic step; False, with `fault` saying why, where the organ or MuJoCo came to grief."""
        wrench = np.zeros_like(self._wrench)
        try:
            haptic_step(
                self.organ_model,
                self.organ_state,
                self.instrument,
                self.contact,
                self.substep_dt,
                self.substep_count,
                wrench,
            )
        except OrganDivergedError as error:
            self.fault = str(error)
            return False
        # After a fault the last good wrench stays: nobody reads a NaN.
        self._wrench = wrench
        self._step += 1
        if self._record is not None:
            self._record.note(self.time, wrench)
        return True

    def control_step(self, count: int, force_limit: float = math.inf, pull_limit: float = math.inf) -> float:
        """Advance by `count` haptic steps, fewer where one comes to a `fault` or passes a limit.

        Args:
            count: of haptic steps.
            force_limit: of the size of the tissue's total force [N].
            pull_limit: of the pull of a jaw, the size of the sum of its fingers' forces [N].

        Returns:
            The largest size of the tissue's total force in these steps [N]; `pull_peak` is the largest pull.
        """
        if self._taken is not None:
            taken, self._taken = self._taken, None
            self.pull_peak = taken.pull_peak
            return taken.force_peak
        if self.compiled and self._record is None:
            taken = compiled_steps(
                self.organ_model,
                self.organ_state,
                self.instrument,
                self.contact,
                self.substep_dt,
                self.substep_count,
                self._wrench,
                count,
                force_limit,
                pull_limit,
            )
            self._step += taken.count
            self.fault = taken.fault or self.fault
            self.pull_peak = taken.pull_peak
            return taken.force_peak
        force_peak, self.pull_peak = 0.0, 0.0
        for _ in range(count):
            if not self.haptic_step():
                break
            x, y, z = self.contact_force.tolist()
            force_peak = max(force_peak, math.sqrt(x * x + y * y + z * z))
            self.pull_peak = max(self.pull_peak, pull_force(self.instrument.jaws, self._wrench))
            if force_peak > force_limit or self.pull_peak > pull_limit:
                break
        return force_peak

    @contextmanager
    def recording(self) -> Iterator[HapticRecord]:
        """Record each haptic step made inside: control steps then run in the plain loop, with the same bits.

        Raises:
            RuntimeError: the simulation is being recorded already.
        """
        if self._record is not None:
            raise RuntimeError("this simulation is being recorded already: end that recording first")
        self._record = HapticRecord(self.instrument)
        try:
            yield self._record
        finally:
            self._record = None

    def take_over(self, organ_state: OrganState, wrench: FloatArray, taken: StepsTaken) -> None:
        """Accept a control step that was made elsewhere, among others; the next `control_step` only reports it.

        Args:
            organ_state: where it left the organ; the instrument's own data has moved along.
            wrench: of the last good haptic step [N, N m], shape (n_tool, 6).
            taken: what came of it.

        Raises:
            RuntimeError: the simulation is being recorded, and steps that were made elsewhere would be missing.
        """
        if self._record is not None:
            raise RuntimeError("a simulation that advances among others is not recorded: step its environment alone")
        self.organ_state = organ_state
        self._wrench[:] = wrench
        self._step += taken.count
        self.fault = taken.fault or self.fault
        self._taken = taken

    def end_control_step(self) -> bool:
        """Bring the instrument's poses up to date and read MuJoCo's warnings; False where there is one."""
        self.instrument.refresh()
        self.fault = self.instrument.warning()
        return not self.fault

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that changes, as arrays by name; the organ's model is the caller's to keep."""
        arrays = {f"organ_{name}": getattr(self.organ_state, name).copy() for name in KEPT_FIELDS}
        return {
            **arrays,
            "instrument": self.instrument.get_state(),
            "rest_position": self._rest_position.copy(),
            "rest_stretch": self._rest_stretch.copy(),
            "wrench": self._wrench.copy(),
            "pull_peak": np.array(self.pull_peak),
            "step": np.array(self._step),
            "fault": np.array(self.fault),
        }

    def state_shapes(self, organ_model: OrganModel) -> dict[str, tuple[int, ...]]:
        """Shapes of what `get_state` gives with another organ of the same scene, by name."""
        shapes = {name: array.shape for name, array in self.get_state().items()}
        blank = blank_state(organ_model, shape_count=len(self.instrument.shapes.shape_radius))
        shapes |= {f"organ_{name}": getattr(blank, name).shape for name in KEPT_FIELDS}
        return shapes | {"rest_position": blank.node_position.shape, "rest_stretch": blank.support_stretch.shape}

    def set_state(self, organ_model: OrganModel, arrays: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` gave, to the bit."""
        self.organ_model = organ_model
        # Scratch too is as large as this organ asks.
        blank = blank_state(organ_model, shape_count=len(self.instrument.shapes.shape_radius))
        self.organ_state = blank._replace(**{name: arrays[f"organ_{name}"].copy() for name in KEPT_FIELDS})
        self.instrument.set_state(arrays["instrument"])
        self._rest_position = arrays["rest_position"].copy()
        self._rest_stretch = arrays["rest_stretch"].copy()
        self._wrench[:] = arrays["wrench"]
        self.pull_peak = float(arrays["pull_peak"])
        self._step = int(arrays["step"])
        self.fault = str(arrays["fault"])
        self._taken = None

    def _check_step(self, organ_model: OrganModel) -> None:
        limit = stable_dt(organ_model, self.contact)
        needed = substeps_needed(self.haptic_dt, limit)
        if needed > self.substep_count:
            raise OrganError(
                f"scene {self.anatomy.scene.name!r}: {self.substep_count} substeps of {self.substep_dt * 1e3:.3g} ms "
                f"are too long for this organ, whose stable step with contact is {limit * 1e3:.3g} ms: "
                f"set timing.substep_count = {needed}, timing.mass_scaling = true, or use softer lesions"
            )
