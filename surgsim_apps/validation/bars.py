"""Bars and a lobe of the lattice against closed forms and elements, with springs of formula (6) and fitted springs.

The 2 x 5 x 10 cm prism of the paper's test A is pulled, and twisted with its ends held. A 2 x 2 x 10 cm beam held at
one end bends under a force, swings, and vibrates along its length. The scene `lobe`, three cells thick, is loaded at
the corner of its free edge.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array

from msdm_core.kernels import OrganModel
from msdm_core.material import Damping, Material, spring_fit
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.meshing import box_mesh
from msdm_core.organ import OrganSpec, compile_organ
from surgsim_apps.validation.dynamics import fitted_oscillation, released
from surgsim_apps.validation.elements import cantilever, clamped_torsion, tet_compliance
from surgsim_apps.validation.row import Result, Row, compare, with_order
from surgsim_apps.validation.statics import (
    DENSITY,
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    nodes_at,
    pull_stiffness,
    solve_displacement,
    twice_energy,
    vector_areas,
)
from surgsim_env.scene import load_anatomy, make_scene

MODULUS = 20e3  # [Pa]
PRISM, BEAM = (0.02, 0.05, 0.10), (0.02, 0.02, 0.10)  # [m]
HEXAHEDRA = "scikit-fem, quadratic hexahedra"
# Cells along the thickness of 2 cm, their edges [m], and tolerances of formula (6) by facts, section 7.
CELLS = (2, 4, 6)
SIZES = [PRISM[0] / across for across in CELLS]
TENSION_TOLERANCE = (0.15, 0.07, 0.07)
# Section 7 gives +55 % and +31 %; at 3.3 mm nothing is given, so two thirds of the 31 % at 5 mm (errors are O(cell)).
TORSION_TOLERANCE = (0.55, 0.31, 0.31 * 2.0 / 3.0)
# Fitted springs; by cells along the thickness: 2 and 4 are the paper's resolution and half of it; at 6 that of (6).
RATIOS = (0.25, 0.40, 0.45)
FITTED_TENSION_TOLERANCE = {2: 0.02, 4: 0.02, 6: 0.07}
FITTED_TORSION_TOLERANCE = 0.20
# A graded prism has fine cells of 5 mm across the thickness in the upper half of its length, and below cells of 10 mm,
# with the tolerance of those.
GRADED_ACROSS = 4

# Of formula (6) by facts, section 7; fitted springs do better.
FREQUENCY_TOLERANCE = {"lloyd": (0.25, 0.12, 0.08), "fitted": (0.20, 0.08, 0.05)}
ROD_TOLERANCE = {"lloyd": 0.08, "fitted": 0.03}
SPRINGS = {"lloyd": "", "fitted": ", fitted springs"}
# Fitted springs on the lobe, along x, y, z, by facts on the same mesh; formula (6): 17, 17 and 27 %.
LOBE_TOLERANCE = (0.08, 0.08, 0.16)
LOBE_LOADED = 0.012  # [m] of its free edge, three cells
DECAY_TOLERANCE = 0.01
ALPHA = 4.0 * math.pi  # [1/s] ratio 0.1 at 10 Hz


def cell_name(across: int) -> str:
    """Name of the cell in rows, with `across` cells across the thickness."""
    return f"cell {1e3 * PRISM[0] / across:.1f} mm"


@lru_cache(maxsize=4)
def prism_mesh(across: int) -> TetMesh:
    """Prism with `across` cubic cells across its thickness."""
    return box_mesh(PRISM, np.array((2, 5, 10)) * across // 2, top_nodes=False)


@lru_cache(maxsize=4)
def prism(across: int, rule: str = "lloyd", nu: float = 0.25) -> tuple[TetMesh, csr_array]:
    """The prism's mesh and stiffness matrix."""
    mesh = prism_mesh(across)
    return mesh, assemble_stiffness(linear_organ(mesh, MODULUS, nu, stiffness_rule=rule))


