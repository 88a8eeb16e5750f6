"""Tissue under a pressed tip: force, strain, volume, pressure and lateral force against axisymmetric finite elements.

Two errors of a force stand in rows of their own: that of the springs' continuum against a neo-Hookean solid, and that
of the mesh against the springs' continuum. A block of the scene phantom, and a dome of the scene liver's tissue and
cells at random places on the lattice.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from msdm_core.kernels import ContactShapes, OrganState
from msdm_core.material import Damping, Lesion
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.meshing import mesh_surface
from msdm_core.organ import OrganSpec, compile_organ, element_strains, rest_state, round_shapes, tissue_load
from surgsim_apps.validation.finite_press import RIGID, Law, Press, PressedLayer, layer_mesh, neo_hookean, spring_law
from surgsim_apps.validation.punch import DISC, SIZE, Hidden, modulus_field
from surgsim_apps.validation.row import Row, bounded, compare
from surgsim_apps.validation.touch import (
    FINE,
    NEAR,
    OFFSETS,
    PRESS_SPEED,
    STEP,
    BallOnOrgan,
    ball,
    block,
    elastic_liver,
    phantom,
)
from surgsim_env.scene import Scene, hidden_share, make_scene

NEO_HOOKE = "scikit-fem, axisymmetric, neo-Hookean"
SPRINGS = "scikit-fem, axisymmetric, springs as a continuum"
BLOCK_CELLS = (12, 18)  # along 6 cm
BLOCK_DEPTHS, DOME_DEPTHS = (0.002, 0.003, 0.004), (0.003, 0.005, 0.007)
BLOCK_HOLD, DOME_HOLD = 150, 220  # haptic steps
# Dome: thickness on its axis, radius of its base and of curvature of its top [m]; turns of its lattice.
THICKNESS, BASE, CURVATURE = 0.06, 0.07, 0.1
TURNS = 3
DOME_ALPHA, DOME_FINE = 60.0, 1.25e-3  # [1/s], [m]
DOME_SPHERE = Hidden(8.0, 0.006, 0.024)
# Tolerances of a press: force over the reference and over the own limit, contrast, J, strain, pressure, volume lost.
FORCE, OWN_FORCE, CONTRAST, RATIO, STRAIN, PRESSURE, LOST = 0.08, 0.10, 0.04, 0.12, 0.25, 0.15, 0.20
# Dragging: distance in cells, speed [m/s], largest swing of the lateral force over the normal one.
DRAG_CELLS, DRAG_SPEED, DRAG_MOST = 2.0, 0.02, 0.03


@dataclass(frozen=True)
class Pressed:
    """Organ in equilibrium with a ball: force [N], averages at nodes as reported, smallest J of a tet, volume [m^3]."""

    force: float
    pressure: float
    strain: float
    volume_ratio: float
    volume_lost: float

    @classmethod
    def of(cls, touch: BallOnOrgan, state: OrganState, shapes: ContactShapes, force: float) -> "Pressed":
        """The organ as it is."""
        model = touch.model
        tets = slice(len(model.spring_nodes), len(model.spring_nodes) + len(model.tet_nodes))
        shrinkage = -element_strains(model, state.node_position)[tets]
        load = tissue_load(model, state, shapes, touch.law)
        lost = float((model.tet_rest_volume * shrinkage).sum())
        return cls(force, load.pressure, load.strain, 1.0 - float(shrinkage.max()), lost)


def pressed(touch: BallOnOrgan, shapes: ContactShapes, depths: tuple[float, ...], hold: int) -> list[Pressed]:
    """Presses of a ball in touch with an organ, straight down, held at each depth."""
    state, reached, presses = rest_state(touch.model, shape_count=1), 0.0, []
    for depth in depths:
        touch.move(state, shapes, (0.0, 0.0, -PRESS_SPEED), round((depth - reached) / (PRESS_SPEED * STEP)))
        force = touch.move(state, shapes, (0.0, 0.0, 0.0), hold)[-1, 2]
        presses.append(Pressed.of(touch, state, shapes, float(force)))
        reached = depth
    return presses


def _mean(presses: list[Pressed], name: str) -> float:
    return float(np.mean([getattr(press, name) for press in presses]))


def _states(name: str, presses: list[Pressed], reference: Press, source: str, note: str) -> Iterator[Row]:
    """Rows of strain, smallest J, pressure and volume lost."""
    for what, key, tolerance, unit, absolute in (
        ("smallest J of a tet", "volume_ratio", RATIO, "", True),
        ("largest strain", "strain", STRAIN, "", False),
        ("largest contact pressure", "pressure", PRESSURE, "Pa", False),
        ("volume lost", "volume_lost", LOST, "m^3", False),
    ):
        yield compare(
            f"{name}, {what}", source, expected=getattr(reference, key), measured=_mean(presses, key),
            tolerance=tolerance, unit=unit, absolute=absolute, note=note,
        )  # fmt: skip


# ---- block ---------------------------------------------------------------------------------------------------------


def block_presses() -> Iterator[Row]:
    """Presses of the scene phantom without a lesion, without friction, on two sizes of cells."""
    scene = phantom(12)
    radius, stiffness = scene.instrument.tip_radius, scene.contact.stiffness
    neo, own = (_block_reference(law, radius, stiffness) for law in (neo_hookean, spring_law()))
    for number, depth in enumerate(BLOCK_DEPTHS):
        yield compare(
            f"phantom pressed {1e3 * depth:g} mm, force of the springs' continuum", NEO_HOOKE,
            expected=neo[number].force, measured=own[number].force, tolerance=0.12, unit="N",
            note="the model's own limit, without a mesh",
        )  # fmt: skip
    for cells in BLOCK_CELLS:
        touch, cell = block(cells, friction=0.0), SIZE[0] / cells
        runs = [
            pressed(touch, ball(0.5 * np.array(SIZE[:2]) + cell * np.array(offset), radius), BLOCK_DEPTHS, BLOCK_HOLD)
            for offset in OFFSETS
        ]
        note = f"mean of {len(OFFSETS)} sites, k_p of the scene in both"
        for number, depth in enumerate(BLOCK_DEPTHS):
            name = f"phantom pressed {1e3 * depth:g} mm, cell {1e3 * cell:.1f} mm"
            presses = [run[number] for run in runs]
            for source, reference, tolerance in ((SPRINGS, own, OWN_FORCE), (NEO_HOOKE, neo, FORCE)):
                yield compare(
                    f"{name}, force over that of {'springs' if reference is own else 'neo-Hooke'}", source,
                    expected=reference[number].force, measured=_mean(presses, "force"), tolerance=tolerance,
                    unit="N", note=note,
                )  # fmt: skip
            yield from _states(name, presses, neo[number], NEO_HOOKE, note)


def _block_reference(law: Law, radius: float, stiffness: float) -> list[Press]:
    material, mesh = make_scene("phantom").material, layer_mesh(DISC, SIZE[2], FINE, NEAR)
    body = PressedLayer(mesh, modulus_field(material.youngs_modulus, None), material.poisson_ratio, law=law)
    return list(body.presses(radius, BLOCK_DEPTHS, stiffness))


def drags() -> Iterator[Row]:
    """Lateral force on a frictionless ball dragged along the lattice of the phantom at its press depth."""
    scene = phantom(12)
    radius, depth = scene.instrument.tip_radius, scene.palpation.press_depth
    touch, cell = block(12, friction=0.0), SIZE[0] / 12
    for aside in (0.0, 0.25, 0.5):
        start = 0.5 * np.array(SIZE[:2]) + cell * np.array((-0.5 * DRAG_CELLS, aside))
        state, shapes = rest_state(touch.model, shape_count=1), ball(start, radius)
        touch.move(state, shapes, (0.0, 0.0, -PRESS_SPEED), round(depth / (PRESS_SPEED * STEP)))
        touch.move(state, shapes, (0.0, 0.0, 0.0), BLOCK_HOLD)
        count = round(DRAG_CELLS * cell / (DRAG_SPEED * STEP))
        force = touch.move(state, shapes, (DRAG_SPEED, 0.0, 0.0), count)[count // 4 :]
        yield bounded(
            f"frictionless drag {1e3 * depth:g} mm deep, {aside:g} cells beside nodes", "a solid knows no lattice",
            measured=0.5 * np.ptp(force[:, 0] / force[:, 2]), most=DRAG_MOST,
            note=f"half of the swing of lateral over normal force along {DRAG_CELLS:g} cells of 5 mm",
        )  # fmt: skip


# ---- dome ----------------------------------------------------------------------------------------------------------


def dome_presses() -> Iterator[Row]:
    """Presses of a dome with the scene liver's tissue, capsule, cells and contact, healthy and over a hidden sphere."""
    scene = elastic_liver()
    assert scene.mesh.surface is not None
    note = f"{TURNS} random places on the lattice, cell {1e3 * scene.mesh.surface.cell_size:g} mm, k_p of the scene"
    forces, references = [], []
    for hidden in (None, DOME_SPHERE):
        runs = [_dome_run(scene, turn, hidden) for turn in range(TURNS)]
        reference = _dome_reference(scene, hidden, scene.contact.stiffness)
        forces.append([_mean([run[number] for run in runs], "force") for number in range(len(DOME_DEPTHS))])
        references.append([press.force for press in reference])
        for number, depth in enumerate(DOME_DEPTHS):
            name = f"dome of liver pressed {1e3 * depth:g} mm, {'healthy' if hidden is None else hidden.name}"
            presses = [run[number] for run in runs]
            yield compare(
                f"{name}, force", SPRINGS, expected=reference[number].force, measured=forces[-1][number],
                tolerance=FORCE, unit="N", note=note,
            )  # fmt: skip
            yield from _states(name, presses, reference[number], SPRINGS, note)
    contrast, expected = (np.divide(values[1], values[0]) for values in (forces, references))
    for number, depth in enumerate(DOME_DEPTHS):
        yield compare(
            f"dome of liver pressed {1e3 * depth:g} mm, contrast", SPRINGS, expected=expected[number],
            measured=contrast[number], tolerance=CONTRAST, note=note,
        )  # fmt: skip


