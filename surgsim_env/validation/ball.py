"""End-to-end ball indentation of the phantom against axisymmetric finite elements."""

from dataclasses import replace

import numpy as np

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.press import press
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import BlockMesh, MeshSource, Scene
from surgsim_env.validation.layer_fem import ball_force, layer
from surgsim_env.validation.punch import DISC, SIZE
from surgsim_env.validation.row import Curve, Outcome, compare

FORCE_TOLERANCE = 0.20
EXPONENT_TOLERANCE = 0.1
# Sites within a cell of the middle, in cells, so that the mean is over the places of a ball on the lattice.
OFFSETS = ((0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.25, 0.25), (0.25, 0.5))


def held_forces(scene: Scene, depths: tuple[float, ...]) -> list[float]:
    """Mean force of presses around the middle of a block without a lesion, held at each depth [N]."""
    assert scene.mesh.block is not None
    cell = scene.mesh.block.size[0] / scene.mesh.block.cells[0]
    anatomy = load_anatomy(scene)
    organ = anatomy.organ()
    up = np.array([0.0, 0.0, 1.0])
    sites = [np.array([0.03 + x * cell, 0.03 + y * cell, SIZE[2]]) for x, y in OFFSETS]
    forces: list[float] = []
    for depth in depths:
        pressed = replace(scene, palpation=replace(scene.palpation, press_depth=depth))
        simulation = Simulation(replace(anatomy, scene=pressed))
        simulation.reset(organ, sites[0] + 0.03 * up)
        presses = [press(simulation, site, up) for site in sites]
        if any(one.end for one in presses):
            raise ValueError(f"a press ended early: {next(one.end for one in presses if one.end)}")
        forces.append(float(np.mean([one.force for one in presses])))
    return forces


def phantom(cells: int) -> Scene:
    """The scene `phantom` with `cells` cells along 6 cm and as many substeps as these need."""
    scene = make_scene("phantom")
    mesh = MeshSource(block=BlockMesh(SIZE, (cells, cells, cells // 2)))
    return replace(scene, mesh=mesh, timing=replace(scene.timing, substep_count=max(4, cells // 3)))


def ball_on_layer(cells: int, depths: tuple[float, ...]) -> Outcome:
    """Force at the scene's press depth, and how it rises with depth."""
    scene = phantom(cells)
    material, radius = scene.material, scene.instrument.tip_radius
    body = layer(DISC, SIZE[2], lambda r, _: np.full_like(r, material.youngs_modulus), material.poisson_ratio)
    reference = [ball_force(body, radius, depth, scene.contact.stiffness) for depth in depths]
    measured = held_forces(scene, depths)
    exponents = [float(np.polyfit(np.log(depths), np.log(force), 1)[0]) for force in (measured, reference)]
    cell = SIZE[0] / cells
    shares = [f"{cell / np.sqrt(radius * depth):.1f}" for depth in depths]
    name = f"ball on the phantom, cell {1e3 * cell:.1f} mm"
    rows = (
        compare(
            f"{name}, force", "scikit-fem, axisymmetric, same k_p", expected=reference[-1],
            measured=measured[-1], tolerance=FORCE_TOLERANCE, unit="N",
            note=f"mean of {len(OFFSETS)} sites, {1e3 * depths[-1]:g} mm deep, ball of {1e3 * radius:g} mm, "
            f"cell / contact radius {shares[-1]}; the reference has small strains",
        ),
        compare(
            f"{name}, exponent", "Hertz, F ~ d^1.5", expected=1.5, measured=exponents[0],
            tolerance=EXPONENT_TOLERANCE, absolute=True,
            note=f"over {1e3 * depths[0]:g} to {1e3 * depths[-1]:g} mm, cell / contact radius {shares[0]} to "
            f"{shares[-1]}; the reference elements give {exponents[1]:.2f}",
        ),
    )  # fmt: skip
    millimetres = tuple(1e3 * depth for depth in depths)
    # The reference is the same for every cell size and is drawn once.
    lines = ((f"cell {1e3 * cell:.1f} mm", measured), ("reference", reference))[: 2 if cells == 12 else 1]
    labels = ("depth [mm]", "force [N]", False)
    return Outcome(rows, tuple(Curve("ball", label, millimetres, tuple(force), *labels) for label, force in lines))
