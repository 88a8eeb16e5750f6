"""Capsules: a membrane independent of the mesh, beside the paper's layer of tets, which grows with the cell.

The membrane's E_c h_c is measured on its springs alone as a sheet, with nodes free to move along the surface, and on an
organ: the capsule stiffens a pulled block.
"""

from collections.abc import Iterator

import numpy as np
from scipy.sparse import block_diag, csr_array

from msdm_core.material import Capsule, Material, boundary_layer, membrane_stiffness
from msdm_core.mesh import FloatArray, IntArray, TetMesh
from msdm_core.meshing import box_mesh, mesh_surface
from msdm_core.organ import OrganSpec, compile_organ
from surgsim_apps.validation.lattice import uniaxial_modulus
from surgsim_apps.validation.row import Curve, Result, Row, compare
from surgsim_apps.validation.statics import (
    DENSITY,
    assemble_stiffness,
    nodal_dofs,
    solve_displacement,
    spring_matrix,
    vector_areas,
)
from surgsim_env.scene import load_anatomy, make_scene

MODULUS, THICKNESS = 1.0e6, 2.0e-5  # [Pa], [m]: those of the scene `liver`
STIFFNESS = MODULUS * THICKNESS  # [N/m]
DIRECTIONS = 12  # in half a turn
PATCH_RINGS = 3  # of triangles around the one in the middle

# Twice the energy per area of a sheet E h of 2-D Poisson's ratio 1/3, over E h e^2: 2 / (1 - nu), 1 / (1 - nu^2).
TWICE_ENERGY: dict[str, float] = {"equibiaxial": 3.0, "along one direction": 9.0 / 8.0}
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


def faces() -> Iterator[Row]:
    """E_c h_c on a block's face, equibiaxial and along 12 directions, at three cell sizes."""
    for cells in CELLS:
        mesh = box_mesh((SIZE,) * 3, (cells,) * 3, top_nodes=False)
        top = (mesh.points[mesh.boundary_triangles, 2] > SIZE - 1e-9).all(axis=1)
        equibiaxial, directions = patch_stiffness(mesh, mesh.boundary_triangles[top])
        values = np.append(directions, equibiaxial)
        yield compare(
            f"membrane capsule on a block's face, cell {1e3 * SIZE / cells:.1f} mm", "E_c h_c", expected=STIFFNESS,
            measured=values[np.argmax(np.abs(values - STIFFNESS))], tolerance=FACE_TOLERANCE, unit="N/m",
            note="the worst of equibiaxial and 12 directions",
        )  # fmt: skip


def curved() -> Iterator[Row]:
    """E_c h_c on stuffed surfaces: a ball, an ellipsoid and the scene `liver`."""
    shapes = {"a ball of 40 mm": (0.04, 0.04, 0.04), "an ellipsoid of 60, 40, 30 mm": (0.06, 0.04, 0.03)}
    bodies = [
        (f"{name}, cell {1e3 * cell:g} mm", mesh_surface(*_ellipsoid(radii), cell_size=cell))
        for name, radii in shapes.items()
        for cell in (0.010, 0.005)
    ]
    for name, mesh in (*bodies, ("the scene `liver`", load_anatomy(make_scene("liver")).mesh)):
        yield compare(
            f"membrane capsule, inflated, {name}", "E_c h_c", expected=STIFFNESS, measured=inflated(mesh),
            tolerance=CURVED_TOLERANCE, unit="N/m", note=_spread(mesh),
        )  # fmt: skip


def _ellipsoid(radii: tuple[float, float, float]) -> tuple[FloatArray, IntArray]:
    from trimesh.creation import icosphere

    ball = icosphere(4)
    return np.asarray(ball.vertices) * np.array(radii), np.asarray(ball.faces, dtype=np.int32)