def hidden_by_contact() -> Iterator[Row]:
    """Share of a contrast over 1 of the liver's stiffening tissue, hidden by the scene's contact."""
    scene = elastic_liver()
    contrast = []
    for stiffness in (RIGID, scene.contact.stiffness):
        healthy, hard = (_dome_reference(scene, hidden, stiffness) for hidden in (None, DOME_SPHERE))
        contrast.append(np.array([over.force / under.force for over, under in zip(hard, healthy, strict=True)]))
    force = np.array([press.force for press in hard])
    # n of F ~ d^n by differences of second order.
    slope = np.gradient(np.log(force), np.log(DOME_DEPTHS), edge_order=2) * force / DOME_DEPTHS
    for number, depth in enumerate(DOME_DEPTHS):
        formula = hidden_share(
            float(force[number]), float(slope[number]), scene.instrument.tip_radius, depth, scene.contact.stiffness
        )
        yield bounded(
            f"hidden by contact, dome of liver, {DOME_SPHERE.name}, pressed {1e3 * depth:g} mm",
            "scikit-fem, springs as a continuum, k_p of the scene or rigid",
            measured=1.0 - (contrast[1][number] - 1.0) / (contrast[0][number] - 1.0), most=0.05,
            note="share of the contrast over 1, on a rigid bed, where a lesion cannot give way; the formula of the "
            f"reports says {formula:.3f}",
        )  # fmt: skip


