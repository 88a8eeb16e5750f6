"""The spring and damper between a device and the instrument's tip, and the limit of their stiffness."""

import math
from dataclasses import dataclass

from surgsim_apps.haptics.device import DeviceDynamics, require_positive

# Stiffness of a default coupling as a share of the limit, and its damping as a share of the device's.
STIFFNESS_SHARE = 0.8
DAMPING_SHARE = 0.25
# Default stiffness without a limit by a device's damping [N/m]: a probe then lags by a millimetre or two.
STIFFNESS_FREE = 500.0


@dataclass(frozen=True)
class VirtualCoupling:
    """The force F = K e + B de/dt on the tip and -F on the device, with e from the tip to the device.

    (Virtual coupling: Colgate, Stanley & Brown 1995, "Issues in the haptic display of tool use".) de/dt is the
    difference quotient of two haptic steps.

    Args:
        stiffness: K [N/m].
        damping: B [N s/m], along the spring.

    Raises:
        ValueError: names the entry, its value and the rule.
    """

    stiffness: float
    damping: float = 0.0

    def __post_init__(self) -> None:
        require_positive("coupling stiffness", self.stiffness, "N/m")
        require_positive("coupling damping", self.damping, "N s/m", or_zero=True)


@dataclass(frozen=True)
class TipDynamics:
    """Smallest apparent mass of the instrument's tip over all directions [kg], and its damping [N s/m]."""

    mass: float
    damping: float


def stiffness_limit(device: DeviceDynamics, tip: TipDynamics, damping: float, haptic_step: float) -> float:
    """The stiffest passive coupling for any hand and organ [N/m]; 0 if there is none.

    A force held for T while device and tip move by T v_d and T v_t (velocities of one step) differs from the spring's;
    the difference adds at most T (K T / 2 + |B|) (|v_d| + |v_t|)^2 of energy per step, and a lag L between pose and
    force on the device's side adds T K L (|v_d| + |v_t|) |v_d|. Device and tip dissipate b_d T v_d^2 and b_t T v_t^2.
    That suffices if, with S = K T / 2 + |B| and D = K L,

        (b_d - S - D) (b_t - S) >= (S + D / 2)^2,    S <= b_t.

    For a tip at rest (b_t to infinity) this is K <= 2 (b_d - |B|) / (T + 2 L): Colgate & Schenkel 1997,
    "Passivity of a class of sampled-data systems", and each sample of lag costs K T of damping.

    Args:
        device: damping b_d, lag L.
        tip: damping b_t.
        damping: B of the coupling [N s/m].
        haptic_step: T [s].
    """
    lag, own, other = device.delay, device.damping, tip.damping
    # (b_d - S - D)(b_t - S) - (S + D/2)^2 = b_d b_t - S (b_d + b_t) - D b_t - D^2 / 4, a quadratic in K.
    margin = own * other - abs(damping) * (own + other)
    if margin <= 0.0:
        return 0.0
    slope = 0.5 * haptic_step * (own + other) + lag * other
    bend = 0.25 * lag * lag
    # This form of the root is also valid for bend = 0.
    return 2.0 * margin / (slope + math.sqrt(slope * slope + 4.0 * bend * margin))


def coupling_for(device: DeviceDynamics | None, tip: TipDynamics, haptic_step: float) -> VirtualCoupling:
    """The default coupling for a device: 0.8 of its limit with a quarter of its damping; without a device 500 N/m.

    Without a device the damping is critical for the tip's mass, within the limit of the explicit step.

    Raises:
        ValueError: a device with too little damping for any coupling.
    """
    if device is None:
        stiffness = min(STIFFNESS_FREE, 0.5 * tip.mass / haptic_step**2)
        return VirtualCoupling(stiffness, min(2.0 * math.sqrt(stiffness * tip.mass), 0.5 * tip.mass / haptic_step))
    damping = DAMPING_SHARE * min(device.damping, tip.damping)
    # The limit of the tip, as in `check_coupling`.
    bearable = (2.0 * tip.mass - 2.0 * damping * haptic_step) / haptic_step**2
    stiffness = STIFFNESS_SHARE * min(stiffness_limit(device, tip, damping, haptic_step), bearable)
    if stiffness <= 0.0:
        raise ValueError(
            f"device damping {device.damping:g} N s/m and tip damping {tip.damping:g} N s/m allow no coupling at "
            f"steps of {haptic_step * 1e3:g} ms: use a device with more damping"
        )
    return VirtualCoupling(stiffness, damping)


def check_coupling(
    coupling: VirtualCoupling, device: DeviceDynamics | None, tip: TipDynamics, haptic_step: float
) -> None:
    """Refuse a coupling too stiff for the device or the tip.

    Args:
        coupling: between device and tip.
        device: None if it exerts no force.
        tip: dynamics of the tip.
        haptic_step: T [s].

    Raises:
        ValueError: states the stiffness, the limit, its inputs, and the way out.
    """
    # Explicit steps of a mass on this spring and damper are unstable from K T^2 + 2 B T = 4 m; the limit is half of it.
    load = coupling.stiffness * haptic_step**2 + 2.0 * coupling.damping * haptic_step
    if load > 2.0 * tip.mass:
        raise ValueError(
            f"a coupling of {coupling.stiffness:g} N/m and {coupling.damping:g} N s/m is too stiff for a tip of "
            f"{tip.mass * 1e3:.3g} g at steps of {haptic_step * 1e3:g} ms: K T^2 + 2 B T must be at most 2 m, "
            f"{2.0 * tip.mass:.3g} kg, and is {load:.3g} kg; lower the stiffness or the damping"
        )
    if device is None:
        return
    limit = stiffness_limit(device, tip, coupling.damping, haptic_step)
    if coupling.stiffness > limit:
        raise ValueError(
            f"a coupling of {coupling.stiffness:g} N/m at the device's handle is stiffer than {limit:.4g} N/m, "
            f"the passivity limit with device damping {device.damping:g} N s/m, tip damping "
            f"{tip.damping:g} N s/m, coupling damping {coupling.damping:g} N s/m, a haptic step of "
            f"{haptic_step * 1e3:g} ms and a lag of {device.delay * 1e3:g} ms: lower the stiffness or the "
            "coupling's damping, or use a device with more damping or less delay"
        )
