"""Stiffening and relaxing springs: blocks at large strain, a step strain, creep under a weight, a held press.

The reference at large strain is the continuum of the organ's springs, in the seven directions of a BCC lattice: a
quadrature of degree 5 of springs in all directions (`all_directions`).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.sparse import csc_array

from msdm_core.kernels import OrganModel, OrganState
from msdm_core.material import Damping, Material, Relaxation, Stiffening
from msdm_core.meshing import box_mesh
from msdm_core.organ import OrganSpec, advance_or_raise, blank_state, compile_organ, rest_state
from surgsim_apps.validation.continuum import (
    SpringSolid,
    bar_gradient,
    lattice_directions,
    simple_shear_stress,
    sphere_directions,
    stretch_across,
    uniaxial_stress,
)
from surgsim_apps.validation.elements import BallContact
from surgsim_apps.validation.hyperelastic import OrganBlock, Plates, QuadraticBlock, Test, solved
from surgsim_apps.validation.punch import reference_layer
from surgsim_apps.validation.relaxation import ViscoelasticBody, spring_creep
from surgsim_apps.validation.row import Curve, Result, Row, bounded, compare
from surgsim_apps.validation.statics import DENSITY, assemble_stiffness, nodal_dofs, nodes_at
from surgsim_apps.validation.touch import PRESS_SPEED, STEP, BallOnOrgan, ball, phantom
from surgsim_env.scene import load_anatomy, make_scene

MODULUS = 5e3  # [Pa]
RATIO = 0.45
SIZE = (0.04, 0.04, 0.04)  # [m]
# As identified for pig liver, with the steepest stiffening.
STIFFENING = Stiffening(onset_strain=0.06, cap_strain=0.16, tangent_cap=30.0)
ARMS = Relaxation(relative_moduli=(0.3, 0.3, 0.3), times=(0.05, 0.5, 5.0))
LARGEST = 0.4
COMPRESSED = 0.32
STRAIN_STEP = 0.04
LARGE_TOLERANCE = 0.10
RELAXED_TOLERANCE = 0.02
PRESS_TOLERANCE = 0.10
TIMES = (0.01, 0.1, 1.0, 10.0, 100.0)  # [s]
CREEP_TIMES = (0.3, 1.0, 3.0, 10.0, 30.0)  # [s]
TESTS: dict[Test, str] = {"slide": "free sides", "pull": "bonded ends", "shear": "bonded ends"}
# Of the motion of bonded ends: strain a second, time to rest [s] and damping [1/s].
SPEED, REST, ALPHA = 1.0, 0.15, 300.0


def solid_of(material: Material, *, lattice: bool = True) -> SpringSolid:
    """Continuum of a material's springs, in the directions of the lattice or all."""
    shear_modulus = material.youngs_modulus / (2.0 * (1.0 + material.poisson_ratio))
    directions = lattice_directions() if lattice else sphere_directions()
    return SpringSolid(shear_modulus, material.volume_modulus, material.stiffening, directions)


def free_block_forces(cells: int, material: Material, strains: tuple[float, ...]) -> list[float]:
    """Forces on the end of a cube with free sides, drawn apart to strains [N], in static equilibrium."""
    mesh = box_mesh(SIZE, (cells,) * 3, top_nodes=False)
    return OrganBlock(mesh, compile_organ(OrganSpec(mesh, material)), material.stiffening).forces("slide", strains)


def bonded_block_forces(cells: int, material: Material, test: Test, strains: tuple[float, ...]) -> list[float]:
    """Forces on the upper end of a cube with bonded ends [N], moved to strains and at rest there."""
    mesh = box_mesh(SIZE, (cells,) * 3, top_nodes=False)
    plates = Plates.of(mesh.points, test)
    ends, direction = plates.held.reshape(-1, 3)[:, 0] // 3, plates.direction.reshape(-1, 3)
    model = compile_organ(OrganSpec(mesh, material, anchors=ends, damping=Damping(alpha=ALPHA)))
    state, before, forces = blank_state(model), 0.0, []
    for strain in strains:
        count = max(1, round(abs(strain - before) / (SPEED * STEP)))
        for target in np.linspace(before, strain, count + 1)[1:]:
            state.node_position[ends] = model.node_rest_position[ends] + target * direction
            advance_freely(model, state, STEP)
        advance_freely(model, state, REST)
        forces.append(float(-state.node_force.ravel()[plates.loaded].sum()))
        before = strain
    return forces