def torsion_stiffness(mesh: TetMesh, stiffness: csr_array) -> float:
    """Torque per angle of a prism with ends held as rigid plates [N m/rad]."""
    low, high = (nodes_at(mesh.points, height) for height in (0.0, PRISM[2]))
    arm = mesh.points[high] - 0.5 * np.array(PRISM)
    turn = np.stack([-arm[:, 1], arm[:, 0], np.zeros(len(high))], axis=1)
    value = np.concatenate([np.zeros(3 * len(low)), turn.ravel()])
    held = nodal_dofs(np.concatenate([low, high]))
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


def tension() -> Iterator[Result]:
    """The bar's stiffness E A / L = 200 N/m, ends free to contract."""
    rows = [
        compare(
            f"bar in tension, {cell_name(across)}", "E A / L", expected=MODULUS * PRISM[0] * PRISM[1] / PRISM[2],
            measured=pull_stiffness(*prism(across)), tolerance=tolerance, unit="N/m",
        )
        for across, tolerance in zip(CELLS, TENSION_TOLERANCE, strict=True)
    ]  # fmt: skip
    yield from with_order("bar in tension", SIZES, rows)


def torsion() -> Iterator[Result]:
    """Clamped torsion against quadratic hexahedra."""
    expected = clamped_torsion(PRISM, (4, 8, 16), MODULUS, 0.25)
    rows = [
        compare(
            f"clamped torsion, {cell_name(across)}", HEXAHEDRA, expected=expected,
            measured=torsion_stiffness(*prism(across)), tolerance=tolerance, unit="N m/rad",
        )
        for across, tolerance in zip(CELLS, TORSION_TOLERANCE, strict=True)
    ]  # fmt: skip
    yield from with_order("clamped torsion", SIZES, rows)


def fitted_tension() -> Iterator[Row]:
    """E of the pulled prism with fitted springs at three Poisson's ratios."""
    for across, tolerance in FITTED_TENSION_TOLERANCE.items():
        report = spring_fit(prism_mesh(across)).report
        for nu in RATIOS:
            yield compare(
                f"bar in tension, {cell_name(across)}, nu {nu:.2f}, fitted springs", "E A / L",
                expected=MODULUS * PRISM[0] * PRISM[1] / PRISM[2],
                measured=pull_stiffness(*prism(across, "fitted", nu)), tolerance=tolerance, unit="N/m",
                note=f"{prism_mesh(across).node_count} nodes; node forces are {report.residual_after:.0%} "
                f"from the solid's, those of formula (6) {report.residual_before:.0%}",
            )  # fmt: skip


def fitted_torsion() -> Iterator[Row]:
    """Clamped torsion with fitted springs against quadratic hexahedra, formula (6) in the note."""
    for nu in RATIOS:
        expected = clamped_torsion(PRISM, (4, 8, 16), MODULUS, nu)
        for across in (2, 4):
            yield compare(
                f"clamped torsion, {cell_name(across)}, nu {nu:.2f}, fitted springs", HEXAHEDRA, expected=expected,
                measured=torsion_stiffness(*prism(across, "fitted", nu)), tolerance=FITTED_TORSION_TOLERANCE,
                unit="N m/rad",
                note=f"formula (6): {torsion_stiffness(*prism(across, nu=nu)) / expected - 1.0:+.1%}",
            )  # fmt: skip