@lru_cache(maxsize=8)
def _dome_reference(scene: Scene, hidden: Hidden | None, stiffness: float) -> list[Press]:
    capsule, material = scene.capsule, scene.material
    assert capsule is not None and capsule.thickness is not None
    body = PressedLayer(
        layer_mesh(BASE, THICKNESS, DOME_FINE, (0.016, 0.016), curvature=CURVATURE),
        modulus_field(material.youngs_modulus, hidden), material.poisson_ratio, law=spring_law(material.stiffening),
        membrane=capsule.youngs_modulus * capsule.thickness,
    )  # fmt: skip
    return list(body.presses(scene.instrument.tip_radius, DOME_DEPTHS, stiffness))


def _dome_run(scene: Scene, turn: int, hidden: Hidden | None) -> list[Pressed]:
    mesh, material = _dome_mesh(scene, turn), scene.material
    lesions: tuple[Lesion, ...] = ()
    if hidden is not None:
        hard = replace(material, youngs_modulus=hidden.ratio * material.youngs_modulus)
        lesions = (Lesion((0.0, 0.0, THICKNESS - hidden.cover - hidden.radius), hidden.radius, hard),)
    floor = np.flatnonzero(np.abs(mesh.points[:, 2]) < 1e-6)
    spec = OrganSpec(mesh, material, scene.capsule, lesions=lesions, anchors=floor, damping=Damping(DOME_ALPHA))
    touch = BallOnOrgan.on(compile_organ(spec), scene.contact.law._replace(friction=0.0))
    # The scene's relative step: near the limit strained tissue chatters.
    touch = BallOnOrgan(touch.model, touch.law, max(touch.substep_count, scene.timing.substep_count))
    radius = scene.instrument.tip_radius
    start = np.array([0.0, 0.0, THICKNESS + radius])
    return pressed(touch, round_shapes([[start, start]], radius), DOME_DEPTHS, DOME_HOLD)


