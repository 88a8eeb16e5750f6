"""`surgsim haptics`: a scene's instrument in the hand of a haptic device, in real time."""

import csv
import gc
import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from surgsim_apps.cli.values import MaybeNumber, MaybePath, MaybeText, SceneName
from surgsim_apps.haptics.device import DeviceDynamics
from surgsim_apps.haptics.loop import HapticLoop, HapticTelemetry
from surgsim_apps.haptics.pacing import TIMING, Pacer, PaceSettings, timeliness
from surgsim_apps.haptics.settings import BREATH_BIT, HapticSettings
from surgsim_apps.haptics.trajectory import TrajectoryDevice
from surgsim_apps.haptics.udp import PORT, UdpCounts, UdpDevice
from surgsim_apps.live.live_organ import live_anatomy
from surgsim_apps.live.organ_choice import SHOWN
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.coupling import Simulation
from surgsim_env.instruments import parked_place
from surgsim_env.scene import list_motions, make_scene, pair_names, with_motion

TELEMETRY_NAME = "telemetry.csv"
VECTORS = ("target", "tip", "coupling_force", "force", "contact_force")
NUMBERS = ("depth", "share", "energy")
# Time without a pose until the command says so [s].
SILENCE = 3.0
FLAGS = ("fresh", "clamped", "slewed", "approaching", "speed_limited", "workspace_limited")


@dataclass(frozen=True)
class Haptics:
    """Let a haptic device hold the instrument in real time: a bridge on this machine over UDP, or a recorded file.

    docs/haptics.md describes the packets. An organ too slow for 1 kHz gets coarser cells, with their force error
    printed. Ctrl-C ends it; it then prints rate, lateness and packet counts.
    """

    scene: SceneName = "liver"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    motion: MaybeText = None
    """Breathing of the patient: calm, free, or none (holds still); default: the scene's."""
    apnoea: bool = False
    """Hold the breath throughout; without it, the device's second button holds the breath."""
    port: int = PORT
    """UDP port on 127.0.0.1 for poses from the bridge; 0 for a free one."""
    trajectory: MaybePath = None
    """A CSV file with columns time [s], x, y, z [m], instead of a bridge."""
    device_damping: MaybeNumber = None
    """Damping of a device with force feedback [N s/m]; without it, the force counts as displayed, not felt."""
    device_mass: MaybeNumber = None
    """With --device-damping: mass of the device at its handle [kg]; default: 0.05."""
    device_delay: MaybeNumber = None
    """With --device-damping: delay of pose and force together [s]; default: 0."""
    seconds: MaybeNumber = None
    """Duration [s]; default: until Ctrl-C, or the end of the trajectory."""
    out: MaybePath = None
    """Folder for telemetry.csv: time, target, tip, forces, depth and active limits in each haptic step."""

    def run(self, console: Console) -> int:
        """Run the loop until its time is over, the trajectory ends, or Ctrl-C.

        Raises:
            ValueError: an unknown scene or motion, a bad trajectory, two arms, apnoea without breathing.
            OSError: a taken port, or an unreadable file.
        """
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0.0):
            raise ValueError(f"--seconds is {self.seconds:g}; it must be finite and above 0")
        scene = with_motion(make_scene(self.scene), self.motion)
        if self.apnoea and not scene.has_breath:
            breaths = " or ".join(list_motions()[1:])
            raise ValueError(f"--apnoea: the patient of scene {scene.name!r} does not breathe; give --motion {breaths}")
        if pair_names(scene.instrument.model) is not None:
            raise ValueError(f"scene {scene.name!r} has two arms; one device holds one tip: choose a scene with one")
        anatomy = live_anatomy(scene, SHOWN, console)
        simulation = Simulation(anatomy)
        simulation.hold_breath(self.apnoea)
        simulation.reset(anatomy.organ(anatomy.demonstration_lesions()), parked_place(anatomy))
        with _device(self, simulation.haptic_dt) as device:
            settings = HapticSettings(relative=True, breath_button=None if self.apnoea else BREATH_BIT)
            loop = HapticLoop(simulation, device, settings)
            coupling = loop.held[0].coupling
            console.print(f"scene {scene.name}: coupling {coupling.stiffness:.4g} N/m, {coupling.damping:.3g} N s/m")
            if isinstance(device, UdpDevice):
                host, port = device.address
                console.print(f"waits for poses at UDP {host}:{port}; Ctrl-C ends", highlight=False)
            # Compiles, or loads compiled code, before the clock runs.
            loop.step()
            loop.reset(tip_position=parked_place(anatomy))
            if isinstance(device, TrajectoryDevice):
                device.rewind()
            # Objects made so far stay alive, and a step makes no reference cycles: no garbage collection delays a step.
            gc.collect()
            gc.freeze()
            timing = np.zeros((), dtype=TIMING)
            begin = time.perf_counter()
            pacer = Pacer(PaceSettings(simulation.haptic_dt), timing)
            step, a_second = 0, round(1.0 / simulation.haptic_dt)
            silence = round(SILENCE / simulation.haptic_dt)
            count = None if self.seconds is None else round(self.seconds / simulation.haptic_dt)
            # Ctrl-C ends a run without an end of its own.
            with _telemetry(self.out) as note, suppress(KeyboardInterrupt):
                while count is None or step < count:
                    pacer.wait()
                    telemetry = loop.step()
                    note(telemetry)
                    step += 1
                    if isinstance(device, UdpDevice) and step % silence == 0 and not device.counts.accepted:
                        console.print(f"nothing has connected yet{_refused(device.counts)}", highlight=False)
                    elif step % a_second == 0:
                        tip = telemetry.tip
                        size = float((tip.contact_force @ tip.contact_force) ** 0.5)
                        console.print(f"{telemetry.time:6.1f} s  force {size:.3f} N  depth {tip.depth * 1e3:.2f} mm")
                    if telemetry.fault:
                        console.print(f"the organ diverged and is reset: {telemetry.fault}")
                        loop.reset(tip_position=parked_place(anatomy))
                    pacer.done(simulation.haptic_dt)
                    if count is None and isinstance(device, TrajectoryDevice) and device.over:
                        break
            kept = timeliness(np.zeros_like(timing), timing, time.perf_counter() - begin)
            console.print(
                f"{kept.rate:.1f} haptic steps a second; half began at most {kept.late_p50 * 1e3:.2f} ms late, 99 % at "
                f"most {kept.late_p99 * 1e3:.2f} ms, all at most {kept.late_most * 1e3:.2f} ms; {kept.skipped} steps "
                "were given up",
                highlight=False,
                soft_wrap=True,
            )
            if isinstance(device, UdpDevice):
                console.print(_packets_text(device.counts), highlight=False, soft_wrap=True)
        return 0


