"""Make the picture of docs/real_tissue.md: python docs/make_tissue_picture.py (some minutes)."""

import math
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from msdm_core import Damping, Lesion, Material, OrganSpec, box_mesh, compile_organ
from msdm_core.kernels import ContactLaw
from msdm_core.organ import advance, rest_state, round_shapes, stable_dt
from surgsim_env import make_material

IMAGES = Path(__file__).parent / "images"
# A block with a lesion of five times the modulus under 3 mm of tissue, pressed by the ball of the recordings.
SIZE, CELLS = (0.048, 0.048, 0.020), (24, 24, 10)
RADIUS, LESION_RADIUS, COVER, RATIO = 0.00635, 0.005, 0.003, 5.0
DEPTH, SPEED = 0.004, 0.02
SPEEDS = (0.001, 0.01, 0.1)
CONTACT = ContactLaw(stiffness=1e8, damping=100.0, friction=0.0, tangential_stiffness=1e8)
ALPHA = 60.0

FloatArray = NDArray[np.float64]


def press(material: Material, speed: float, *, lesion: bool) -> tuple[FloatArray, FloatArray]:
    """Depths [m] and forces [N] of a press at a speed [m/s]."""
    mesh = box_mesh(SIZE, CELLS)
    middle, top = SIZE[0] / 2.0, SIZE[2]
    stiff = replace(material, youngs_modulus=RATIO * material.youngs_modulus)
    hidden = Lesion((middle, middle, top - COVER - LESION_RADIUS), LESION_RADIUS, stiff)
    organ = compile_organ(
        OrganSpec(
            mesh,
            material,
            anchors=np.flatnonzero(mesh.points[:, 2] < 1e-9),
            lesions=(hidden,) if lesion else (),
            damping=Damping(ALPHA),
        )
    )
    count = math.ceil(1e-3 / (0.9 * stable_dt(organ, CONTACT)))
    centre = np.array([middle, middle, top + RADIUS])
    shapes = round_shapes([[centre, centre]], RADIUS, twist=[[0.0, 0.0, -speed, 0.0, 0.0, 0.0]])
    state = rest_state(organ, shape_count=1)
    steps = round(DEPTH / speed * 1e3)
    forces = [
        float(advance(organ, state, dt=1e-3 / count, substep_count=count, shapes=shapes, contact=CONTACT)[0, 2])
        for _ in range(steps)
    ]
    return (np.arange(steps) + 0.5) * 1e-3 * speed, np.array(forces)


def main() -> None:
    """Force and contrast over depth for linear and stiffening tissue, and for three speeds with relaxation."""
    console = Console()
    relaxing = make_material("pig_liver_ex_vivo_relaxing").material
    modulus, density, ratio = relaxing.youngs_modulus, relaxing.density, relaxing.poisson_ratio
    cases = [
        ("linear", Material(modulus, density, ratio), SPEED, "C0-"),
        ("stiffening", Material(modulus, density, ratio, relaxing.stiffening), SPEED, "C3-"),
        *(
            (f"stiffening and relaxing, {1e3 * speed:g} mm/s", relaxing, speed, style)
            for speed, style in zip(SPEEDS, ("C1:", "C1--", "C1-."), strict=True)
        ),
    ]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.2), layout="constrained")
    for name, material, speed, style in cases:
        with console.status(name):
            depth, healthy = press(material, speed, lesion=False)
            _, ill = press(material, speed, lesion=True)
        deep = depth > 0.0005
        left.plot(1e3 * depth, healthy, style, label=name)
        right.plot(1e3 * depth[deep], ill[deep] / healthy[deep], style, label=name)
        console.print(f"{name}: contrast {np.interp([0.001, 0.002, 0.003], depth, ill / np.maximum(healthy, 1e-9))}")
    left.set(xlabel="depth [mm]", ylabel="force on healthy tissue [N]", title="force")
    right.set(xlabel="depth [mm]", ylabel="force over the lesion / healthy", title="contrast of a lesion")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend(fontsize=8)
    figure.savefig(IMAGES / "real_tissue.png", dpi=110)


if __name__ == "__main__":
    main()
