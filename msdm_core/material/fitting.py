"""Springs fitted to the mesh: factors on formula (6) for node forces of the network near those of the solid.

Formula (6) gives the edges of a tet a share of its volume alone; the network is then too stiff on the surface, at nodes
with half their tets (clamped torsion of the paper's prism: +58 %). Here each spring gets a factor s_e:

    minimise  sum over strains m and nodes i of |w_i (f_mi(s) - F_mi)|^2  +  sum over springs of p_e (s_e - 1)^2
    with      s_e >= 0.05,

with f_mi the force of the springs s_e k_e, k_e of formula (6), on node i in the affine strain m, and F_mi the force of
linear tets (finite elements of first order, nu = 1/4, lambda = mu = 2 E / 5) in the same field, both with the mesh's
moduli. The weights w_i = V_i^(-2/3) / E_i, of the mean volume and modulus of the tets around a node, balance coarse and
fine, soft and hard parts. The six strains are an orthonormal basis (|eps| = 1), so the sum is invariant to rotation.

On the surface, averages over neighbouring nodes are compared, and differences of single nodes count 0.003: linear tets
give a node with eight triangles twice the traction of a node with four, and springs fitted to that would vary as much
(stiffness of single surface nodes of a block +-43 %; 8 % with averages and with formula (6)).

In the affine strain a straight line of springs through a lattice has one tension, so a change at the surface continues
along the line through the body. Inside, formula (6) is right already: the pull p_e towards it is weak near the surface
and triples with each layer of nodes from the third on, so that the factors return to 1 over some five cells, with
little change of the residual.

No published source is known for this fit; `FitReport` has its quality.

The factors are those of the homogeneous organ: lesions change the formula's k_e, not s_e, so lesions may differ from
reset to reset. With an 8x lesion the stiffness of a whole block is within 0.6 % of that of a fit with the lesion in it;
a disc of 1.5 cells pressed onto the lesion within 1.5 %, single nodes above it within 14 %. The factors live as long as
the mesh object. They do not depend on its scale: f and F grow as the square of length, w_i falls as that. So all sizes
of a mesh (`TetMesh.scaled`) share them.
"""

import math
import warnings
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.csgraph import dijkstra

from msdm_core.arithmetic import cbrt, dot, log, matmul, norm, power
from msdm_core.errors import OrganError
from msdm_core.mesh.tet_mesh import TET_FACES, FloatArray, TetMesh, area_vectors

# Lower bound of the factors on formula (6): a spring near 0 would leave its nodes loose.
SMALLEST_FACTOR = 0.05
# p_e at the surface, over the mean diagonal of the normal equations, and its growth per layer of nodes, counted in
# springs from the surface.
PULL_TO_LLOYD = 2e-3
PULL_GROWTH = 3.0
WEAK_LAYERS = 2
LARGEST_PULL = 1.0
# Weight of the differences of single surface nodes' forces, relative to that of their averages.
SINGLE_NODE_SHARE = 3e-3
# Above this residual the network cannot represent the solid. Blocks of cubes cut as BCC or into five tets leave 0.02 to
# 0.11 (37000 nodes), BCC cells stretched by 1.5 to 1 0.177: tension within 5 % and torsion within 12 %. Surfaces filled
# by isosurface stuffing leave 0.07 to 0.23: fine ones (a 6 mm sphere) come nearer than formula (6), coarse curved ones
# do not (a 10 mm sphere, residual 0.11, comes out softer, 0.70 of the solid in shear, not 0.79): use "lloyd" there.
# Jittered Delaunay and 6-tet cubes leave 0.24 to 0.5, and torsion falls to 0.66 and less.
LARGEST_RESIDUAL = 0.18
# Largest imbalance |sum of k l n n n| over sum of k l of formula (6)'s springs n around a node surrounded by inner
# nodes. Lattices of one cell size have none. With an imbalance formula (6) is wrong inside too, and a fit leaves nodes
# loose: at the seams of graded lattices (0.19), E across them fell by 7 to 34 %.
LARGEST_IMBALANCE = 0.05

