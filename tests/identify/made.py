"""Recordings made for tests, and a closed-form stand-in for the organ's press."""

import math

import numpy as np

from surgsim_apps.identify.press_model import PressCurve
from surgsim_apps.identify.recordings import Recording, SitePress
from surgsim_apps.identify.relaxation import Arms

HEADER = "site,x_mm,y_mm,z_mm,step,depth_mm,normal_force_n,tangential_force_n"


def closed_area(depth, shape):
    """Force over modulus of a made-up tissue [m^2]: d^1.5 e^(b d), steeper with the law and in thin tissue."""
    growth = math.log(shape.tangent_cap) / (shape.onset_strain + shape.cap_strain) + 0.5e-3 / shape.thickness
    return 0.1 * np.maximum(depth, 0.0) ** 1.5 * np.exp(30.0 * growth * np.maximum(depth, 0.0))


def closed_press(shape, setting):
    """In place of `press_block`."""
    depth = np.linspace(0.0, setting.depth, 40)
    return PressCurve(depth, closed_area(depth, shape), depth / 0.01, 0.6)


def truth(count=24, seed=0, offset=1e-3):
    """Moduli [Pa] and offsets [m] of the sites that `recording` makes."""
    rng = np.random.default_rng(seed)
    return 5000.0 * np.exp(0.4 * rng.standard_normal(count)), rng.uniform(0.0, offset, count)


def recording(area, *, count=24, depth=3e-3, samples=10, noise=0.0, seed=0, name="made", offset=1e-3, time=None,
              arms=None):  # fmt: skip
    """A set whose sites have the moduli and offsets of `truth`: F = E A(d + o), with arms where times are given."""
    rng = np.random.default_rng(1000 + seed)
    presses = []
    for site, (modulus, shift) in enumerate(zip(*truth(count, seed, offset))):
        travel = np.linspace(depth / samples, depth, samples)
        if time is not None:
            travel = np.minimum(time / time[samples - 1], 1.0) * depth
        force = area(travel + shift)
        if arms is not None:
            force = (arms or Arms()).relaxed(force[None], time[None])[0]
        force = modulus * force * (1.0 + noise * rng.standard_normal(len(travel)))
        place = np.array([1e-3 * (site % 6), 1e-3 * (site // 6), 0.0])
        presses.append(SitePress(site, place, travel, force, time))
    return Recording(name, tuple(presses))


def write_csv(made, path):
    """The set as a file with the columns of real ones."""
    has_time = made.presses[0].time is not None
    lines = [HEADER + (",time_s" if has_time else "")]
    for press in made.presses:
        for step, (depth, force) in enumerate(zip(press.depth, press.force)):
            x, y, z = 1e3 * press.place
            line = f"{press.site},{x:.3f},{y:.3f},{z:.3f},{step},{1e3 * depth:.5f},{force:.8f},0.0"
            lines.append(line + (f",{press.time[step]:.5f}" if has_time else ""))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
