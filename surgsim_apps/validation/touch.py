"""Ball on the phantom, moved by the scene's instrument or prescribed, against axisymmetric finite elements.

Force from site to site, over a lesion and with depth; contact in deep presses.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.errors import OrganDivergedError
from msdm_core.kernels import ContactLaw, ContactShapes, OrganModel, OrganState
from msdm_core.material import Damping, Lesion
from msdm_core.mesh import FloatArray
from msdm_core.meshing import box_mesh
from msdm_core.organ import OrganSpec, advance_or_raise, compile_organ, rest_state, round_shapes, stable_dt
from surgsim_apps.validation.finite_press import PressedLayer, layer_mesh, spring_law
from surgsim_apps.validation.punch import DISC, SIZE, Hidden, modulus_field
from surgsim_apps.validation.row import Curve, Result, Row, compare
from surgsim_apps.validation.statics import nodes_at
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import press
from surgsim_env.scene import BlockMesh, MeshSource, Scene, load_anatomy, make_scene, mesh_bias, press_modulus

REFERENCE = "scikit-fem, axisymmetric, neo-Hookean, rigid tip"
# Press by the instrument: tolerances, and sites within a cell of the middle, in cells, for a mean over the places of a
# ball on the lattice.
FORCE_TOLERANCE = 0.20
EXPONENT_TOLERANCE = 0.1
OFFSETS = ((0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.25, 0.25), (0.25, 0.5))

# Estimate of the mesh's share of a force, against the measured mean.
BIAS_TOLERANCE = 0.03
# Tip radii and depths [m] of its presses.
BIAS_PRESSES = ((0.005, 0.003), (0.008, 0.002), (0.008, 0.004), (0.012, 0.004))

# Elements of the reference [m]: fine size, and its reach across and down.
FINE, NEAR = 8e-4, (0.0128, 0.016)

# Slab of the liver's tissue: cells across and down, its sphere, press depths [m], tolerance with the mesh's part.
SLAB_COUNT = (16, 10)
LIVER_SPHERE = Hidden(6.0, 0.005, 0.020)
LIVER_DEPTHS = (0.003, 0.005, 0.007)
LIVER_TOLERANCE = 0.10
SLAB_ALPHA, SLAB_HOLD = 60.0, 220  # [1/s], haptic steps

STEP = 1e-3  # [s] the haptic step
PRESS_SPEED = 0.04  # [m/s]
HOLD_COUNT = 150
# Critical for the block's first shear mode (10 Hz): after the hold the force is static to 1e-4.
ALPHA = 126.0
# Largest distance of sites from the middle [m]: two cells each way, for all places on the lattice, 25 mm off the edges.
REACH = 0.005
CONTRAST_TOLERANCE = 0.15
# Cells along 6 cm and hidden sphere: cell <= radius / 2 and cell <= cover.
CONTRASTS = (
    (12, Hidden(4.0, 0.005, 0.010)),
    (12, Hidden(8.0, 0.005, 0.010)),
    (12, Hidden(8.0, 0.010, 0.010)),
    (18, Hidden(8.0, 0.005, 0.010)),
    (18, Hidden(8.0, 0.004, 0.008)),
)
# Sites of deep presses [m].
PLACES = {"a node": (0.03, 0.03), "an edge": (0.0325, 0.03), "a face": (0.03333, 0.03167)}


def phantom(cells: int) -> Scene:
    """Scene `phantom` with `cells` cells along 6 cm and substeps for them."""
    scene = make_scene("phantom")
    mesh = MeshSource(block=BlockMesh(SIZE, (cells, cells, cells // 2)))
    return replace(scene, mesh=mesh, timing=replace(scene.timing, substep_count=max(4, cells // 3)))


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
        end = next((touch.end for touch in presses if touch.end), "")
        if end:
            raise ValueError(f"a press ended early: {end}")
        forces.append(float(np.mean([touch.force for touch in presses])))
    return forces


@dataclass(frozen=True, eq=False)
class BallOnOrgan:
    """Ball with prescribed motion on an organ: the organ, its contact law, the substeps of a haptic step."""

    model: OrganModel
    law: ContactLaw
    substep_count: int

    @classmethod
    def on(cls, model: OrganModel, law: ContactLaw) -> "BallOnOrgan":
        """Organ with the substeps that it needs."""
        return cls(model, law, math.ceil(STEP / (0.95 * stable_dt(model, law))))

    def move(self, state: OrganState, shapes: ContactShapes, velocity: ArrayLike, count: int) -> FloatArray:
        """Force on the ball in each haptic step at a velocity [m/s], shape (count, 3) [N].

        Raises:
            OrganDivergedError: a fault.
        """
        shapes.tool_twist[0, :3] = velocity
        force = np.zeros((count, 3))
        dt = STEP / self.substep_count
        for number in range(count):
            force[number] = advance_or_raise(self.model, state, dt, self.substep_count, shapes, self.law)[0, :3]
        return force

    def held(self, site: ArrayLike, radius: float, depth: float) -> float:
        """Static force of a ball pressed into a site of the top [N]."""
        state = rest_state(self.model, shape_count=1)
        shapes = ball(site, radius)
        self.move(state, shapes, (0.0, 0.0, -PRESS_SPEED), round(depth / (PRESS_SPEED * STEP)))
        force = self.move(state, shapes, (0.0, 0.0, 0.0), HOLD_COUNT)[:, 2]
        if abs(force[-20] / force[-1] - 1.0) > 1e-4:
            raise ValueError(f"the press at {site} did not come to rest")
        return float(force[-1])


def ball(site: ArrayLike, radius: float) -> ContactShapes:
    """Ball in touch with the block's top at (x, y) [m]."""
    x, y = np.asarray(site, dtype=np.float64)
    centre = np.array([x, y, SIZE[2] + radius])
    return round_shapes([[centre, centre]], radius)


