"""A scripted scan: press an organ at each site along the surface normal to a set depth and record force over depth."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.simulation import Simulation

# The press: how fast it goes in [m/s], how long it rests there [s], over which end of that the force is averaged [s].
PRESS_SPEED = 0.04
HOLD_TIME = 0.10
AVERAGE_TIME = 0.04


@dataclass(frozen=True, eq=False)
class Press:
    """One press: where, how deep, how hard.

    Fields:
        site, normal: surface point [m] and unit outward normal at rest                            (3,)
        depth: of the tip below the rest surface at the end [m]
        force: along the normal, mean over the end of the hold [N]
        force_peak: largest contact force of any haptic step [N]
        curve: depth [m] and force along the normal [N] at each haptic step of contact             (n, 2)
        volume_ratio_smallest: of any tet at any substep
        end: "" or why it ended early: the hard limit or a fault
        duration: simulated time [s]
    """

    site: FloatArray
    normal: FloatArray
    depth: float
    force: float
    force_peak: float
    curve: FloatArray
    volume_ratio_smallest: float
    end: str
    duration: float


def press(simulation: Simulation, site: FloatArray, normal: FloatArray) -> Press:
    """Press the resting organ of a simulation once, along the inward normal, to its scene's depth or hard limit."""
    scene = simulation.anatomy.scene
    depth, clearance, force_limit = scene.palpation.press_depth, scene.palpation.clearance, scene.limits.hard_force
    radius = scene.instrument.tip_radius
    dt = simulation.haptic_dt
    simulation.restart(site + normal * (radius + clearance))
    go_in = round((clearance + depth) / (PRESS_SPEED * dt))
    hold = round(HOLD_TIME / dt)
    average = round(AVERAGE_TIME / dt)
    curve = np.zeros((go_in + hold, 2))
    end, force_peak, taken = "", 0.0, 0
    for step in range(go_in + hold):
        # A velocity is good for one control step: an arm's joint speeds are found anew.
        if step == go_in or step % scene.timing.haptic_steps_per_control == 0:
            simulation.instrument.command_velocity(-PRESS_SPEED * normal if step < go_in else np.zeros(3))
        if not simulation.haptic_step():
            end = simulation.fault
            break
        simulation.instrument.refresh()
        force = simulation.contact_force
        below = (site - simulation.instrument.tip_position) @ normal + radius
        curve[step] = below, force @ normal
        taken = step + 1
        force_peak = max(force_peak, float(np.sqrt(force @ force)))
        if force_peak > force_limit:
            end = f"force limit {force_limit:g} N"
            break
    warning = simulation.instrument.warning()
    last = curve[max(0, taken - average) : taken] if not end else curve[max(0, taken - 1) : taken]
    touching = curve[:taken][curve[:taken, 1] > 0.0]
    return Press(
        site=site,
        normal=normal,
        depth=float(last[:, 0].mean()),
        force=float(last[:, 1].mean()),
        force_peak=force_peak,
        curve=touching,
        volume_ratio_smallest=float(simulation.organ_state.volume_ratio_smallest[0]),
        end=end or warning,
        duration=simulation.time,
    )


def _core_count() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scan(
    anatomy: Anatomy,
    organ_model: OrganModel,
    sites: FloatArray,
    normals: FloatArray,
    *,
    progress: Callable[[], None] = lambda: None,
    workers: int | None = None,
) -> list[Press]:
    """Press each site of a resting organ; presses are independent, so the result does not depend on the workers.

    Args:
        anatomy: the scene's organ.
        organ_model: what is pressed, with or without lesions.
        sites: surface points [m], shape (n_site, 3).
        normals: unit outward normals there, shape (n_site, 3).
        progress: called after each press.
        workers: threads (the kernels hold no interpreter lock); all cores by default.

    Raises:
        ValueError: workers below 1.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers is {workers}; it must be at least 1, or left out for one per core")
    count = min(workers or _core_count(), max(1, len(sites)))
    stopped = threading.Event()

    def run(share: range) -> list[Press]:
        simulation = Simulation(anatomy)
        simulation.reset(organ_model, sites[0] + normals[0] * 0.05)
        presses = []
        try:
            for index in share:
                if stopped.is_set():
                    break
                presses.append(press(simulation, sites[index], normals[index]))
                progress()
        except BaseException:
            stopped.set()
            raise
        return presses

    shares = [range(start, len(sites), count) for start in range(count)]
    with ThreadPoolExecutor(count) as pool:
        try:
            results = list(pool.map(run, shares))
        except BaseException:
            # Ctrl-C, or an error in one share: the others end after the press they are at.
            stopped.set()
            raise
    merged: list[Press | None] = [None] * len(sites)
    for share, presses in zip(shares, results, strict=True):
        for index, one in zip(share, presses, strict=True):
            merged[index] = one
    return [one for one in merged if one is not None]
