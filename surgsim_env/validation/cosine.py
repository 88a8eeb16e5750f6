"""A cosine pressure on a deep block: whether the volume term locks, which uniform strain cannot show."""

import numpy as np

from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.row import Curve, Outcome, Row, compare
from surgsim_env.validation.statics import assemble_stiffness, linear_organ, nodal_dofs, solve_displacement

MODULUS = 20e3  # [Pa]
CELL = 0.005  # [m]
RATIOS = (0.25, 0.40, 0.45, 0.49)
# No tolerance is given; a trial of nodal volumes lay within 3 % of nu = 1/4 (facts, section 8), so does this one.
TOLERANCE = 0.03


def cosine_stiffness(nu: float, half_wave: int) -> float:
    """Pressure over displacement of the cosine on the springs, over the closed form E k / (2 (1 - nu^2)).

    Half-space, plane strain: p cos(k x) gives u_z = 2 (1 - nu^2) p cos(k x) / (E k). Side faces slide, the floor two
    wavelengths down is held.
    """
    counts = np.array([2 * half_wave, 2 * half_wave, 4 * half_wave])
    size = counts * CELL
    mesh = box_mesh(size, counts)
    wave = np.pi / (half_wave * CELL)
    x, y, z = mesh.points.T
    triangles = mesh.boundary_triangles
    top = triangles[(z[triangles] > size[2] - 1e-9).all(axis=1)]
    corners = mesh.points[top]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    load = np.zeros(mesh.points.size)
    # Linear shape functions against the cosine, by three points at the middles of the sides.
    for start, end in ((0, 1), (1, 2), (2, 0)):
        pressure = np.cos(wave * 0.5 * (corners[:, start, 0] + corners[:, end, 0])) * area / 3.0
        for corner in (start, end):
            np.add.at(load, 3 * top[:, corner] + 2, -0.5 * pressure)
    sides = [np.flatnonzero((place < 1e-9) | (place > length - 1e-9)) for place, length in ((x, size[0]), (y, size[1]))]
    held = np.unique(
        np.concatenate([nodal_dofs(sides[0], (0,)), nodal_dofs(sides[1], (1,)), nodal_dofs(np.flatnonzero(z < 1e-9))])
    )
    stiffness = assemble_stiffness(linear_organ(mesh, MODULUS, nu))
    # f . u = p U A / 2 for a displacement U cos(k x).
    amplitude = 2.0 * float(load @ solve_displacement(stiffness, held, 0.0, load)) / (size[0] * size[1])
    return float(1.0 / (amplitude * MODULUS * wave / (2.0 * (1.0 - nu**2))))


def cosine_load(half_waves: tuple[int, ...]) -> Outcome:
    """How much stiffer than at nu = 1/4 the lattice is, each over its closed form; 1 where nothing locks."""
    rows: list[Row] = []
    curves: list[Curve] = []
    for half_wave in half_waves:
        found = [cosine_stiffness(nu, half_wave) for nu in RATIOS]
        rows += [
            compare(
                f"cosine load, half-wave of {half_wave} cells, nu {nu:.2f} against 0.25", "E k / (2 (1 - nu^2))",
                expected=1.0, measured=value / found[0], tolerance=TOLERANCE,
                note=f"stiffness / closed form {value:.3f}, at nu 0.25 {found[0]:.3f}",
            )
            for nu, value in zip(RATIOS[1:], found[1:], strict=True)
        ]  # fmt: skip
        curves.append(
            Curve(
                "locking", f"half-wave of {half_wave} cells", RATIOS, tuple(found), "Poisson's ratio",
                "stiffness / closed form", False,
            )
        )  # fmt: skip
    return Outcome(tuple(rows), tuple(curves))
