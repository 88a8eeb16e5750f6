"""Flat punch on a bonded layer: Hayes' solution, and the contrast of a hidden sphere.

The layer consists of cells of one size, or is fine in its upper third and coarse below.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from msdm_core.material import Lesion, Material
from msdm_core.mesh import FloatArray, TetMesh
from msdm_core.meshing import box_mesh
from surgsim_apps.validation.elements import Elements, layer, punch_stiffness
from surgsim_apps.validation.row import Curve, Result, Row, compare
from surgsim_apps.validation.statics import (
    DENSITY,
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    nodes_at,
    solve_displacement,
    twice_energy,
)

MODULUS = 20e3  # [Pa]
SIZE = (0.06, 0.06, 0.03)  # [m]
DISC = 0.03385  # [m] radius of the disc with the block's area
RADIUS = 0.006  # [m] of the punch
# F / d = 2 E a kappa / (1 - nu^2): kappa of Hayes 1972 at a / h = 0.2, from the integral equation (facts, section 4).
HAYES = {nu: 2.0 * MODULUS * RADIUS * kappa / (1.0 - nu**2) for nu, kappa in ((0.25, 1.198), (0.45, 1.252))}  # [N/m]
FORCE_TOLERANCE = 0.25
CONTRAST_TOLERANCE = 0.15
# A graded layer: fine cells of 2.5 mm in the upper 10 mm of 30.
GRADED_CELLS, GRADED_DEPTH = 24, 0.010
GRADED_TOLERANCE = 0.05


@dataclass(frozen=True)
class Hidden:
    """Sphere under the punch: modulus ratio, cover [m] and radius [m]."""

    ratio: float
    cover: float
    radius: float

    @property
    def name(self) -> str:
        """Name of the sphere in rows."""
        return f"{self.ratio:g} x, cover {1e3 * self.cover:g} mm, radius {1e3 * self.radius:g} mm"


COVERS = tuple(Hidden(5.0, cover, 0.005) for cover in (0.0025, 0.004, 0.006, 0.010))
OTHERS = (Hidden(2.0, 0.004, 0.005), Hidden(10.0, 0.004, 0.005), Hidden(5.0, 0.004, 0.0075), Hidden(5.0, 0.006, 0.010))
COARSE = (Hidden(5.0, 0.004, 0.008), Hidden(5.0, 0.008, 0.010))


@lru_cache(maxsize=32)
def block_stiffness(cells: int, nu: float, hidden: Hidden | None = None) -> float:
    """Force per depth of the punch on the block with `cells` cells along 6 cm [N/m]."""
    return pressed(box_mesh(SIZE, (cells, cells, cells // 2)), nu, hidden)


def pressed(mesh: TetMesh, nu: float, hidden: Hidden | None = None) -> float:
    """Force per depth of the punch on a mesh of the block [N/m]."""
    lesions: tuple[Lesion, ...] = ()
    if hidden is not None:
        centre = (0.03, 0.03, SIZE[2] - hidden.cover - hidden.radius)
        lesions = (Lesion(centre, hidden.radius, Material(hidden.ratio * MODULUS, DENSITY, nu)),)
    stiffness = assemble_stiffness(linear_organ(mesh, MODULUS, nu, lesions=lesions))
    x, y, z = mesh.points.T
    under = np.flatnonzero((z > SIZE[2] - 1e-9) & (np.hypot(x - 0.03, y - 0.03) <= RADIUS + 1e-9))
    floor = nodal_dofs(nodes_at(mesh.points, 0.0))
    held = np.concatenate([floor, nodal_dofs(under, (2,))])
    value = np.repeat([0.0, -1.0], [len(floor), len(under)])
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


@lru_cache(maxsize=8)
def reference_layer(modulus: float, nu: float, hidden: Hidden | None = None, radius: float = DISC) -> Elements:
    """Layer in axisymmetric quadratic elements, homogeneous or over a sphere, as a disc of a radius [m]."""
    return layer(radius, SIZE[2], modulus_field(modulus, hidden), nu)


def modulus_field(modulus: float, hidden: Hidden | None) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Young's modulus [Pa] at places (r, z) of a layer below z = 0, homogeneous or over a sphere."""

    def field(r: FloatArray, z: FloatArray) -> FloatArray:
        if hidden is None:
            return np.full_like(r, modulus)
        inside = r**2 + (z + hidden.cover + hidden.radius) ** 2 <= hidden.radius**2
        return np.where(inside, hidden.ratio * modulus, modulus)

    return field


