"""Lumped masses: Table I of the paper, and the total mass."""

import numpy as np

from msdm_core.material.lumping import lump_mass, voronoi_fractions
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.row import Outcome, Row, compare

PAPER = "Sala 2011, Table I"
ONE = np.array([[0, 1, 2, 3]])
# Height over base edge of the cap that has the printed cells; its AR is 0.6108 and 0.2549, printed as 0.6 and 0.2.
PRINTED = ((0.40365, -50.74, 152.23, "AR printed 0.6, is 0.611"), (0.1542, -74.50, 223.48, "AR printed 0.2, is 0.255"))
# The cap with exactly that AR, and the closed form V_base / V = (1/3 + (h/a)^2)^2 / 2.
EXACT = ((0.394960, 0.6), (0.120087, 0.2))


def cap(height: float) -> FloatArray:
    """An equilateral triangle of edge 1 with its apex at a height above the centre, shape (4, 3)."""
    turn = 2.0 * np.pi * np.arange(3) / 3.0
    base = np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=1) / np.sqrt(3.0)
    return np.vstack([base, [0.0, 0.0, height]])


def cell_differences(height: float) -> tuple[float, float]:
    """Smallest and largest Voronoi cell of a cap against the barycentric quarter [%]."""
    share = voronoi_fractions(cap(height), ONE)[0]
    return 100.0 * (4.0 * float(share.min()) - 1.0), 100.0 * (4.0 * float(share.max()) - 1.0)


def table_one() -> Outcome:
    """The printed pairs at the tets that have them, and the closed form at the AR that the table names."""
    rows: list[Row] = []
    for height, low, high, note in PRINTED:
        for name, expected, measured in zip(("min", "max"), (low, high), cell_differences(height), strict=True):
            rows.append(
                compare(
                    f"Table I, h/a {height:g}, {name} cell",
                    PAPER,
                    expected=expected,
                    measured=measured,
                    tolerance=0.02,
                    unit="%",
                    absolute=True,
                    note=note,
                )
            )
    for height, ratio in EXACT:
        base = 0.5 * (1.0 / 3.0 + height**2) ** 2
        for name, share, measured in zip(("min", "max"), (base, 1 - 3 * base), cell_differences(height), strict=True):
            rows.append(
                compare(
                    f"cap of AR {ratio:g}, {name} cell",
                    "closed form (1/3 + (h/a)^2)^2 / 2",
                    expected=100.0 * (4.0 * share - 1.0),
                    measured=measured,
                    tolerance=1e-6,
                    unit="%",
                    absolute=True,
                )
            )
    regular = cell_differences(np.sqrt(2.0 / 3.0))
    rows.append(
        compare(
            "Table I, regular tet, max cell", PAPER, expected=0.0, measured=regular[1], tolerance=0.02, unit="%",
            absolute=True,
        )
    )  # fmt: skip
    return Outcome(tuple(rows))


def mass_sum() -> Outcome:
    """Sum of the node masses against density x volume of the block, on a mesh without symmetry."""
    size = np.array([0.02, 0.05, 0.10])
    lattice = box_mesh(size, (4, 10, 20))
    # This map keeps the faces of the block in place: the volume stays the same, every tet changes.
    inner = np.prod(np.sin(np.pi * lattice.points / size), axis=1)
    mesh = TetMesh(lattice.points + inner[:, None] * np.array([1e-3, -8e-4, 6e-4]), lattice.tets)
    expected = 1060.0 * float(size.prod())
    return Outcome(
        tuple(
            compare(
                f"mass sum, {scheme}",
                "density x volume",
                expected=expected,
                measured=float(lump_mass(mesh, 1060.0, scheme=scheme).sum()),
                tolerance=1e-12,
                unit="kg",
            )
            for scheme in ("barycentric", "voronoi")
        )
    )