def large_strain(test: Test, cells: int, stiffening: Stiffening | None) -> Iterator[Result]:
    """Tension and compression, or shear, of a cube to 40 % against the continuum of its springs.

    The reference is a closed form for free sides, quadratic hexahedra for bonded ends. Stiffening springs are
    compressed to COMPRESSED alone: see `ellipticity`.
    """
    material = Material(MODULUS, DENSITY, RATIO, stiffening=stiffening)
    solid, law = solid_of(material), "linear" if stiffening is None else "stiffening"
    # Simple shear strains springs by half its amount.
    cap = LARGEST / 2.0 if stiffening is None else stiffening.cap_strain * (2.0 if test == "shear" else 1.0)
    signs = {"sheared": 1.0} if test == "shear" else {"pulled": 1.0, "compressed": -1.0}
    for name, sign in signs.items():
        most = COMPRESSED if stiffening is not None and sign < 0.0 else LARGEST
        shown = [strain for strain in (0.5 * cap, 0.75 * cap, cap, most) if strain <= most]
        sizes = np.unique(np.round([*np.arange(STRAIN_STEP, most + 1e-9, STRAIN_STEP), *shown], 6))
        signed = tuple((sign * sizes).tolist())
        source = "springs as a continuum"
        if test == "slide":
            measured = free_block_forces(cells, material, signed)
            reference = (uniaxial_stress(solid, 1.0 + np.array(signed)) * SIZE[0] * SIZE[1]).tolist()
        else:
            measured = bonded_block_forces(cells, material, test, signed)
            reference = QuadraticBlock.of(SIZE, (4, 4, 4)).forces(solid, test, signed)
            source = f"scikit-fem, {source}"
        for strain in shown:
            at = int(np.argmin(np.abs(sizes - strain)))
            yield compare(
                f"cube, {law}, {TESTS[test]}, {name} by {100.0 * strain:.0f} %, cell {1e3 * SIZE[0] / cells:.1f} mm",
                source, expected=reference[at], measured=measured[at], tolerance=LARGE_TOLERANCE, unit="N",
                note="beyond the strain where the cap begins" if stiffening is not None and strain > cap else "",
            )  # fmt: skip
        figure, labels = f"cube_{law}_{'sheared' if test == 'shear' else TESTS[test]}", ("strain", "force [N]", False)
        for label, force in (("organ", measured), ("reference", reference)):
            yield Curve(figure.replace(" ", "_"), f"{label}, {name}", signed, force, *labels)


def ellipticity() -> Iterator[Row]:
    """Compression along an axis at the loss of ellipticity of the lattice's continuum, against the begin of the cap.

    From there on the acoustic tensor A_ijkl N_j N_l has a negative eigenvalue for a direction N: columns of steep
    springs under compression buckle, in waves as short as cells.
    """
    material = Material(MODULUS, DENSITY, RATIO, stiffening=STIFFENING)
    normals, limits = sphere_directions(24)[0], {}
    for name, solid in (("lattice", solid_of(material)), ("all", solid_of(material, lattice=False))):
        limits[name] = LARGEST
        for strain in np.arange(0.01, LARGEST, 0.005):
            stretch = np.array([1.0 - strain])
            tensor = solid.tangent(bar_gradient(stretch, stretch_across(solid, stretch)))[0]
            if np.linalg.eigvalsh(np.einsum("ijkl,nj,nl->nik", tensor, normals, normals)).min() < 0.0:
                limits[name] = float(strain)
                break
    yield bounded(
        "compression along an axis at which springs of the lattice buckle", "the strain where the cap begins",
        measured=limits["lattice"], least=STIFFENING.cap_strain,
        note=f"springs in all directions: at least {limits['all']:.2f}; {STIFFENING}",
    )  # fmt: skip


