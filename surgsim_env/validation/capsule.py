"""The capsule: a membrane that no mesh makes stiffer, beside the paper's layer of tets, which grows with the cell.

The membrane's E_c h_c is asked of its springs alone (`membrane`) and of an organ: a pulled block is stiffer by its
capsule, whichever rule makes it.
"""

import numpy as np

from msdm_core.material.regions import Capsule, Material, boundary_layer
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from msdm_core.meshing.lattice_meshing import box_mesh, mesh_surface
from msdm_core.organ.compile import OrganSpec, compile_organ
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.validation.lattice import uniaxial_modulus
from surgsim_env.validation.membrane import MODULUS, THICKNESS, inflated, patch_around, patch_stiffness, vector_areas
from surgsim_env.validation.row import Curve, Outcome, Row, compare
from surgsim_env.validation.statics import DENSITY, assemble_stiffness

STIFFNESS = MODULUS * THICKNESS  # [N/m]
SIZE = 0.06  # [m] of the block
CELLS = (6, 12, 18)
TISSUE, STROMA = 20e3, 60e3  # [Pa], the paper's
FACE_TOLERANCE = 0.01
CURVED_TOLERANCE = 0.10
ORGAN_TOLERANCE = 0.03  # as for the moduli of a thick block
LAYER_TOLERANCE = 0.05
PATCH_COUNT = 60
# A block pulled by e thins by nu e = e / 4. Twice the energy of a sheet E h on it, over E h e^2 and the block's four
# sides: (1 + nu^2 - 2 nu / 3) 9/8 of the sides, 3 nu^2 of each of the two ends, which are half as large together.
SHARE_OF_SHEET = (1.0 + 0.0625 - 0.5 / 3.0) * 9.0 / 8.0 + 0.5 * 3.0 * 0.0625
# The same of the paper's layer, over (E_c - E) a e^2: each square of a face has two tets of volume a^3 / 12, with
# springs k = c l E of formula (6) along two sides, one diagonal and three half diagonals of a cube; k (l n.e n)^2.
SPRING = 2.0**1.5 / 25.0 * 2.0 ** (-1.0 / 6.0)  # c l / a
SHARE_OF_LAYER = (
    2.0 * SPRING * ((1.0 + 1.0 / 16.0 + 9.0 / 32.0 + 1.0 / 16.0) + 0.5 * (1.0 / 8.0 + 1.0 / 8.0 + 1.0 / 16.0))
)


def faces() -> Outcome:
    """E_c h_c on a block's face, equibiaxial and along 12 directions, at three cell sizes."""
    rows: list[Row] = []
    for cells in CELLS:
        mesh = box_mesh((SIZE,) * 3, (cells,) * 3)
        top = (mesh.points[mesh.boundary_triangles, 2] > SIZE - 1e-9).all(axis=1)
        equibiaxial, directions = patch_stiffness(mesh, mesh.boundary_triangles[top])
        found = np.append(directions, equibiaxial)
        rows.append(
            compare(
                f"membrane capsule on a block's face, cell {1e3 * SIZE / cells:.1f} mm", "E_c h_c", expected=STIFFNESS,
                measured=float(found[np.argmax(np.abs(found - STIFFNESS))]), tolerance=FACE_TOLERANCE, unit="N/m",
                note="the worst of equibiaxial and 12 directions",
            )
        )  # fmt: skip
    return Outcome(tuple(rows))


def curved() -> Outcome:
    """E_c h_c on stuffed surfaces: a ball, an ellipsoid and the scene `liver`."""
    rows: list[Row] = []
    bodies = [
        (f"{name}, cell {1e3 * cell:g} mm", mesh_surface(*_ellipsoid(radii), cell_size=cell))
        for name, radii in (
            ("a ball of 40 mm", (0.04, 0.04, 0.04)),
            ("an ellipsoid of 60, 40, 30 mm", (0.06, 0.04, 0.03)),
        )
        for cell in (0.010, 0.005)
    ]
    for name, mesh in (*bodies, ("the scene `liver`", load_anatomy(make_scene("liver")).mesh)):
        rows.append(
            compare(
                f"membrane capsule, inflated, {name}", "E_c h_c", expected=STIFFNESS, measured=inflated(mesh),
                tolerance=CURVED_TOLERANCE, unit="N/m", note=_spread(mesh),
            )
        )  # fmt: skip
    return Outcome(tuple(rows))