@lru_cache(maxsize=32)
def reference_stiffness(nu: float, hidden: Hidden | None = None) -> float:
    """Force per depth of the punch by axisymmetric elements [N/m]."""
    return punch_stiffness(reference_layer(MODULUS, nu, hidden), RADIUS)


def hayes(counts: tuple[int, ...]) -> Iterator[Row]:
    """Punch of 6 mm radius on 30 mm of tissue."""
    for nu, expected in HAYES.items():
        for count in counts:
            cell = SIZE[0] / count
            yield compare(
                f"flat punch, nu {nu:.2f}, cell {1e3 * cell:.1f} mm", "Hayes 1972, bonded layer", expected=expected,
                measured=block_stiffness(count, nu), tolerance=FORCE_TOLERANCE, unit="N/m",
                note=f"{RADIUS / cell:.1f} cells per punch radius",
            )  # fmt: skip


def reference_check() -> Iterator[Row]:
    """Reference elements of contrasts and ball against Hayes, on a wide disc without influence of its rim."""
    for nu, expected in HAYES.items():
        yield compare(
            f"reference elements for the punch, nu {nu:.2f}", "Hayes 1972, bonded layer", expected=expected,
            measured=punch_stiffness(reference_layer(MODULUS, nu, radius=5.0 * SIZE[2]), RADIUS), tolerance=0.02,
            unit="N/m", note="a check of the reference, not of the organ",
        )  # fmt: skip


def contrast(count: int, nu: float, hidden: tuple[Hidden, ...], curve: str = "") -> Iterator[Result]:
    """Force with the sphere over force without it, less 1; for cell <= radius / 2 and cell <= cover."""
    cell = SIZE[0] / count
    rows: list[Row] = []
    for sphere in hidden:
        assert cell <= sphere.radius / 2.0 + 1e-9 and cell <= sphere.cover + 1e-9
        row = compare(
            f"contrast, {sphere.name}, nu {nu:.2f}, cell {1e3 * cell:.1f} mm", "scikit-fem, axisymmetric",
            expected=reference_stiffness(nu, sphere) / reference_stiffness(nu) - 1.0,
            measured=block_stiffness(count, nu, sphere) / block_stiffness(count, nu) - 1.0,
            tolerance=CONTRAST_TOLERANCE,
        )  # fmt: skip
        rows.append(row)
    yield from rows
    if curve:
        covers, labels = [1e3 * sphere.cover for sphere in hidden], ("cover [mm]", "contrast, k / k0 - 1", False)
        yield Curve(curve, f"springs, nu {nu:.2f}", covers, [row.measured for row in rows], *labels)
        yield Curve(curve, f"reference, nu {nu:.2f}", covers, [row.expected for row in rows], *labels)


def graded_punch() -> Iterator[Row]:
    """Punch on a layer with a fine upper third: its force, and the contrast of a hidden sphere."""
    counts = (GRADED_CELLS, GRADED_CELLS, GRADED_CELLS // 2)
    mesh, hidden = box_mesh(SIZE, counts, coarsening=2, fine_depth=GRADED_DEPTH), Hidden(5.0, 0.004, 0.005)
    for nu, expected in HAYES.items():
        force, uniform = pressed(mesh, nu), block_stiffness(GRADED_CELLS, nu)
        name = f"nu {nu:.2f}, cells 2.5 and 5 mm"
        yield compare(
            f"flat punch on a graded layer, {name}", "Hayes 1972, bonded layer", expected=expected, measured=force,
            tolerance=FORCE_TOLERANCE, unit="N/m",
        )  # fmt: skip
        yield compare(
            f"flat punch, graded against uniform, {name}", "the same punch on cells of 2.5 mm alone", expected=uniform,
            measured=force, tolerance=GRADED_TOLERANCE, unit="N/m",
            note=f"{mesh.node_count} nodes; a comparison, not a check of either",
        )  # fmt: skip
        yield compare(
            f"contrast on a graded layer, {hidden.name}, {name}", "scikit-fem, axisymmetric",
            expected=reference_stiffness(nu, hidden) / reference_stiffness(nu) - 1.0,
            measured=pressed(mesh, nu, hidden) / force - 1.0, tolerance=CONTRAST_TOLERANCE,
        )  # fmt: skip