@lru_cache(maxsize=TURNS)
def _dome_mesh(scene: Scene, turn: int) -> TetMesh:
    """Dome filled like the scene's organ, on a lattice turned and shifted at random."""
    from scipy.spatial.transform import Rotation

    surface = scene.mesh.surface
    assert surface is not None and surface.coarse_cell_size is not None
    points, triangles = _dome_surface()
    random = np.random.default_rng(turn)
    rotation = Rotation.from_quat(random.normal(size=4)).as_matrix()
    shift = random.uniform(-0.5, 0.5, 3) * surface.coarse_cell_size
    top = points[triangles].mean(axis=1)[:, 2] > THICKNESS - CURVATURE + np.sqrt(CURVATURE**2 - BASE**2)
    mesh = mesh_surface(
        points @ rotation.T + shift, triangles, cell_size=surface.cell_size,
        coarse_cell_size=surface.coarse_cell_size, fine_triangles=top, fine_depth=surface.fine_depth,
    )  # fmt: skip
    return TetMesh((mesh.points - shift) @ rotation, mesh.tets)


def _dome_surface(around: int = 96) -> tuple[FloatArray, np.ndarray]:
    """Closed surface of the dome, its base in the plane z = 0: points [m] and triangles."""
    r = np.linspace(0.0, BASE, 40)
    z = THICKNESS - CURVATURE + np.sqrt(CURVATURE**2 - r**2)
    side, floor = np.linspace(z[-1], 0.0, 16)[1:], np.linspace(BASE, 0.0, 24)[1:-1]
    rings = np.column_stack([
        np.concatenate([r[1:], np.full(len(side), BASE), floor]), np.concatenate([z[1:], side, np.zeros(len(floor))])
    ])  # fmt: skip
    angle = 2.0 * np.pi * np.arange(around) / around
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.ones(around)])
    points = np.concatenate(
        [[(0.0, 0.0, THICKNESS)], *(circle * (radius, radius, height) for radius, height in rings), [(0.0, 0.0, 0.0)]]
    )
    here = np.arange(around)
    after, last = (here + 1) % around, len(points) - 1
    triangles = [np.column_stack([np.zeros_like(here), 1 + here, 1 + after])]
    for first in range(1, last - around, around):
        a, b, c, d = first + here, first + after, first + around + here, first + around + after
        triangles += [np.column_stack([a, c, d]), np.column_stack([a, d, b])]
    base = last - around
    triangles.append(np.column_stack([np.full(around, last), base + after, base + here]))
    return points, np.concatenate(triangles)