def all_directions() -> Iterator[Result]:
    """Springs of the lattice against springs in all directions, pulled and sheared along axes of the lattice.

    The tolerance is that of the organ's block, which has the same directions.
    """
    material = Material(MODULUS, DENSITY, RATIO, stiffening=STIFFENING)
    lattice, isotropic = solid_of(material), solid_of(material, lattice=False)
    half = 0.5 * (STIFFENING.onset_strain + STIFFENING.cap_strain)
    for strain in (half, STIFFENING.cap_strain):
        for name, stress, size in (
            ("pulled", uniaxial_stress, 1.0 + strain),
            ("compressed", uniaxial_stress, 1.0 - strain),
            ("sheared", simple_shear_stress, 2.0 * strain),
        ):
            shown = 200.0 * strain if name == "sheared" else 100.0 * strain
            yield compare(
                f"springs of the lattice, {name} along an axis by {shown:.0f} %", "springs in all directions",
                expected=stress(isotropic, np.array([size]))[0],
                measured=stress(lattice, np.array([size]))[0], tolerance=LARGE_TOLERANCE, unit="Pa",
                note=f"{STIFFENING}",
            )  # fmt: skip
    strain, labels = np.linspace(-0.3, 0.3, 31), ("strain", "stress [Pa]", False)
    for solid, springs in ((lattice, "springs of the lattice"), (isotropic, "springs in all directions")):
        along, shear = uniaxial_stress(solid, 1.0 + strain), simple_shear_stress(solid, strain)
        for name, stress in (("along an axis", along), ("shear", shear)):
            yield Curve("stiffening", f"{springs}, {name}", strain, stress, *labels)


def advance_freely(model: OrganModel, state: OrganState, duration: float) -> None:
    """Advance an untouched organ by a duration [s]."""
    # Far beyond the cap the tissue is stiffer than at rest: the scenes' share of the limit.
    count = int(np.ceil(duration / (0.6 * model.stable_step)))
    advance_or_raise(model, state, duration / count, count)


def step_strain(arms: Relaxation, stiffening: Stiffening | None = None) -> Iterator[Row]:
    """Cube of springs alone, sheared by 20 % in a step to its elastic equilibrium between plates.

    All springs relax by the same factor, and the equilibrium stays.
    """
    mesh = box_mesh(SIZE, (4, 4, 4))
    top = nodes_at(mesh.points, SIZE[2])
    ends = np.union1d(nodes_at(mesh.points, 0.0), top)
    material = Material(MODULUS, DENSITY, 0.25, stiffening=stiffening)
    # About critical for its first mode of shear, sqrt(G / rho) / (2 h) = 17 Hz.
    spec = OrganSpec(mesh, material, anchors=ends, damping=Damping(alpha=220.0))
    elastic = compile_organ(spec)
    start = blank_state(elastic)
    start.node_position[:, 0] += 0.2 * mesh.points[:, 2]
    advance_freely(elastic, start, 1.0)
    model = compile_organ(replace(spec, materials=replace(material, relaxation=arms)))
    state, before = blank_state(model), 0.0
    state.node_position[:] = start.node_position
    law = "linear" if stiffening is None else "stiffening"
    for time in TIMES:
        advance_freely(model, state, time - before)
        before = time
        force = float(state.node_force[top, 0].sum() / start.node_force[top, 0].sum())
        yield compare(
            f"step strain, {law} springs, after {time:g} s", "1 + sum g exp(-t / tau)",
            expected=arms.remaining(time), measured=force,
            tolerance=RELAXED_TOLERANCE, note="force over the elastic one",
        )  # fmt: skip


def creep(arms: Relaxation, poisson_ratio: float) -> Iterator[Row]:
    """Cube on its base under a sudden small weight: sinking of its top over the elastic sinking."""
    mesh = box_mesh(SIZE, (4, 4, 4))
    base, top = nodes_at(mesh.points, 0.0), nodes_at(mesh.points, SIZE[2])
    material = Material(MODULUS, DENSITY, poisson_ratio, relaxation=arms)
    # About critical for its first mode: sqrt(E / rho) / (4 h) = 14 Hz. A strain of 1e-4 is linear.
    spec = OrganSpec(mesh, material, anchors=base, damping=Damping(alpha=170.0), gravity=(0.0, 0.0, -0.01))
    model = compile_organ(spec)
    free = np.setdiff1d(np.arange(mesh.points.size), nodal_dofs(base))
    elastic = compile_organ(replace(spec, materials=replace(material, relaxation=None), gravity=(0.0, 0.0, 0.0)))
    weight = (model.node_mass[:, None] * model.gravity).ravel()
    end = np.zeros(mesh.points.size)
    end[free] = solved(csc_array(assemble_stiffness(elastic)), free, weight[free])
    sinking = end.reshape(-1, 3)[top, 2].mean()
    # Springs and volumes relax alike: the same at every Poisson's ratio.
    expected, source = spring_creep(arms, np.array(CREEP_TIMES)), "linear equations of the arms"
    state, before = blank_state(model), 0.0
    for time, share in zip(CREEP_TIMES, expected, strict=True):
        advance_freely(model, state, time - before)
        before = time
        measured = float((state.node_position - model.node_rest_position)[top, 2].mean() / sinking)
        yield compare(
            f"creep, nu {poisson_ratio:.2f}, after {time:g} s", source, expected=share, measured=measured,
            tolerance=RELAXED_TOLERANCE, note="sinking of the top over the elastic one",
        )  # fmt: skip