def _spread(mesh: TetMesh) -> str:
    """Stiffness of patches of a surface along one direction, over E_c h_c, as text."""
    area = np.linalg.norm(vector_areas(mesh.points, mesh.boundary_triangles), axis=1)
    chosen = np.random.default_rng(0).choice(len(area), PATCH_COUNT, replace=False, p=area / area.sum())
    patches = [patch_around(mesh.boundary_triangles, triangle) for triangle in chosen.tolist()]
    directions = np.concatenate([patch_stiffness(mesh, patch)[1] for patch in patches]) / STIFFNESS
    low, high = np.quantile(directions, (0.05, 0.95))
    return (
        f"12 directions in {PATCH_COUNT} patches of some 80 triangles: {directions.mean():.2f} E_c h_c on average, "
        f"{low:.2f} to {high:.2f} in nine of ten, {directions.min():.2f} to {directions.max():.2f} in all"
    )


def pulled() -> Iterator[Result]:
    """Membrane stiffness of each rule's capsule on a pulled block, at three cell sizes."""
    sizes = [SIZE / cells for cells in CELLS]
    meshes = [box_mesh((SIZE,) * 3, (cells,) * 3, top_nodes=False) for cells in CELLS]
    by_hand = [(STROMA - TISSUE) * size * SHARE_OF_LAYER / SHARE_OF_SHEET for size in sizes]
    for rule, capsule, law, expected, tolerance in (
        ("membrane", Capsule(MODULUS, THICKNESS), "E_c h_c", [STIFFNESS] * 3, ORGAN_TOLERANCE),
        ("the paper's layer", Capsule(STROMA), "formula (6) on two tets a square of the face, by hand", by_hand,
         LAYER_TOLERANCE),
    ):  # fmt: skip
        stiffness = [added_stiffness(mesh, capsule) for mesh in meshes]
        for size, reference, measured in zip(sizes, expected, stiffness, strict=True):
            yield compare(
                f"capsule of a pulled block, {rule}, cell {1e3 * size:.1f} mm", law, expected=reference,
                measured=measured, tolerance=tolerance, unit="N/m",
            )  # fmt: skip
        for label, values in ((f"capsule by {rule}", stiffness), (f"reference, {rule}", expected)):
            labels = ("cell [mm]", "membrane stiffness [N/m]", False)
            yield Curve("capsule", label, 1e3 * np.array(sizes), values, *labels)
    # The paper's layer consists of the tets with a face on the boundary: its thickness in cells.
    mesh, area = meshes[0], 6.0 * SIZE**2
    touching = np.isin(mesh.tets, mesh.boundary_nodes).any(axis=1)
    thickness = float(mesh.volumes[boundary_layer(mesh)].sum()) / area
    yield compare(
        "the paper's layer, thickness / cell", "two tets of a^3 / 12 a square of the face", expected=1.0 / 6.0,
        measured=thickness / sizes[0], tolerance=1e-9,
        note=f"tets with a face on the boundary; those with a node on it would be "
        f"{float(mesh.volumes[touching].sum()) / area / thickness:.1f} x as thick here, 4 x on an endless face",
    )  # fmt: skip


def added_stiffness(mesh: TetMesh, capsule: Capsule) -> float:
    """E h of a sheet that stiffens the pulled block as the capsule does [N/m]."""
    covered, bare = (
        uniaxial_modulus(mesh, assemble_stiffness(compile_organ(OrganSpec(mesh, Material(TISSUE, DENSITY), cover))))
        for cover in (capsule, None)
    )
    return (covered - bare) * SIZE**2 / (4.0 * SIZE) / SHARE_OF_SHEET