_H = math.sqrt(0.5)
# Orthonormal basis of the symmetric tensors: three stretches, three shears, shape (6, 3, 3).
UNIT_STRAINS = np.array(
    [
        [[1, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 1]],
        [[0, 0, 0], [0, 0, _H], [0, _H, 0]],
        [[0, 0, _H], [0, 0, 0], [_H, 0, 0]],
        [[0, _H, 0], [_H, 0, 0], [0, 0, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True)
class FitReport:
    """Quality of a fit of springs to a mesh.

    Fields:
        residual_before: |f - F| / |F| of formula (6), of the compared node forces, six unit strains.
        residual_after: the same of the fitted springs (of the attempt, with the fallback).
        fallback: True for formula (6) times one scalar per region, because the residual stayed large or the mesh is
            uneven inside.
        factor_smallest: smallest factor on formula (6).
        factor_largest: largest factor on formula (6).
    """

    residual_before: float
    residual_after: float
    fallback: bool
    factor_smallest: float
    factor_largest: float


@dataclass(frozen=True, eq=False)
class SpringFit:
    """Factors on formula (6), k_e = edge_factor_e sum over tets of tet_factor_t k_et, and the quality of the fit.

    Fields:
        edge_factor: of each spring, all 1 in the fallback                       (n_spring,)
        tet_factor: of each tet's share: its region's scalar in the fallback,
            else all 1                                                           (n_tet,)
        report: its quality.
    """

    edge_factor: FloatArray
    tet_factor: FloatArray
    report: FitReport


_FITS: WeakKeyDictionary[TetMesh, SpringFit] = WeakKeyDictionary()


def spring_fit(mesh: TetMesh) -> SpringFit:
    """Fit of a mesh's homogeneous organ at any scale, made on first use and kept as long as the mesh lives.

    Warns:
        UserWarning: the network cannot represent the solid on this mesh; names the residual and the scalars in use.
    """
    mesh = mesh if mesh.unscaled is None else mesh.unscaled
    fit = _FITS.get(mesh)
    if fit is None:
        fit = _FITS[mesh] = fit_springs(mesh)
    return fit


def fit_springs(mesh: TetMesh, youngs_modulus: ArrayLike = 1.0) -> SpringFit:
    """Fit factors to formula (6), or fall back to one scalar per region; not cached.

    Args:
        mesh: the organ's tets.
        youngs_modulus: E, only its distribution matters: a scalar or a value per tet, shape (n_tet,).

    Warns:
        UserWarning: the fallback is used; names the residual and the scalars.

    Raises:
        OrganError: the fit does not converge.
    """
    modulus = np.broadcast_to(np.asarray(youngs_modulus, dtype=np.float64), (mesh.tet_count,))
    modulus = modulus / modulus.mean()
    share = lloyd_share(mesh, modulus)
    matrix, target = _force_equations(mesh, share, modulus)
    spread = _surface_averages(mesh)
    matrix, target = csr_array(spread @ matrix), spread @ target
    factor = _fit_factors(matrix, target, _pull_to_lloyd(mesh))
    before = _relative(matrix @ np.ones_like(factor) - target, target)
    after = _relative(matrix @ factor - target, target)
    tet_factor = np.ones(mesh.tet_count)
    fallback = after > LARGEST_RESIDUAL or _inner_imbalance(mesh) > LARGEST_IMBALANCE
    if fallback:
        factor, tet_factor = np.ones_like(factor), _region_scalars(mesh, share, modulus)
        _warn_of_fallback(after, tet_factor)
    factors = tet_factor if fallback else factor
    report = FitReport(before, after, fallback, float(factors.min()), float(factors.max()))
    factor.setflags(write=False)
    tet_factor.setflags(write=False)
    return SpringFit(factor, tet_factor, report)


def _fit_factors(matrix: csr_array, target: FloatArray, pull: FloatArray) -> FloatArray:
    """Factors of the springs, from the normal equations of |A s - b|^2 + sum p_e (s_e - 1)^2, s_e bounded below."""
    normal = csr_array(matrix.T @ matrix)
    weight = pull * float(normal.diagonal().mean())
    normal = csr_array(normal + diags_array(weight))
    return minimise_bounded(normal, matrix.T @ target + weight, np.ones(len(pull)), SMALLEST_FACTOR)


def _relative(part: FloatArray, whole: FloatArray) -> float:
    return float(np.sqrt(dot(part, part) / dot(whole, whole)))


def _pull_to_lloyd(mesh: TetMesh) -> FloatArray:
    """p_e over the mean diagonal of the normal equations, by the layer of a spring's outer node, shape (n_spring,)."""
    edges = mesh.edges
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(mesh.node_count,) * 2).tocsr()
    layer = dijkstra(graph, directed=False, indices=mesh.boundary_nodes, unweighted=True, min_only=True)
    beyond = np.maximum(layer[edges].min(axis=1) + 1 - WEAK_LAYERS, 0.0)
    exponent = np.minimum(beyond, log(LARGEST_PULL / PULL_TO_LLOYD) / log(PULL_GROWTH))
    return PULL_TO_LLOYD * power(PULL_GROWTH, exponent)


def _inner_imbalance(mesh: TetMesh) -> float:
    """Largest |sum of k l n n n| / sum of k l of formula (6)'s springs around nodes surrounded by inner nodes."""
    inside = np.ones(mesh.node_count, dtype=bool)
    inside[mesh.tets[np.isin(mesh.tets, mesh.boundary_nodes).any(axis=1)]] = False
    ends = mesh.edges.astype(np.int64)
    span = mesh.points[ends[:, 1]] - mesh.points[ends[:, 0]]
    length = norm(span, axis=1)
    along = span / length[:, None]
    share = lloyd_share(mesh, np.ones(mesh.tet_count))
    tension = np.bincount(mesh.tet_edges.ravel(), np.repeat(share, 6), len(ends)) * length
    cubes = along[:, :, None, None] * along[:, None, :, None] * along[:, None, None, :]
    moment = (cubes * tension[:, None, None, None]).reshape(-1, 27)
    # A spring has opposite directions at its two ends.
    signs = csr_array((np.tile([1.0, -1.0], len(ends)), (ends.ravel(), np.repeat(np.arange(len(ends)), 2))))
    imbalance = norm(signs @ moment, axis=1) / (abs(signs) @ tension)
    return float(imbalance[inside].max(initial=0.0))


def _warn_of_fallback(residual: float, tet_factor: FloatArray) -> None:
    scalars = ", ".join(f"{scalar:.3f}" for scalar in np.unique(tet_factor))
    reason = (
        f"springs fitted to this mesh leave a residual of {residual:.2f} of the solid's node forces, more than "
        f"{LARGEST_RESIDUAL:g}"
        if residual > LARGEST_RESIDUAL
        else "this mesh has cells of several sizes inside, and springs fitted to it leave nodes loose where they meet"
    )
    warnings.warn(
        f"{reason}: the network cannot represent the solid there. Formula (6) times one scalar per region "
        f"({scalars}) is used instead; blocks of cubic cells (box_mesh) can be fitted",
        UserWarning,
        stacklevel=4,
    )


def _region_scalars(mesh: TetMesh, share: FloatArray, modulus: FloatArray) -> FloatArray:
    """Scalar of each tet's region for the right mean affine stiffness, shape (n_tet,).

    C_iijj = (1 / V) sum k l^2 = 6 E for lambda = mu = 2 E / 5, so the scalar is 6 sum E_t V_t / sum k_et l_e^2.
    """
    spans = mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]]
    squares = dot(spans, spans)[mesh.tet_edges].sum(axis=1)
    tags, region = np.unique(mesh.region, return_inverse=True)
    solid = 6.0 * np.bincount(region, modulus * mesh.volumes, len(tags))
    return (solid / np.bincount(region, share * squares, len(tags)))[region]