def block(
    cells: int, *, alpha: float | None = ALPHA, lesions: tuple[Lesion, ...] = (), friction: float | None = None
) -> BallOnOrgan:
    """Phantom with `cells` cells along 6 cm; `alpha` [1/s] and `friction` replace the scene's."""
    scene = phantom(cells)
    model, law = load_anatomy(scene).organ(lesions), scene.contact.law
    return BallOnOrgan.on(
        model if alpha is None else model._replace(alpha=alpha),
        law if friction is None else law._replace(friction=friction),
    )


@lru_cache(maxsize=16)
def reference_force(radius: float, depth: float, hidden: Hidden | None = None) -> float:
    """Force of a rigid ball by axisymmetric elements at finite strain [N], over a sphere if given."""
    scene = make_scene("phantom")
    field, mesh = modulus_field(scene.material.youngs_modulus, hidden), layer_mesh(DISC, SIZE[2], FINE, NEAR)
    return PressedLayer(mesh, field, scene.material.poisson_ratio).forces(radius, (depth,))[0]


def ball_on_layer(cells: int, depths: tuple[float, ...]) -> Iterator[Result]:
    """Force of the instrument's ball at the scene's press depth, and its exponent with depth."""
    scene = phantom(cells)
    radius, cell = scene.instrument.tip_radius, SIZE[0] / cells
    reference = [reference_force(radius, depth) for depth in depths]
    measured = held_forces(scene, depths)
    exponents = [float(np.polyfit(np.log(depths), np.log(force), 1)[0]) for force in (measured, reference)]
    shares = [f"{cell / np.sqrt(radius * depth):.1f}" for depth in depths]
    name = f"ball on the phantom, cell {1e3 * cell:.1f} mm"
    yield compare(
        f"{name}, force", REFERENCE, expected=reference[-1], measured=measured[-1], tolerance=FORCE_TOLERANCE, unit="N",
        note=f"mean of {len(OFFSETS)} sites, {1e3 * depths[-1]:g} mm deep, ball of {1e3 * radius:g} mm, "
        f"cell / contact radius {shares[-1]}",
    )  # fmt: skip
    yield compare(
        f"{name}, exponent", "Hertz, F ~ d^1.5", expected=1.5, measured=exponents[0], tolerance=EXPONENT_TOLERANCE,
        absolute=True,
        note=f"over {1e3 * depths[0]:g} to {1e3 * depths[-1]:g} mm, cell / contact radius {shares[0]} to "
        f"{shares[-1]}; the reference elements give {exponents[1]:.2f}",
    )  # fmt: skip
    millimetres, labels = 1e3 * np.array(depths), ("depth [mm]", "force [N]", False)
    yield Curve("ball", f"cell {1e3 * cell:.1f} mm", millimetres, measured, *labels)
    # The reference of all cell sizes is drawn once.
    if cells == 12:
        yield Curve("ball", "reference", millimetres, reference, *labels)


def sites(
    cells: int, radius: float, depth: float, count: int, mean: float, deviation: float | None, spread: float | None
) -> Iterator[Row]:
    """Force at random sites of the homogeneous phantom: mean against elements, standard deviation, range."""
    touch = block(cells)
    places = np.random.default_rng(0).uniform(-REACH, REACH, (count, 2)) + 0.5 * np.array(SIZE[:2])
    force = np.array([touch.held(place, radius, depth) for place in places])
    share = SIZE[0] / cells / math.sqrt(radius * depth)
    name = f"touch, tip {1e3 * radius:g} mm pressed {1e3 * depth:g} mm, cell / contact radius {share:.2f}"
    note = f"{count} sites, pressed at {1e3 * PRESS_SPEED:g} mm/s and held {HOLD_COUNT * STEP:g} s, damped critically"
    yield compare(
        f"{name}, mean", REFERENCE, expected=reference_force(radius, depth), measured=force.mean(),
        tolerance=mean, unit="N", note=note,
    )  # fmt: skip
    for statistic, measured, tolerance in (("std", force.std(), deviation), ("max - min", np.ptp(force), spread)):
        if tolerance is not None:
            yield compare(
                f"{name}, {statistic}", "homogeneous tissue", expected=0.0, measured=measured / force.mean(),
                tolerance=tolerance, note=f"over the mean; {note}",
            )  # fmt: skip


