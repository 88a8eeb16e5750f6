"""Largest stiffness of a haptic coupling: the limit of `stiffness_limit`, and where a simulated device fails.

    python benchmarks/haptic_stability.py --out docs/images/haptic_stability.png

A device of 50 g with some damping, pushed down with 0.3 N by a hand without damping, presses the scene phantom_small
for 1.5 s through couplings of growing stiffness. Bisection finds the least stiffness at which the loop gives the hand
more energy than it took, or at which the device still oscillates with 0.1 m/s at the end. Prints `name value unit`
lines; takes minutes.
"""

import argparse
from pathlib import Path

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.haptics.coupling import DAMPING_SHARE, TipDynamics, VirtualCoupling, stiffness_limit
from surgsim_env.haptics.device import DeviceDynamics
from surgsim_env.haptics.loop import HapticLoop
from surgsim_env.haptics.settings import ForceLimits, HapticSettings, WatchdogTimes
from surgsim_env.haptics.simulated import Hand, SimulatedDevice
from surgsim_env.haptics.tip_drive import tip_drives
from surgsim_env.reports.output_folder import output_folder
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene

DT = 1e-3
START = np.array([0.02, 0.02, 0.0285])
STEPS = 1500
MASS = 0.05
DAMPINGS = (0.1, 0.2, 0.5, 1.0, 2.0)
# Haptic steps of delay, and the colour of each.
DELAYS = {0: "#1b6f8a", 1: "#c8553d", 3: "#6a4c93"}
BISECTIONS = 6


class UndeclaredDevice(SimulatedDevice):
    """A device that declares no dynamics, so that no coupling is refused."""

    @property
    def dynamics(self) -> None:
        """Not declared."""


def fails(simulation: Simulation, organ: OrganModel, damping: float, delay: int, stiffness: float) -> bool:
    """Whether contact through a coupling generates energy, or keeps oscillating."""
    simulation.reset(organ, START)
    hand = Hand(push=(0.0, 0.0, -0.3))
    device = UndeclaredDevice(mass=MASS, damping=damping, haptic_step=DT, position=START, hand=hand, pose_delay=delay)
    settings = HapticSettings(
        VirtualCoupling(stiffness, coupling_damping(damping)),
        ForceLimits(15.0, 1e5),
        WatchdogTimes(resume=DT),
        smoothing=0.0,
    )
    loop = HapticLoop(simulation, device, settings)
    for _ in range(STEPS):
        told = loop.step()
        device.advance()
        if told.fault or device.work > 1e-9:
            return True
    return float(np.abs(device.velocity).max()) > 0.1


def promised_stiffness(tip: TipDynamics, damping: float, delay: int) -> float:
    """`stiffness_limit` with the damper that `coupling_for` takes [N/m]."""
    device = DeviceDynamics(damping, MASS, delay * DT)
    return stiffness_limit(device, tip, coupling_damping(damping), DT)


def coupling_damping(damping: float) -> float:
    """DAMPING_SHARE of the damping of the device, of at most 2 N s/m [N s/m]."""
    return DAMPING_SHARE * min(damping, 2.0)


def failing_stiffness(simulation: Simulation, organ: OrganModel, damping: float, delay: int, limit: float) -> float:
    """The least stiffness that fails, within a few per cent, between half the limit and sixteen times it [N/m]."""
    low, high = np.log(0.5 * limit), np.log(16.0 * limit)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if fails(simulation, organ, damping, delay, float(np.exp(middle))):
            high = middle
        else:
            low = middle
    return float(np.exp(high))


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/haptic_stability.png"))
    options = parser.parse_args()
    anatomy = load_anatomy(make_scene("phantom_small"))
    simulation, organ = Simulation(anatomy), anatomy.organ(anatomy.demonstration_lesions())
    (drive,) = tip_drives(simulation.instrument, DT)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 4.4), dpi=150, layout="constrained")
    smooth = np.geomspace(0.08, 2.5, 100)
    promised, failing = [], []
    for delay, colour in DELAYS.items():
        curve = np.array([promised_stiffness(drive.dynamics, damping, delay) for damping in smooth])
        promised += axes.plot(smooth, curve, color=colour, label=f"promised, {delay} ms of delay")
        axes.fill_between(smooth, 5.0, curve, color=colour, alpha=0.06, linewidth=0)
        found = []
        for damping in DAMPINGS:
            limit = promised_stiffness(drive.dynamics, damping, delay)
            found.append(failing_stiffness(simulation, organ, damping, delay, limit))
            name = f"haptic_stability/b={damping:g}/delay={delay}ms"
            print(f"{name}/promised {limit:.1f} N/m")
            print(f"{name}/fails_at {found[-1]:.1f} N/m", flush=True)
        failing += axes.plot(
            DAMPINGS, found, "x", color=colour, markersize=7, label=f"gives energy from here, {delay} ms"
        )
    axes.set(
        xscale="log", yscale="log", xlabel="damping of the device [N s/m]", ylabel="stiffness of the coupling [N/m]"
    )
    axes.set(xlim=(0.08, 2.5), ylim=(10.0, 2e4), title="Stiffness of a coupling: promised, and where contact fails")
    axes.set_xticks(DAMPINGS, [f"{damping:g}" for damping in DAMPINGS])
    axes.minorticks_off()
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.legend(handles=promised + failing, fontsize=8, ncols=2, loc="upper left", frameon=False)
    with output_folder(options.out.parent) as files:
        figure.savefig(files / options.out.name)


if __name__ == "__main__":
    main()