def _ellipsoid(radii: tuple[float, float, float]) -> tuple[FloatArray, IntArray]:
    from trimesh.creation import icosphere

    ball = icosphere(4)
    return np.asarray(ball.vertices) * np.array(radii), np.asarray(ball.faces, dtype=np.int32)


def _spread(mesh: TetMesh) -> str:
    """Stiffness of patches of a surface along one direction, over E_c h_c, as text."""
    area = np.linalg.norm(vector_areas(mesh.points, mesh.boundary_triangles), axis=1)
    chosen = np.random.default_rng(0).choice(len(area), PATCH_COUNT, replace=False, p=area / area.sum())
    found = [patch_stiffness(mesh, patch_around(mesh.boundary_triangles, one)) for one in chosen.tolist()]
    directions = np.concatenate([one[1] for one in found]) / STIFFNESS
    low, high = np.quantile(directions, (0.05, 0.95))
    return (
        f"12 directions in {PATCH_COUNT} patches of some 80 triangles: {directions.mean():.2f} E_c h_c on average, "
        f"{low:.2f} to {high:.2f} in nine of ten, {directions.min():.2f} to {directions.max():.2f} in all"
    )


def pulled() -> Outcome:
    """Stiffness that each rule adds to a pulled block, as a membrane stiffness, at three cell sizes."""
    sizes = [SIZE / cells for cells in CELLS]
    meshes = [box_mesh((SIZE,) * 3, (cells,) * 3) for cells in CELLS]
    rows: list[Row] = []
    curves: list[Curve] = []
    for rule, capsule, law, expected, tolerance in (
        ("membrane", Capsule(MODULUS, THICKNESS), "E_c h_c", [STIFFNESS] * 3, ORGAN_TOLERANCE),
        (
            "the paper's layer", Capsule(STROMA), "formula (6) on two tets a square of the face, by hand",
            [(STROMA - TISSUE) * size * SHARE_OF_LAYER / SHARE_OF_SHEET for size in sizes], LAYER_TOLERANCE,
        ),
    ):  # fmt: skip
        found = [added_stiffness(mesh, capsule) for mesh in meshes]
        rows += [
            compare(
                f"capsule of a pulled block, {rule}, cell {1e3 * size:.1f} mm", law, expected=one, measured=measured,
                tolerance=tolerance, unit="N/m",
            )
            for size, one, measured in zip(sizes, expected, found, strict=True)
        ]  # fmt: skip
        for label, values in ((f"capsule by {rule}", found), (f"reference, {rule}", expected)):
            labels = ("cell [mm]", "membrane stiffness [N/m]", False)
            curves.append(Curve("capsule", label, tuple(1e3 * size for size in sizes), tuple(values), *labels))
    return Outcome((*rows, _layer_row(meshes[0], sizes[0])), tuple(curves))


def added_stiffness(mesh: TetMesh, capsule: Capsule) -> float:
    """The E h of the sheet that would stiffen the pulled block as much as the capsule does [N/m]."""
    with_it, without = (
        uniaxial_modulus(mesh, assemble_stiffness(compile_organ(OrganSpec(mesh, Material(TISSUE, DENSITY), one))), SIZE)
        for one in (capsule, None)
    )
    return (with_it - without) * SIZE**2 / (4.0 * SIZE) / SHARE_OF_SHEET


def _layer_row(mesh: TetMesh, cell: float) -> Row:
    """The paper's layer is the tets with a face on the boundary: its thickness in cells."""
    area = 6.0 * SIZE**2
    touching = np.isin(mesh.tets, mesh.boundary_nodes).any(axis=1)
    thickness = float(mesh.volumes[boundary_layer(mesh)].sum()) / area
    return compare(
        "the paper's layer, thickness / cell", "two tets of a^3 / 12 a square of the face", expected=1.0 / 6.0,
        measured=thickness / cell, tolerance=1e-9,
        note=f"tets with a face on the boundary; those with a node on it would be "
        f"{float(mesh.volumes[touching].sum()) / area / thickness:.1f} x as thick here, 4 x on an endless face",
    )  # fmt: skip
