"""A flat punch on a bonded layer: Hayes' solution, and how much a hidden sphere changes the force."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from msdm_core.material.regions import Lesion, Material
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.layer_fem import layer, punch_stiffness
from surgsim_env.validation.row import Curve, Outcome, Row, compare
from surgsim_env.validation.statics import (
    DENSITY,
    assemble_stiffness,
    linear_organ,
    nodal_dofs,
    solve_displacement,
    twice_energy,
)

MODULUS = 20e3  # [Pa]
SIZE = (0.06, 0.06, 0.03)  # [m]
DISC = 0.03385  # [m] radius of the disc with the block's area
RADIUS = 0.006  # [m] of the punch
# F = 2 E a d kappa / (1 - nu^2): kappa of Hayes 1972 at a / h = 0.2, from the integral equation (facts, section 4).
KAPPA = {0.25: 1.198, 0.45: 1.252}
FORCE_TOLERANCE = 0.25
CONTRAST_TOLERANCE = 0.15


@dataclass(frozen=True)
class Hidden:
    """A sphere under the punch: modulus ratio, cover [m] and radius [m]."""

    ratio: float
    cover: float
    radius: float

    @property
    def name(self) -> str:
        """The sphere in the names of rows."""
        return f"{self.ratio:g} x, cover {1e3 * self.cover:g} mm, radius {1e3 * self.radius:g} mm"


@lru_cache(maxsize=32)
def block_stiffness(cells: int, nu: float, hidden: Hidden | None = None) -> float:
    """Force per depth of the punch on the block with `cells` cells along 6 cm [N/m]."""
    return pressed(box_mesh(SIZE, (cells, cells, cells // 2)), nu, hidden)


def pressed(mesh: TetMesh, nu: float, hidden: Hidden | None = None) -> float:
    """The same of any mesh of the block."""
    lesions: tuple[Lesion, ...] = ()
    if hidden is not None:
        centre = (0.03, 0.03, SIZE[2] - hidden.cover - hidden.radius)
        lesions = (Lesion(centre, hidden.radius, Material(hidden.ratio * MODULUS, DENSITY, nu)),)
    stiffness = assemble_stiffness(linear_organ(mesh, MODULUS, nu, lesions=lesions))
    x, y, z = mesh.points.T
    under = np.flatnonzero((z > SIZE[2] - 1e-9) & (np.hypot(x - 0.03, y - 0.03) <= RADIUS + 1e-9))
    floor = nodal_dofs(np.flatnonzero(z < 1e-9))
    held = np.concatenate([floor, nodal_dofs(under, (2,))])
    value = np.repeat([0.0, -1.0], [len(floor), len(under)])
    return twice_energy(stiffness, solve_displacement(stiffness, held, value))


@lru_cache(maxsize=32)
def reference_stiffness(nu: float, hidden: Hidden | None = None) -> float:
    """The same by axisymmetric quadratic elements [N/m]."""

    def modulus(r: FloatArray, z: FloatArray) -> FloatArray:
        if hidden is None:
            return np.full_like(r, MODULUS)
        inside = r**2 + (z + hidden.cover + hidden.radius) ** 2 <= hidden.radius**2
        return np.where(inside, hidden.ratio * MODULUS, MODULUS)

    return punch_stiffness(layer(DISC, SIZE[2], modulus, nu), RADIUS)


def wide_reference(nu: float) -> float:
    """The punch on a disc so wide that its rim does not matter [N/m]."""
    return punch_stiffness(layer(5.0 * SIZE[2], SIZE[2], lambda r, _: np.full_like(r, MODULUS), nu), RADIUS)


def hayes(counts: tuple[int, ...]) -> Outcome:
    """Punch of 6 mm radius on 30 mm of tissue."""
    rows: list[Row] = []
    for nu, kappa in KAPPA.items():
        expected = 2.0 * MODULUS * RADIUS * kappa / (1.0 - nu**2)
        for count in counts:
            cell = SIZE[0] / count
            rows.append(
                compare(
                    f"flat punch, nu {nu:.2f}, cell {1e3 * cell:.1f} mm", "Hayes 1972, bonded layer", expected=expected,
                    measured=block_stiffness(count, nu), tolerance=FORCE_TOLERANCE, unit="N/m",
                    note=f"{RADIUS / cell:.1f} cells per punch radius",
                )
            )  # fmt: skip
    return Outcome(tuple(rows))


def reference_check() -> Outcome:
    """The reference elements of contrasts and ball, on a wide disc without inclusion, against Hayes."""
    return Outcome(
        tuple(
            compare(
                f"reference elements for the punch, nu {nu:.2f}", "Hayes 1972, bonded layer",
                expected=2.0 * MODULUS * RADIUS * kappa / (1.0 - nu**2), measured=wide_reference(nu),
                tolerance=0.02, unit="N/m", note="a check of the reference, not of the organ",
            )
            for nu, kappa in KAPPA.items()
        )
    )  # fmt: skip


def contrast(count: int, nu: float, hidden: tuple[Hidden, ...], curve: str = "") -> Outcome:
    """Force with the sphere over force without it, less 1; where cell <= radius / 2 and cell <= cover."""
    cell = SIZE[0] / count
    rows: list[Row] = []
    for one in hidden:
        assert cell <= one.radius / 2.0 + 1e-9 and cell <= one.cover + 1e-9
        rows.append(
            compare(
                f"contrast, {one.name}, nu {nu:.2f}, cell {1e3 * cell:.1f} mm", "scikit-fem, axisymmetric",
                expected=reference_stiffness(nu, one) / reference_stiffness(nu) - 1.0,
                measured=block_stiffness(count, nu, one) / block_stiffness(count, nu) - 1.0,
                tolerance=CONTRAST_TOLERANCE,
            )
        )  # fmt: skip
    if not curve:
        return Outcome(tuple(rows))
    x = tuple(1e3 * one.cover for one in hidden)
    lines = (("springs", [row.measured for row in rows]), ("reference", [row.expected for row in rows]))
    labels = (f"{{}}, nu {nu:.2f}", "cover [mm]", "contrast, k / k0 - 1")
    return Outcome(
        tuple(rows),
        tuple(Curve(curve, labels[0].format(name), x, tuple(y), *labels[1:], False) for name, y in lines),
    )


COVERS = tuple(Hidden(5.0, cover, 0.005) for cover in (0.0025, 0.004, 0.006, 0.010))
OTHERS = (Hidden(2.0, 0.004, 0.005), Hidden(10.0, 0.004, 0.005), Hidden(5.0, 0.004, 0.0075), Hidden(5.0, 0.006, 0.010))
COARSE = (Hidden(5.0, 0.004, 0.008), Hidden(5.0, 0.008, 0.010))
