"""Eshelby's sphere: a stiff ball in a large body under uniform strain from afar is strained uniformly."""

import numpy as np

from msdm_core.kernels.structure_kernels import OrganModel
from msdm_core.material.regions import Lesion, Material
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_env.validation.lattice import affine_modulus
from surgsim_env.validation.row import Curve, Outcome, Row, compare
from surgsim_env.validation.statics import DENSITY, assemble_stiffness, linear_organ, nodal_dofs, solve_displacement

MODULUS = 5e3  # [Pa]
TOLERANCE = 0.05
SIZE = 0.12  # [m]
CENTRE = (0.5 * SIZE, 0.5 * SIZE, 0.5 * SIZE)
PLACE_COUNT = 12
PLACE_TOLERANCE = 0.02  # chosen: a lesion of contrast 0.2 or more stands out of this noise
REACH = 4.0  # half the body's edge over the sphere's radius


def closed_form(ratio: float, nu: float) -> tuple[float, float]:
    """Strain inside over strain from afar, deviatoric and volumetric (Eshelby 1957, equal Poisson ratios)."""
    deviatoric = 2.0 * (4.0 - 5.0 * nu) / (15.0 * (1.0 - nu))
    volumetric = (1.0 + nu) / (3.0 * (1.0 - nu))
    return 1.0 / (1.0 + deviatoric * (ratio - 1.0)), 1.0 / (1.0 + volumetric * (ratio - 1.0))


def strain_inside(model: OrganModel, displacement: FloatArray, radius: float) -> FloatArray:
    """Mean strain of the tets that lie wholly in a sphere of a radius [m], by volume (3, 3)."""
    corners = model.node_rest_position[model.tet_nodes]
    inside = (np.linalg.norm(corners - 0.5 * SIZE, axis=2) <= radius + 1e-9).all(axis=1)
    rest = corners[inside, 1:] - corners[inside, :1]
    moved = displacement[model.tet_nodes[inside]]
    gradient = np.linalg.solve(rest, moved[:, 1:] - moved[:, :1])
    mean = np.average(gradient, axis=0, weights=model.tet_rest_volume[inside])
    return 0.5 * (mean + mean.T)


def eshelby(ratios: tuple[float, ...], nu: float, cells: int = 32) -> Outcome:
    """Lesion strains for several modulus ratios, the body's boundary displaced affinely."""
    mesh = box_mesh((SIZE,) * 3, (cells,) * 3)
    radius = 0.5 * SIZE / REACH
    rows: list[Row] = []
    found: list[FloatArray] = []
    for ratio in ratios:
        material = Material(ratio * MODULUS, DENSITY, nu)
        model = linear_organ(mesh, MODULUS, nu, lesions=(Lesion(CENTRE, radius, material),))
        found.append(_strain_shares(model, np.asarray(mesh.boundary_nodes), radius))
        for name, expected, measured in zip(
            ("shear", "volume"), closed_form(ratio, nu), found[-1].tolist(), strict=True
        ):
            rows.append(
                compare(
                    f"sphere {ratio:g} x as stiff, nu {nu:.2f}, {name} strain inside, {cells}^3 cells", "Eshelby 1957",
                    expected=expected, measured=measured[0], tolerance=TOLERANCE,
                    note=f"all tets wholly inside; {measured[1]:.3f} in the inner half; body {REACH:g} x the sphere",
                )
            )  # fmt: skip
    curves = tuple(
        Curve(
            "lesion_strain", f"{kind}{name} strain", ratios, tuple(values), "modulus ratio",
            "strain inside / strain from afar", False,
        )
        for index, name in enumerate(("shear", "volume"))
        for kind, values in (
            ("", [float(pair[index, 0]) for pair in found]),
            ("Eshelby, ", [closed_form(ratio, nu)[index] for ratio in ratios]),
        )
    )  # fmt: skip
    return Outcome(tuple(rows), curves if len(ratios) > 2 else ())


def _strain_shares(model: OrganModel, boundary: IntArray, radius: float) -> FloatArray:
    """Shear and volume strain over those from afar, in the whole sphere and in the inner half of it (2, 2)."""
    stiffness = assemble_stiffness(model)
    shares: list[list[float]] = []
    for wanted in (np.array([[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.eye(3)):
        value = (model.node_rest_position[boundary] @ wanted).ravel()
        moved = solve_displacement(stiffness, nodal_dofs(boundary), value).reshape(-1, 3)
        strains = [strain_inside(model, moved, share * radius) for share in (1.0, 0.5)]
        shares.append([float((strain * wanted).sum() / (wanted * wanted).sum()) for strain in strains])
    return np.array(shares)


def anywhere() -> Outcome:
    """How much the stiffness that a lesion adds to a sheared block depends on its place within a cell."""
    size, cells = 0.5 * SIZE, 12
    mesh = box_mesh((size,) * 3, (cells,) * 3)
    stiff = Material(5.0 * MODULUS, DENSITY)
    shear = np.array([[0.0, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    plain = affine_modulus(mesh, assemble_stiffness(linear_organ(mesh, MODULUS)), shear)
    added: list[float] = []
    for offset in np.random.default_rng(0).uniform(-0.5, 0.5, (PLACE_COUNT, 3)) * size / cells:
        x, y, z = (0.5 * size + offset).tolist()
        lesion = Lesion((x, y, z), 2.0 * size / cells, stiff)
        model = linear_organ(mesh, MODULUS, lesions=(lesion,))
        added.append(affine_modulus(mesh, assemble_stiffness(model), shear) - plain)
    return Outcome(
        (
            compare(
                f"sphere 5 x as stiff anywhere in a cell of half its radius, range of {PLACE_COUNT} places over mean",
                "a solid knows no lattice", expected=0.0, measured=float(np.ptp(added) / np.mean(added)),
                tolerance=PLACE_TOLERANCE, absolute=True,
                note="shear modulus that it adds to a block of 6 x its radius",
            ),
        )
    )  # fmt: skip