# ---- node forces of the six unit strains ------------------------------------------------------------------------


def _force_equations(mesh: TetMesh, share: FloatArray, modulus: FloatArray) -> tuple[csr_array, FloatArray]:
    """Weighted node forces of the springs per factor, (18 n_node, n_spring), and of the solid, (18 n_node,).

    Row 18 i + 3 m + a is component a of node i's force in strain m. A spring with span d adds k (d . eps d) / |d|^2 d
    to the force of its second node, and minus that to the first.
    """
    edges, node_count = mesh.edges.astype(np.int64), mesh.node_count
    stiffness = np.bincount(mesh.tet_edges.ravel(), np.repeat(share, 6), len(edges))
    weight = _node_weights(mesh, modulus)
    spans = mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]]
    strained = matmul(UNIT_STRAINS, spans[:, None, :, None])[..., 0]
    stretch = dot(strained, spans[:, None]) / dot(spans, spans)[:, None]
    tension = ((stiffness[:, None] * stretch)[:, :, None] * spans[:, None, :]).reshape(-1, 18)
    values = np.concatenate([-weight[edges[:, 0], None] * tension, weight[edges[:, 1], None] * tension])
    rows = 18 * np.concatenate([edges[:, 0], edges[:, 1]])[:, None] + np.arange(18)
    columns = np.repeat(np.tile(np.arange(len(edges)), 2), 18)
    present = values.ravel() != 0.0
    entries = (values.ravel()[present], (rows.ravel()[present], columns[present]))
    matrix = csr_array(entries, shape=(18 * node_count, len(edges)))
    return matrix, (weight[:, None] * _solid_forces(mesh, modulus)).ravel()


