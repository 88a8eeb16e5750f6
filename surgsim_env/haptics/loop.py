"""The haptic loop: devices coupled to the tips of a simulation's instrument, one haptic step at a time."""

from collections.abc import Sequence

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.haptics.device import HapticDevice
from surgsim_env.haptics.held_tip import HeldTip
from surgsim_env.haptics.press_depth import PressDepth
from surgsim_env.haptics.settings import HapticSettings
from surgsim_env.haptics.telemetry import HapticTelemetry
from surgsim_env.haptics.tip_drive import tip_drives
from surgsim_env.instruments.arm.pair import SIDES, Pair


class HapticLoop:
    """Steps a simulation whose instrument is coupled to devices; `step` never raises for faults of organ or device.

    Each step reads the devices' poses, writes the couplings' forces to devices and tips, and advances organ and
    instrument by one haptic step: a force responds to the pose of its own step.

    After a divergence of the organ or MuJoCo (`fault` gives the reason) forces are zero and the simulation stops, until
    `reset`.

    Fields:
        simulation: of the instrument
        held: one per device, with its coupling
        fault: why the simulation has stopped, or ""
    """

    def __init__(
        self,
        simulation: Simulation,
        devices: HapticDevice | Sequence[HapticDevice],
        settings: HapticSettings | Sequence[HapticSettings] | None = None,
    ) -> None:
        """Couple devices to the tips of an instrument at their present positions.

        Args:
            simulation: after a reset; only this loop may advance it.
            devices: one, or one per tip, the left arm's first.
            settings: for all, or one for each.

        Raises:
            ValueError: as many devices as there are not tips; a coupling that a device or tip cannot bear (says the
                limit); a force beyond what device or servo can push with.
            TypeError: an instrument that cannot be held so.
        """
        self.simulation = simulation
        scene, dt = simulation.anatomy.scene, simulation.haptic_dt
        many = list(devices) if isinstance(devices, Sequence) else [devices]
        drives = tip_drives(simulation.instrument, dt)
        each = list(settings) if isinstance(settings, Sequence) else [settings or HapticSettings()] * len(many)
        if len(many) != len(drives) or len(each) != len(many):
            raise ValueError(
                f"{len(many)} devices and {len(each)} settings for the {len(drives)} tips of scene {scene.name!r}: "
                "give one device for each tip, and settings for all or one for each"
            )
        depths = [PressDepth(simulation, 0.0 if drive.has_jaw else scene.instrument.tip_radius) for drive in drives]
        self.held = [HeldTip(*parts, dt) for parts in zip(many, drives, each, depths, strict=True)]
        self.fault = simulation.fault
        self._tools = _tools_of_tips(simulation)
        # The tissue's force on each tip in the last step [N].
        self._contacts = self._contact_forces()

    def step(self) -> HapticTelemetry:
        """Advance by one haptic step, or let go of everything after a fault."""
        simulation = self.simulation
        if not self.fault:
            for held, contact in zip(self.held, self._contacts, strict=True):
                held.step(contact)
            simulation.control_step(1)
            simulation.instrument.refresh()
            self.fault = simulation.fault
            if not self.fault and simulation.instrument.data.warning.number.any():
                self.fault = simulation.instrument.warning()
            self._contacts = self._contact_forces()
        if self.fault:
            for held in self.held:
                held.release()
        tips = tuple(held.telemetry(contact) for held, contact in zip(self.held, self._contacts, strict=True))
        return HapticTelemetry(simulation.time, self.fault, tips)

    def reset(self, organ_model: OrganModel | None = None, tip_position: FloatArray | None = None) -> None:
        """Restart: forces are zero, and the tips approach the devices slowly from their new positions.

        Args:
            organ_model: another organ of the same scene; the same one by default.
            tip_position: [m], (3,), or (2, 3) for a pair; where the instrument parks by default.

        Raises:
            OrganError: the scene's number of substeps is too small for this organ; the loop keeps the previous one.
            ValueError: an arm does not reach that position.
        """
        simulation = self.simulation
        place = simulation.instrument.parked if tip_position is None else np.asarray(tip_position, dtype=np.float64)
        if organ_model is None:
            simulation.restart(place)
        else:
            simulation.reset(organ_model, place)
        self.fault = simulation.fault
        self._contacts = self._contact_forces()
        for held in self.held:
            held.restart()

    def _contact_forces(self) -> list[FloatArray]:
        wrench = self.simulation.contact_wrench
        return [wrench[tools, :3].sum(axis=0) for tools in self._tools]


def _tools_of_tips(simulation: Simulation) -> list[IntArray]:
    """Indices of the tools at each tip."""
    instrument = simulation.instrument
    if isinstance(instrument, Pair):
        return [instrument.tools_of(side) for side in SIDES]
    return [np.arange(instrument.tool_count, dtype=np.int32)]
