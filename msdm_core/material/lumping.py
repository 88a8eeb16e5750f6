"""Mass lumping: node masses from the density and each corner's share of a tet."""

from typing import Literal, get_args
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import OrganError
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh

MassScheme = Literal["barycentric", "voronoi"]

# Tets in a batch: its pieces (up to nine per corner) take some tens of megabytes.
_BATCH = 8192


# Shares of the tets of a mesh, computed once.
_VORONOI: WeakKeyDictionary[TetMesh, FloatArray] = WeakKeyDictionary()


def lump_mass(mesh: TetMesh, density: ArrayLike, *, scheme: MassScheme) -> FloatArray:
    """Mass of each node [kg], shape (n_node,), from a density [kg/m^3], scalar or (n_tet,).

    "barycentric" gives each corner a quarter of its tet, m_i = 1/4 sum_t rho_t V_t (Sala et al. 2011, eq. 2);
    "voronoi" the part of the tet nearest to it, m_i = sum_t rho_t V(C(i, t)) (Sala et al. 2011, eq. 3 to 5).

    Raises:
        OrganError: an unknown scheme; lists the known.
    """
    if scheme not in get_args(MassScheme):
        raise OrganError(f"mass scheme {scheme!r} is unknown; known: {', '.join(get_args(MassScheme))}")
    tet_mass = np.asarray(density, dtype=np.float64) * mesh.volumes
    if scheme == "barycentric":
        shares = np.full((mesh.tet_count, 4), 0.25)
    else:
        if mesh not in _VORONOI:
            _VORONOI[mesh] = voronoi_fractions(mesh.points, mesh.tets)
        shares = _VORONOI[mesh]
    return np.bincount(mesh.tets.ravel(), (shares * tet_mass[:, None]).ravel(), mesh.node_count).astype(np.float64)


def voronoi_fractions(points: ArrayLike, tets: ArrayLike) -> FloatArray:
    """Share of each tet's volume nearest to each of its corners, shape (n_tet, 4), rows of sum 1.

    V(C(i, t)) / V(t), C(i, t) = {q in t: |q - p_i| < |q - p_j| for all j != i} (Sala et al. 2011, eq. 3 and 4),
    by exact clipping, so the circumcentre may lie outside. `points` [m], shape (n_node, 3); `tets` (n_tet, 4).
    """
    corners = np.asarray(points, dtype=np.float64)[np.asarray(tets)]
    batches = [_batch_fractions(corners[start : start + _BATCH]) for start in range(0, len(corners), _BATCH)]
    return np.concatenate(batches) if batches else np.empty((0, 4))


def _batch_fractions(corners: FloatArray) -> FloatArray:
    """Voronoi shares of tets with corners (n_tet, 4, 3) [m], shape (n_tet, 4)."""
    tet_count = len(corners)
    squared = np.sum(np.square(corners[:, :, None] - corners[:, None]), axis=3)
    shares = np.empty((tet_count, 4))
    for corner in range(4):
        others = [other for other in range(4) if other != corner]
        # |q - p_j|^2 - |q - p_i|^2 is linear in q: its values at the corners (n_tet, 4, 3) determine it, so pieces are
        # clipped in barycentric coordinates.
        values = squared[:, :, others] - squared[:, :, [corner]]
        owner, volume = np.arange(tet_count), np.ones(tet_count)
        for _ in others:
            owner, volume, values = _clipped(owner, volume, values)
        shares[:, corner] = np.bincount(owner, weights=volume, minlength=tet_count)
    return shares


def _clipped(owner: NDArray, volume: FloatArray, values: FloatArray) -> tuple[NDArray, FloatArray, FloatArray]:
    """Part of each piece with a positive first linear function, as pieces with the other functions.

    A piece is a tet: owner (n,), volume (n,) as a share of the owner, values of k functions at its corners (n, 4, k).
    """
    order = np.argsort(-values[:, :, 0], axis=1, kind="stable")
    values = np.take_along_axis(values, order[:, :, None], axis=1)
    positive = np.count_nonzero(values[:, :, 0] > 0, axis=1)
    kept = positive == 4
    pieces = [(owner[kept], volume[kept], values[kept, :, 1:])]
    for inside, split in ((1, _tip), (2, _wedge), (3, _frustum)):
        chosen = np.flatnonzero(positive == inside)
        if chosen.size:
            pieces += [
                (owner[chosen], volume[chosen] * share, corner_values[:, :, 1:])
                for share, corner_values in split(values[chosen])
            ]
    owners, volumes, functions = map(np.concatenate, zip(*pieces, strict=True))
    return owners, volumes, functions


Split = list[tuple[FloatArray, FloatArray]]


def _cut(values: FloatArray, inner: int, outer: int) -> tuple[FloatArray, FloatArray]:
    """Zero of the first function on an edge: its fraction from the inner corner (n,), and all values there (n, k)."""
    a, b = values[:, inner], values[:, outer]
    fraction = a[:, 0] / (a[:, 0] - b[:, 0])
    return fraction, a + fraction[:, None] * (b - a)


def _tip(values: FloatArray) -> Split:
    """Corner 0 is inside: a small tet at that corner."""
    (s, on_1), (t, on_2), (u, on_3) = (_cut(values, 0, outer) for outer in (1, 2, 3))
    return [(s * t * u, np.stack([values[:, 0], on_1, on_2, on_3], axis=1))]


def _wedge(values: FloatArray) -> Split:
    """Corners a, b = 0, 1 are inside: a prism with ends (a, ac, ad) and (b, bc, bd), cut into three tets."""
    a, b = values[:, 0], values[:, 1]
    (s, ac), (t, ad) = _cut(values, 0, 2), _cut(values, 0, 3)
    (u, bc), (w, bd) = _cut(values, 1, 2), _cut(values, 1, 3)
    return [
        (s * t, np.stack([a, ac, ad, b], axis=1)),
        ((1 - s) * t * u, np.stack([ac, ad, b, bc], axis=1)),
        ((1 - t) * u * w, np.stack([ad, b, bc, bd], axis=1)),
    ]


def _frustum(values: FloatArray) -> Split:
    """Corners a, b, c = 0, 1, 2 are inside: a prism with ends (a, b, c) and (ad, bd, cd), cut into three tets."""
    a, b, c = values[:, 0], values[:, 1], values[:, 2]
    (s, ad), (t, bd), (u, cd) = (_cut(values, inner, 3) for inner in (0, 1, 2))
    return [
        (s, np.stack([a, b, c, ad], axis=1)),
        ((1 - s) * t, np.stack([b, c, ad, bd], axis=1)),
        ((1 - s) * (1 - t) * u, np.stack([c, ad, bd, cd], axis=1)),
    ]