def _surface_averages(mesh: TetMesh) -> csr_array:
    """Map from node forces to the compared forces: averages on the surface, then single nodes, (36 n, 18 n).

    A surface node's force is divided among its triangles by area, and each triangle gives a third to each corner, so
    that nodes with eight and with four triangles, alternating on outer faces, compare alike.
    """
    triangles, node_count = mesh.boundary_triangles, mesh.node_count
    area = norm(area_vectors(mesh.points[triangles]), axis=1)
    around = np.bincount(triangles.ravel(), np.repeat(area, 3), node_count)
    owner = np.repeat(np.arange(len(triangles)), 3)
    places, shape = (owner, triangles.ravel()), (len(triangles), node_count)
    shared = csr_array((np.repeat(area, 3) / around[triangles.ravel()], places), shape=shape)
    handed = csr_array((np.full(owner.size, 1.0 / 3.0), places), shape=shape)
    single = np.ones(node_count)
    single[mesh.boundary_nodes] = np.sqrt(SINGLE_NODE_SHARE)
    return csr_array(kron(vstack([handed.T @ shared, diags_array(single)]), eye_array(18), format="csr"))


def _node_weights(mesh: TetMesh, modulus: FloatArray) -> FloatArray:
    """w_i = V_i^(-2/3) / E_i, V_i and E_i the mean volume and modulus of the tets around a node, shape (n_node,)."""
    corners = mesh.tets.ravel()
    count, volume, stiffness = (
        np.bincount(corners, np.repeat(values, 4), mesh.node_count)
        for values in (np.ones(mesh.tet_count), mesh.volumes, modulus)
    )
    return count / (stiffness * np.square(cbrt(volume / count)))


def _solid_forces(mesh: TetMesh, modulus: FloatArray) -> FloatArray:
    """Internal node forces of linear tets in the six strains, F = sum over tets of sigma V grad N, (n_node, 18).

    sigma = lambda tr(eps) 1 + 2 mu eps with lambda = mu = 2 E / 5; V grad N_a = -(area vector of the face opposite
    corner a) / 3, area vectors outward.
    """
    trace = np.trace(UNIT_STRAINS, axis1=1, axis2=2)
    stress = 0.4 * (trace[:, None, None] * np.eye(3) + 2.0 * UNIT_STRAINS)
    area = area_vectors(mesh.points[mesh.tets[:, TET_FACES]])
    force = matmul(area * (modulus / -3.0)[:, None, None], stress.reshape(18, 3).T).reshape(-1, 18)
    corners = mesh.tets.ravel()
    columns = [np.bincount(corners, column, mesh.node_count) for column in force.T]
    return np.column_stack(columns).astype(np.float64)