def bias(cells: int, cases: tuple[tuple[float, float], ...]) -> Iterator[Row]:
    """Force that the mesh adds to presses of given tip radii and depths [m], against the estimate of the reports."""
    scene, touch, cell = phantom(cells), block(cells, friction=0.0), SIZE[0] / cells
    field, mesh = modulus_field(scene.material.youngs_modulus, None), layer_mesh(DISC, SIZE[2], FINE, NEAR)
    limit = PressedLayer(mesh, field, scene.material.poisson_ratio, law=spring_law())
    places = [0.5 * np.array(SIZE[:2]) + cell * np.array(offset) for offset in OFFSETS]
    for radius, depth in cases:
        force = float(np.mean([touch.held(place, radius, depth) for place in places]))
        reference = limit.forces(radius, (depth,), scene.contact.stiffness)[0]
        predicted = mesh_bias(cell, radius, depth)[0]
        yield compare(
            f"added by the mesh, cell {1e3 * cell:.3g} mm, tip {1e3 * radius:g} mm pressed {1e3 * depth:g} mm",
            "estimate of the reports for blocks, `mesh_bias`", expected=predicted, measured=force / reference - 1.0,
            tolerance=BIAS_TOLERANCE, absolute=True,
            note=f"of the force of the springs' own limit, by scikit-fem, {reference:.4g} N; {len(OFFSETS)} sites",
        )  # fmt: skip


def contrast(cells: int, hidden: Hidden) -> Iterator[Row]:
    """Force over a sphere over the force without it, at three places on the lattice, without friction."""
    radius, depth = 0.008, 0.004
    cell = SIZE[0] / cells
    anatomy = load_anatomy(phantom(cells))
    healthy, hard = [], []
    for shift in ((0.0, 0.0), (0.5, 0.5), (0.25, 0.5)):
        place = 0.5 * np.array(SIZE[:2]) + cell * np.array(shift)
        centre = [*place, SIZE[2] - hidden.cover - hidden.radius]
        lesion = anatomy.lesion_at(centre, hidden.radius, hidden.ratio, "lesion")
        healthy.append(block(cells, friction=0.0).held(place, radius, depth))
        hard.append(block(cells, lesions=(lesion,), friction=0.0).held(place, radius, depth))
    yield compare(
        f"touch, contrast, {hidden.name}, cell {1e3 * cell:.1f} mm", REFERENCE,
        expected=reference_force(radius, depth, hidden) / reference_force(radius, depth),
        measured=sum(hard) / sum(healthy), tolerance=CONTRAST_TOLERANCE,
        note="tip 8 mm pressed 4 mm, no friction",
    )  # fmt: skip


def elastic_liver() -> Scene:
    """Scene liver without relaxation, as stiff as a press feels it, in small substeps: the references are elastic."""
    scene = make_scene("liver")
    material = replace(scene.material, youngs_modulus=press_modulus(scene.material), relaxation=None)
    return replace(scene, material=material, timing=replace(scene.timing, substep_count=5, mass_scaling=False))


def linear_liver() -> Scene:
    """`elastic_liver` without stiffening: the reference is neo-Hookean."""
    scene = elastic_liver()
    return replace(scene, material=replace(scene.material, stiffening=None))


def liver_contrast() -> Iterator[Row]:
    """Contrast of a slab with the scene liver's tissue without stiffening, its capsule, cells and contact.

    Against a rigid tip: sphere of 20 mm under 5 mm, 6 times as stiff, tip 12 mm, pressed 3, 5 and 7 mm.
    """
    scene = linear_liver()
    assert scene.mesh.surface is not None
    cell = scene.mesh.surface.cell_size
    measured = _slab_forces(scene, cell, LIVER_SPHERE) / _slab_forces(scene, cell, None) - 1.0
    healthy, hard = (_liver_reference(hidden) for hidden in (None, LIVER_SPHERE))
    rigid = hard / healthy - 1.0
    for number, depth in enumerate(LIVER_DEPTHS):
        yield compare(
            f"contrast over 1 of the liver's tissue, {LIVER_SPHERE.name}, pressed {1e3 * depth:g} mm",
            REFERENCE, expected=rigid[number],
            measured=measured[number], tolerance=LIVER_TOLERANCE,
            note=f"slab of {SLAB_COUNT[0]} x {SLAB_COUNT[0]} x {SLAB_COUNT[1]} cells of {1e3 * cell:g} mm with "
            f"capsule, k_p {scene.contact.stiffness:g} N/m^3, mean of {len(OFFSETS)} sites",
        )  # fmt: skip