# Held press: ball [m], depth [m], and times after its end [s].
TIP, DEPTH = 0.008, 0.002
HOLD_TIMES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)


@lru_cache(maxsize=4)
def reference_press(arms: Relaxation) -> tuple[float, ...]:
    """Forces of the ball at HOLD_TIMES after a press at PRESS_SPEED [N], by axisymmetric elements."""
    scene = make_scene("phantom")
    modulus, nu = scene.material.youngs_modulus, scene.material.poisson_ratio
    layer = reference_layer(modulus, nu)
    # Springs and volumes relax alike.
    stiffness = csc_array(layer.stiffness)
    body = ViscoelasticBody(stiffness, csc_array(stiffness.shape), arms)
    contact = BallContact(layer, TIP, scene.contact.stiffness)
    ramp = DEPTH / PRESS_SPEED
    held = np.unique([*np.geomspace(0.005, HOLD_TIMES[-1], 22), *HOLD_TIMES[1:]])
    moments = [*np.linspace(0.0, ramp, 11)[1:], *(ramp + held)]
    displacement, before, forces = np.zeros(len(layer.place)), 0.0, []
    for moment in moments:
        stiffness, load = body.step(moment - before)
        depth = min(moment * PRESS_SPEED, DEPTH)
        force = contact.pressed(stiffness, load, layer.held, displacement, depth)
        body.accept(displacement, moment - before)
        before = moment
        if np.abs(np.array(HOLD_TIMES) + ramp - moment).min() < 1e-9:
            forces.append(force)
    return tuple(forces)


def organ_press(cells: int, arms: Relaxation) -> list[float]:
    """Forces of the ball at HOLD_TIMES on the phantom [N], without friction, in the middle of its top."""
    scene = phantom(cells)
    scene = replace(scene, material=replace(scene.material, relaxation=arms))
    law = scene.contact.law._replace(friction=0.0)
    touch = BallOnOrgan.on(load_anatomy(scene).organ()._replace(alpha=25.0), law)
    state, shapes = rest_state(touch.model, shape_count=1), ball((0.03, 0.03), TIP)
    force = touch.move(state, shapes, (0.0, 0.0, -PRESS_SPEED), round(DEPTH / (PRESS_SPEED * STEP)))[-1:, 2]
    held = touch.move(state, shapes, (0.0, 0.0, 0.0), round(HOLD_TIMES[-1] / STEP))[:, 2]
    return [float(force[-1]), *(float(held[round(time / STEP) - 1]) for time in HOLD_TIMES[1:])]


def held_press(cells: int) -> Iterator[Result]:
    """Ball pressed 2 mm into the phantom at 40 mm/s and held for 10 s."""
    expected, measured = reference_press(ARMS), organ_press(cells, ARMS)
    name = f"press held, cell {60.0 / cells:.1f} mm"
    for time, reference, force in list(zip(HOLD_TIMES, expected, measured, strict=True))[:-1]:
        yield compare(
            f"{name}, {time:g} s over {HOLD_TIMES[-1]:g} s", "scikit-fem, axisymmetric, quasi-linear",
            expected=reference / expected[-1], measured=force / measured[-1], tolerance=PRESS_TOLERANCE,
            note="tip 8 mm pressed 2 mm at 40 mm/s; the reference has small strains",
        )  # fmt: skip
    labels = ("time held [s]", "force [N]", False)
    yield Curve("press_held", f"organ, cell {60.0 / cells:.1f} mm", HOLD_TIMES, measured, *labels)
    yield Curve("press_held", "reference", HOLD_TIMES, expected, *labels)