def _packets_text(counts: UdpCounts) -> str:
    """Numbers of poses and forces, in a sentence."""
    if not counts.accepted:
        return f"Nothing has connected{_refused(counts)}."
    unsent = f", {counts.unsent} could not be sent" if counts.unsent else ""
    return f"{counts.accepted} poses were received{_refused(counts)}; {counts.answered} forces were sent{unsent}."


def _refused(counts: UdpCounts) -> str:
    """Numbers of packets refused, by reason; "" without."""
    reasons = {
        "malformed (the format is in docs/haptics.md)": counts.malformed,
        "old or out of order": counts.stale,
        "from another sender": counts.stranger,
    }
    texts = [f"{count} {reason}" for reason, count in reasons.items() if count]
    return f", and packets were refused: {', '.join(texts)}" if texts else ""


@contextmanager
def _device(command: Haptics, haptic_step: float) -> Iterator[UdpDevice | TrajectoryDevice]:
    """The device of the options, closed at the end."""
    dynamics = _dynamics(command)
    if command.trajectory is not None:
        yield TrajectoryDevice.load(command.trajectory, haptic_step=haptic_step)
        return
    with closing(UdpDevice(command.port, dynamics=dynamics)) as device:
        yield device


def _dynamics(command: Haptics) -> DeviceDynamics | None:
    """Dynamics of a device with force feedback."""
    mass, delay = command.device_mass, command.device_delay
    if command.device_damping is None:
        if mass is not None or delay is not None:
            raise ValueError(
                "--device-mass and --device-delay go with --device-damping, of a device with force feedback"
            )
        return None
    if command.trajectory is not None:
        raise ValueError("--device-damping: a --trajectory is no device that pushes back; give only one of both")
    return DeviceDynamics(command.device_damping, 0.05 if mass is None else mass, delay or 0.0)


@contextmanager
def _telemetry(folder: Path | None) -> Iterator[Callable[[HapticTelemetry], object]]:
    """A writer of steps to telemetry.csv of a folder, which an error leaves there; without a folder it does nothing."""
    if folder is None:
        yield lambda telemetry: None
        return
    failure: Exception | None = None
    with (
        output_folder(folder, [TELEMETRY_NAME]) as files,
        (files / TELEMETRY_NAME).open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(["time", *(f"{name}_{axis}" for name in VECTORS for axis in "xyz"), *NUMBERS, *FLAGS])
        try:
            yield lambda telemetry: writer.writerow(_row(telemetry))
        except Exception as error:
            failure = error
    if failure is not None:
        raise failure


def _row(telemetry: HapticTelemetry) -> list[float | int]:
    tip = telemetry.tip
    vectors = [value for name in VECTORS for value in getattr(tip, name).tolist()]
    numbers = [getattr(tip, name) for name in NUMBERS]
    return [telemetry.time, *vectors, *numbers, *(int(getattr(tip, name)) for name in FLAGS)]