def _liver_reference(hidden: Hidden | None) -> FloatArray:
    """Forces of the liver's tip at LIVER_DEPTHS on a layer of 8 cm of its tissue with its capsule [N]."""
    scene = linear_liver()
    assert scene.capsule is not None and scene.capsule.thickness is not None
    membrane = scene.capsule.youngs_modulus * scene.capsule.thickness
    field, mesh = modulus_field(scene.material.youngs_modulus, hidden), layer_mesh(0.08, 0.08, 1e-3, (0.016, 0.012))
    body = PressedLayer(mesh, field, scene.material.poisson_ratio, membrane=membrane)
    return np.array(body.forces(scene.instrument.tip_radius, LIVER_DEPTHS))


def _slab_forces(scene: Scene, cell: float, hidden: Hidden | None) -> FloatArray:
    """Mean static forces of the scene's tip, without friction, at LIVER_DEPTHS on a slab of its tissue [N]."""
    across, down = SLAB_COUNT
    mesh = box_mesh((across * cell, across * cell, down * cell), (across, across, down))
    radius, top = scene.instrument.tip_radius, down * cell
    floor = nodes_at(mesh.points, 0.0)
    forces = np.zeros(len(LIVER_DEPTHS))
    for offset in OFFSETS:
        place = 0.5 * across * cell + cell * np.array(offset)
        lesions: tuple[Lesion, ...] = ()
        if hidden is not None:
            hard = replace(scene.material, youngs_modulus=hidden.ratio * scene.material.youngs_modulus)
            lesions = (Lesion((*place, top - hidden.cover - hidden.radius), hidden.radius, hard),)
        damping = Damping(SLAB_ALPHA)
        spec = OrganSpec(mesh, scene.material, scene.capsule, lesions=lesions, anchors=floor, damping=damping)
        model = compile_organ(spec)
        touch = BallOnOrgan.on(model, scene.contact.law._replace(friction=0.0))
        state, start = rest_state(model, shape_count=1), np.array([*place, top + radius])
        shapes, reached = round_shapes([[start, start]], radius), 0.0
        for number, depth in enumerate(LIVER_DEPTHS):
            touch.move(state, shapes, (0.0, 0.0, -PRESS_SPEED), round((depth - reached) / (PRESS_SPEED * STEP)))
            forces[number] += touch.move(state, shapes, (0.0, 0.0, 0.0), SLAB_HOLD)[-1, 2] / len(OFFSETS)
            reached = depth
    return forces


def deep_presses(target: float = 1.2) -> Iterator[Row]:
    """Contact of balls of 3, 5 and 8 mm on 5 mm cells, slow and at 1 m/s, to 1.5 times the hard limit or a fault."""
    touch = block(12, alpha=None)
    lost, faults, falls = [], [], []
    for radius, speed, (place, site) in product((0.003, 0.005, 0.008), (0.02, 1.0), PLACES.items()):
        force, fault = _deep(touch, site, radius, speed, target)
        name = f"{1e3 * radius:g} mm, {place}, {speed:g} m/s"
        touched = force[np.argmax(force > 0.0) :]
        if fault:
            faults.append(name)
        # Contact is lost without force or fault, or if the force fell by a fifth before the fault.
        if force[-1] < 0.8 * force.max() or not (fault or force[-1] >= target):
            lost.append(name)
        if speed < 0.1 and (np.diff(touched[9::10]) <= 0.0).any():
            falls.append(name)
    for event, names in (("lost without a fault", lost), ("whose force falls with depth", falls)):
        yield compare(
            f"touch, presses to {target:g} N {event}", "contact holds", expected=0.0, measured=len(names),
            tolerance=0.0,
            note=f"of {6 * len(PLACES)}; {', '.join(names) or 'none'}; a tet turned inside out, said so, "
            f"in {len(faults)}",
        )  # fmt: skip


def _deep(touch: BallOnOrgan, site: ArrayLike, radius: float, speed: float, target: float) -> tuple[FloatArray, bool]:
    """Force of each haptic step until the target, 25 mm or a fault; true for a fault."""
    state, shapes = rest_state(touch.model, shape_count=1), ball(site, radius)
    force: list[float] = []
    while not force or (force[-1] < target and len(force) * speed * STEP < 0.025):
        try:
            force.append(float(touch.move(state, shapes, (0.0, 0.0, -speed), 1)[0, 2]))
        except OrganDivergedError:
            return np.array(force), True
    return np.array(force), False