def graded_prism() -> Iterator[Row]:
    """The prism with cells of 5 mm in its upper half and of 10 mm below: pulled, and twisted with its ends held."""
    counts = np.array((2, 5, 10)) * GRADED_ACROSS // 2
    mesh = box_mesh(PRISM, counts, coarsening=2, fine_depth=0.5 * PRISM[2], top_nodes=False)
    stiffness = assemble_stiffness(linear_organ(mesh, MODULUS))
    fine, coarse = prism(GRADED_ACROSS), prism(GRADED_ACROSS // 2)
    note = f"{mesh.node_count} nodes, {fine[0].node_count} with cells of 5 mm alone; halves of both sizes in series"
    in_series = 2.0 / (1.0 / pull_stiffness(*fine) + 1.0 / pull_stiffness(*coarse))
    yield compare(
        "graded prism in tension, cells 5 and 10 mm", "E A / L",
        expected=MODULUS * (PRISM[0] * PRISM[1]) / PRISM[2], measured=pull_stiffness(mesh, stiffness),
        tolerance=TENSION_TOLERANCE[0], unit="N/m", note=f"{note} would have {in_series:.1f}",
    )  # fmt: skip
    in_series = 2.0 / (1.0 / torsion_stiffness(*fine) + 1.0 / torsion_stiffness(*coarse))
    yield compare(
        "graded prism, clamped torsion, cells 5 and 10 mm", HEXAHEDRA,
        expected=clamped_torsion(PRISM, (4, 8, 16), MODULUS, 0.25), measured=torsion_stiffness(mesh, stiffness),
        tolerance=TORSION_TOLERANCE[0], unit="N m/rad", note=f"{note} would have {in_series:.4g}",
    )  # fmt: skip


def beam(across: int, alpha: float = 0.0, rule: str = "lloyd") -> tuple[TetMesh, OrganModel]:
    """Beam with `across` cells across, its root z = 0 held."""
    mesh = box_mesh(BEAM, np.array((2, 2, 10)) * across // 2, top_nodes=False)
    root, damping = nodes_at(mesh.points, 0.0), Damping(alpha=alpha)
    material = Material(MODULUS, DENSITY)
    return mesh, compile_organ(OrganSpec(mesh, material, anchors=root, damping=damping, stiffness_rule=rule))


def bent(mesh: TetMesh, model: OrganModel) -> tuple[FloatArray, float]:
    """Shape under a unit force along x spread over the end face (n_node, 3), and its deflection there [m/N]."""
    end = np.isclose(mesh.points, BEAM[2])[:, 2]
    triangles = mesh.boundary_triangles[end[mesh.boundary_triangles].all(axis=1)]
    area = np.linalg.norm(vector_areas(mesh.points, triangles), axis=1)
    share = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), mesh.node_count) / (BEAM[0] * BEAM[1])
    load = np.zeros((mesh.node_count, 3))
    load[:, 0] = share
    root = nodal_dofs(np.flatnonzero(model.node_inverse_mass == 0.0))
    shape = solve_displacement(assemble_stiffness(model), root, 0.0, load.ravel())
    return shape.reshape(-1, 3), float(load.ravel() @ shape)


def cantilever_case(rule: str = "lloyd") -> Iterator[Result]:
    """Deflection under a force at the end, and the first frequency, against quadratic hexahedra."""
    compliance, frequency = cantilever(BEAM, (3, 3, 12), MODULUS, 0.25, DENSITY)
    deflections: list[Row] = []
    frequencies: list[Row] = []
    for across, tolerance in zip(CELLS, FREQUENCY_TOLERANCE[rule], strict=True):
        mesh, model = beam(across, rule=rule)
        shape, measured = bent(mesh, model)
        name = f"{cell_name(across)}{SPRINGS[rule]}"
        deflection = compare(
            f"cantilever, deflection per newton, {name}", HEXAHEDRA, expected=compliance, measured=measured,
            # Stiffness goes with the square of the frequency.
            tolerance=1.0 - (1.0 + tolerance) ** -2, unit="m/N",
        )  # fmt: skip
        deflections.append(deflection)
        time, value = released(model, shape * (1e-4 / np.abs(shape).max()), 2.0 / frequency)
        row = compare(
            f"cantilever, first frequency, {name}", HEXAHEDRA, expected=frequency,
            measured=fitted_oscillation(time, value)[0], tolerance=tolerance, unit="Hz",
        )  # fmt: skip
        frequencies.append(row)
    yield from with_order(f"cantilever, deflection{SPRINGS[rule]}", SIZES, deflections)
    yield from with_order(f"cantilever, frequency{SPRINGS[rule]}", SIZES, frequencies)


