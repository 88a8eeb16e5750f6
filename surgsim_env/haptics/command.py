"""`surgsim haptics`: a device holds a scene's instrument in real time."""

import csv
import gc
import math
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console

from surgsim_env.anatomy import load_anatomy
from surgsim_env.arms.arm_instrument import parked_place
from surgsim_env.haptics.coupling import VirtualCoupling
from surgsim_env.haptics.device import DeviceDynamics, HapticDevice
from surgsim_env.haptics.limits import ForceLimits
from surgsim_env.haptics.loop import HapticLoop
from surgsim_env.haptics.options import Haptics
from surgsim_env.haptics.settings import HapticSettings
from surgsim_env.haptics.telemetry import HapticTelemetry
from surgsim_env.haptics.trajectory import TrajectoryDevice
from surgsim_env.haptics.udp import UdpDevice
from surgsim_env.out_folder import writable_folder
from surgsim_env.pacing import TIMING, Pacer, PaceSettings, timeliness
from surgsim_env.scenes import Scene, load_scene, make_scene, pair_names
from surgsim_env.simulation import Simulation

TELEMETRY_NAME = "telemetry.csv"
VECTORS = ("target", "tip", "coupling_force", "force", "contact_force")
NUMBERS = ("depth", "share", "energy")
FLAGS = ("fresh", "clamped", "slewed", "approaching", "speed_limited", "workspace_limited")


def run_haptics(options: Haptics, console: Console) -> None:
    """Run the loop until its time is over, the trajectory ends, or Ctrl-C.

    Raises:
        ValueError: an unknown scene, a bad trajectory, a coupling that the device cannot bear, two arms.
        OSError: the port is taken, or a file cannot be read.
    """
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0.0):
        raise ValueError(f"--seconds is {options.seconds:g}; it must be finite and above 0")
    scene = _scene(options.scene)
    simulation = Simulation(load_anatomy(scene))
    anatomy = simulation.anatomy
    simulation.reset(anatomy.organ(anatomy.demonstration_lesions()), parked_place(anatomy))
    with _device(options, simulation.haptic_dt) as device, _telemetry(options.out) as note:
        loop = HapticLoop(simulation, device, _settings(options))
        coupling = loop.held[0].coupling
        console.print(f"scene {scene.name}: coupling {coupling.stiffness:.4g} N/m, {coupling.damping:.3g} N s/m")
        if isinstance(device, UdpDevice):
            host, port = device.address
            console.print(f"poses to UDP {host}:{port}; Ctrl-C ends")
        # Compiles, or loads what was compiled, before the clock runs.
        loop.step()
        loop.reset(tip_position=parked_place(anatomy))
        if isinstance(device, TrajectoryDevice):
            device.rewind()
        # What is there by now stays, and nothing that a step makes lies in a cycle: no collection delays a step.
        gc.collect()
        gc.freeze()
        timing = np.zeros((), dtype=TIMING)
        begin = time.perf_counter()
        pacer = Pacer(PaceSettings(simulation.haptic_dt), timing)
        try:
            _hold(options, loop, device, pacer, note, console)
        finally:
            kept = timeliness(np.zeros_like(timing), timing, time.perf_counter() - begin)
            console.print(
                f"{kept.rate:.1f} haptic steps a second; late by {kept.late_p50 * 1e3:.2f} ms (half), "
                f"{kept.late_p99 * 1e3:.2f} ms (99 %), {kept.late_most * 1e3:.2f} ms (all); "
                f"{kept.skipped} steps given up"
            )
            if isinstance(device, UdpDevice):
                console.print(f"packets: {device.counts}")


def _hold(options: Haptics, loop: HapticLoop, device: HapticDevice, pacer: Pacer, note, console: Console) -> None:
    every = round(1.0 / loop.simulation.haptic_dt)
    count = None if options.seconds is None else round(options.seconds / loop.simulation.haptic_dt)
    step = 0
    while count is None or step < count:
        pacer.wait()
        told = loop.step()
        note(told)
        step += 1
        if step % every == 0:
            tip = told.tip
            size = float((tip.contact_force @ tip.contact_force) ** 0.5)
            console.print(f"{told.time:6.1f} s  force {size:.3f} N  depth {tip.depth * 1e3:.2f} mm")
        if told.fault:
            console.print(f"the organ came to grief and is reset: {told.fault}")
            loop.reset(tip_position=parked_place(loop.simulation.anatomy))
        pacer.done(loop.simulation.haptic_dt)
        if options.seconds is None and isinstance(device, TrajectoryDevice) and device.over:
            break


def _scene(name: str) -> Scene:
    scene = load_scene(Path(name)) if Path(name).suffix == ".toml" else make_scene(name)
    if pair_names(scene.instrument.model) is not None:
        raise ValueError(f"scene {scene.name!r} has two arms; one device holds one tip: choose a scene with one")
    return scene


@contextmanager
def _device(options: Haptics, haptic_step: float) -> Iterator[UdpDevice | TrajectoryDevice]:
    if options.trajectory is not None:
        yield TrajectoryDevice.load(options.trajectory, haptic_step=haptic_step)
        return
    dynamics = None
    if options.device_damping is not None:
        dynamics = DeviceDynamics(options.device_damping, options.device_mass, options.device_delay)
    with closing(UdpDevice(options.port, dynamics=dynamics)) as device:
        yield device


def _settings(options: Haptics) -> HapticSettings:
    coupling = None
    if options.stiffness is not None:
        coupling = VirtualCoupling(options.stiffness, options.damping or 0.0)
    elif options.damping is not None:
        raise ValueError("--damping is of a coupling whose --stiffness is given: give both")
    return HapticSettings(coupling, ForceLimits(options.force_largest), relative=not options.absolute)


@contextmanager
def _telemetry(folder: Path | None):
    """A function that notes a step in telemetry.csv, or does nothing."""
    if folder is None:
        yield lambda told: None
        return
    with (writable_folder(folder, [TELEMETRY_NAME]) / TELEMETRY_NAME).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *(f"{name}_{axis}" for name in VECTORS for axis in "xyz"), *NUMBERS, *FLAGS])
        yield lambda told: writer.writerow(_row(told))


def _row(told: HapticTelemetry) -> list[float | int]:
    tip = told.tip
    vectors = [value for name in VECTORS for value in getattr(tip, name).tolist()]
    return [
        told.time,
        *vectors,
        *(getattr(tip, name) for name in NUMBERS),
        *(int(getattr(tip, name)) for name in FLAGS),
    ]