def inflated(mesh: TetMesh) -> float:
    """E_c h_c of a whole surface by the equibiaxial strain of u = e x [N/m].

    A sheet of uniform tension does not slide along the surface; springs may.
    """
    points = mesh.points
    nodes = mesh.boundary_nodes
    stiffness = membrane_stiffness(mesh, MODULUS, THICKNESS)
    springs = np.flatnonzero(stiffness > 0.0)
    matrix = spring_matrix(points, mesh.edges[springs], stiffness[springs])
    rows = nodal_dofs(nodes)
    vector_area = vector_areas(points, mesh.boundary_triangles)
    normal = np.zeros_like(points)
    np.add.at(normal, mesh.boundary_triangles.ravel(), np.repeat(vector_area, 3, axis=0))
    along = csr_array(block_diag(list(tangents(normal[nodes])), format="csr"))
    inner = csr_array(matrix[rows][:, rows])
    place = points[nodes].ravel()
    pull = -(along.T @ (inner @ place))
    slid = solve_displacement(csr_array(along.T @ inner @ along), np.zeros(0, dtype=np.int64), 0.0, pull)
    twice = float(place @ (inner @ place) - pull @ slid)
    return twice / (TWICE_ENERGY["equibiaxial"] * float(np.linalg.norm(vector_area, axis=1).sum()))


def patch_stiffness(mesh: TetMesh, triangles: IntArray) -> tuple[float, FloatArray]:
    """E_c h_c of a patch of boundary triangles (n, 3): equibiaxial, and along DIRECTIONS directions [N/m].

    The patch is laid flat, its rim strained; springs on the rim count by half.
    """
    vector_area = vector_areas(mesh.points, triangles)
    plane = tangents(vector_area.sum(axis=0)[None])[0]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    nodes, ends = np.unique(edges, return_inverse=True)
    ends = ends.reshape(-1, 2)
    step = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    along = step @ plane
    along /= np.linalg.norm(along, axis=1)[:, None]
    span = along * np.linalg.norm(step, axis=1)[:, None]
    stiffness = _springs_of(mesh, edges) * np.where(uses == 1, 0.5, 1.0)
    # Stretch of each spring per displacement in the plane; nodes inside the rim move.
    stretch = np.zeros((len(edges), len(nodes), 2))
    for side, sign in ((0, -1.0), (1, 1.0)):
        stretch[np.arange(len(edges)), ends[:, side]] += sign * along
    free = np.setdiff1d(np.arange(len(nodes)), ends[uses == 1])
    moved = stretch[:, free].reshape(len(edges), -1) * np.sqrt(stiffness)[:, None]
    turn = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    strains = [np.eye(2), *(np.outer(v, v) for v in np.stack([np.cos(turn), np.sin(turn)], axis=1))]
    # Stretches of the affine strain after the free nodes have relaxed (least squares).
    affine = np.stack([np.einsum("ei,ij,ej->e", along, strain, span) for strain in strains], axis=1)
    affine *= np.sqrt(stiffness)[:, None]
    relaxed = affine - moved @ np.linalg.lstsq(moved, affine, rcond=None)[0]
    twice = (relaxed**2).sum(axis=0) / float(np.linalg.norm(vector_area, axis=1).sum())
    return float(twice[0] / TWICE_ENERGY["equibiaxial"]), twice[1:] / TWICE_ENERGY["along one direction"]


def patch_around(triangles: IntArray, middle: int) -> IntArray:
    """Triangle and PATCH_RINGS rings of triangles around it (n, 3)."""
    chosen = triangles[[middle]]
    for _ in range(PATCH_RINGS):
        chosen = triangles[np.isin(triangles, chosen).any(axis=1)]
    return chosen


def tangents(normal: FloatArray) -> FloatArray:
    """Pairs of unit vectors across normals (n, 3), as columns (n, 3, 2)."""
    return np.linalg.svd(normal[:, None, :])[2][:, 1:].transpose(0, 2, 1)


def _springs_of(mesh: TetMesh, edges: IntArray) -> FloatArray:
    number = np.array([mesh.node_count, 1])
    place = np.searchsorted(mesh.edges.astype(np.int64) @ number, edges.astype(np.int64) @ number)
    return membrane_stiffness(mesh, MODULUS, THICKNESS)[place]