def stretched(mesh: TetMesh) -> FloatArray:
    """First mode along the rod, 10 um at the end: u_z = U sin(pi z / 2 L), with its thinning by nu 1/4."""
    x, y, z = (mesh.points - 0.5 * np.array([BEAM[0], BEAM[1], 0.0])).T
    wave = 0.5 * np.pi / BEAM[2]
    strain = wave * np.cos(wave * z) * (z > 1e-9)
    return 1e-5 * np.stack([-0.25 * x * strain, -0.25 * y * strain, np.sin(wave * z)], axis=1)


def rod_case(rule: str = "lloyd") -> Iterator[Result]:
    """First frequency along the rod, sqrt(E / rho) / (4 L) = 10.86 Hz."""
    expected = math.sqrt(MODULUS / DENSITY) / (4.0 * BEAM[2])
    rows: list[Row] = []
    for across in CELLS:
        mesh, model = beam(across, rule=rule)
        measured, _ = fitted_oscillation(*released(model, stretched(mesh), 3.0 / expected))
        name, law = f"fixed-free rod, frequency, {cell_name(across)}{SPRINGS[rule]}", "sqrt(E / rho) / (4 L)"
        rows.append(compare(name, law, expected=expected, measured=measured, tolerance=ROD_TOLERANCE[rule], unit="Hz"))
    # The error of fitted springs has another sign and origin; it need not fall with the cell size.
    yield from with_order("rod, frequency", SIZES, rows) if rule == "lloyd" else rows


def damping_case() -> Iterator[Row]:
    """Amplitudes fall by exp(-alpha t / 2) in every mode."""
    mesh, model = beam(2, ALPHA)
    for name, shape, duration in (("along", stretched(mesh), 0.4), ("swinging", bent(mesh, model)[0], 1.5)):
        start = shape * (1e-5 / np.abs(shape).max())
        _, rate = fitted_oscillation(*released(model, start, duration, step_share=0.2))
        yield compare(
            f"damping rate of the rod, {name}", "alpha / 2", expected=0.5 * ALPHA, measured=rate,
            tolerance=DECAY_TOLERANCE, unit="1/s",
        )  # fmt: skip


def lobe_corner() -> Iterator[Row]:
    """Stiffness at the free corner of the scene lobe, held along one edge, formula (6) in the note."""
    anatomy = load_anatomy(make_scene("lobe"))
    mesh, material = anatomy.mesh, anatomy.scene.material
    middle, upper = mesh.points[mesh.boundary_triangles].mean(axis=1), mesh.points.max(axis=0)
    at_corner = (middle[:, 1] > upper[1] - 1e-9) & (middle[:, 0] > upper[0] - LOBE_LOADED)
    triangles = mesh.boundary_triangles[at_corner]
    expected = 1.0 / tet_compliance(mesh, triangles, material.youngs_modulus, material.poisson_ratio)
    area = np.linalg.norm(vector_areas(mesh.points, triangles), axis=1)
    share = np.bincount(triangles.ravel(), np.repeat(area / (3.0 * area.sum()), 3), mesh.node_count)
    measured = {}
    for rule in SPRINGS:
        organ = linear_organ(mesh, material.youngs_modulus, material.poisson_ratio, stiffness_rule=rule)
        stiffness, held = assemble_stiffness(organ), nodal_dofs(anatomy.anchors)
        forces = np.kron(share, np.eye(3))
        measured[rule] = [1.0 / (force @ solve_displacement(stiffness, held, 0.0, force)) for force in forces]
    for axis, name in enumerate("xyz"):
        yield compare(
            f"lobe, force per displacement of its free corner along {name}, fitted springs",
            "scikit-fem, quadratic tets on the same mesh", expected=expected[axis], measured=measured["fitted"][axis],
            tolerance=LOBE_TOLERANCE[axis], unit="N/m",
            note=f"force spread over {1e3 * LOBE_LOADED:g} mm of the free edge; "
            f"formula (6): {measured['lloyd'][axis] / expected[axis] - 1.0:+.1%}",
        )  # fmt: skip