def lloyd_share(mesh: TetMesh, youngs_modulus: FloatArray) -> FloatArray:
    """Share of stiffness from a tet for each of its edges, (2 sqrt 2 / 25) l_t E_t [N/m], shape (n_tet,).

    l_t = (12 V_t / sqrt 2)^(1/3) is the edge of the regular tet of the same volume; E_t [Pa], shape (n_tet,).
    """
    length = cbrt(mesh.volumes * (12.0 / math.sqrt(2.0)))
    return (2.0 * math.sqrt(2.0) / 25.0) * length * youngs_modulus


ROUNDS = 60
TOLERANCE = 1e-6


def minimise_bounded(matrix: csr_array, right: FloatArray, start: FloatArray, lower: float) -> FloatArray:
    """Minimum over x >= lower of x . H x / 2 - c . x, for a symmetric positive definite H, shape (n,).

    Projected Newton (Bertsekas 1982): unknowns held at the bound by the gradient are set aside; the free ones take the
    Newton step, by conjugate gradients, projected onto the bound and halved until the sum falls enough. The end is
    |g_i| / H_ii <= TOLERANCE of all free unknowns.

    Args:
        matrix: H, (n, n).
        right: c, (n,).
        start: at least `lower`, (n,).
        lower: the bound.

    Raises:
        OrganError: no convergence; names the largest remaining step.
    """
    diagonal, x = np.asarray(matrix.diagonal(), dtype=np.float64), start
    remaining = np.inf
    for turn in range(ROUNDS):
        gradient = matrix @ x - right
        free = np.flatnonzero((x > lower) | (gradient < 0.0))
        remaining = float(np.abs(gradient[free] / diagonal[free]).max(initial=0.0))
        if remaining <= TOLERANCE:
            return x
        accuracy = 1e-3 if turn < 3 else 1e-6
        step = np.zeros_like(x)
        step[free] = _conjugate_gradients(matrix[free][:, free], -gradient[free], diagonal[free], accuracy)
        x = _descend(matrix, x, gradient, step, lower)
    raise OrganError(
        f"fitting springs to this mesh did not converge in {ROUNDS} rounds (largest remaining step {remaining:.2g}, "
        f'the rule is at most {TOLERANCE:g}): use stiffness_rule="lloyd", or remesh'
    )


def _descend(matrix: csr_array, x: FloatArray, gradient: FloatArray, step: FloatArray, lower: float) -> FloatArray:
    """Line search along a projected step; a change d changes the sum by g . d + d . H d / 2."""
    length = 1.0
    for _ in range(40):
        moved = np.maximum(x + length * step, lower)
        change = moved - x
        slope = dot(gradient, change)
        if slope + 0.5 * dot(change, matrix @ change) <= 1e-4 * slope:
            return moved
        length *= 0.5
    return x


def _conjugate_gradients(matrix: csr_array, right: FloatArray, diagonal: FloatArray, accuracy: float) -> FloatArray:
    """Solution of M x = b for a symmetric positive M, with Jacobi's preconditioner, to a relative accuracy."""
    solution, residual = np.zeros_like(right), right.copy()
    scaled = residual / diagonal
    direction = scaled.copy()
    energy = start = dot(residual, scaled)
    for _ in range(1000):
        if energy <= accuracy * accuracy * start:
            break
        image = matrix @ direction
        length = energy / dot(direction, image)
        solution += length * direction
        residual -= length * image
        scaled = residual / diagonal
        energy, before = dot(residual, scaled), energy
        direction = scaled + (energy / before) * direction
    return solution
