#!/usr/bin/env python3
"""Write ``liver.ply``: a whole human-sized liver of this project's own making.

The organ is an implicit body in millimetres: a dome (right and left lobe, two blended
superellipsoids) cut by a visceral sheet (an oblique, mildly concave height field with the
fossae of the lower side), the edge between them filleted.  Bisection along the rays of a
subdivided icosahedron finds the surface; its vertices then slide until the triangles are even.

Axes: x to the patient's left (right lobe at negative x), y to the back, z to the head;
origin at the centre of the bounding box.  An instrument palpates the anterior-superior
diaphragmatic face (outward normals towards -y and +z).  Coordinates are rounded to one
micrometre, so that last-bit differences between machines do not reach the file.

    python scenes/meshes/make_liver.py [output.ply]
"""

import sys
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array, Faces = NDArray[np.float64], NDArray[np.int32]
Vector = tuple[float, float, float]

FREQUENCY = 17  # each icosahedron edge is cut in so many: 10 f^2 + 2 vertices
CENTRE = np.array([-40.0, -8.0, 22.0])  # the surface is star-shaped about this point
EDGE_RADIUS = 12.0  # mm, fillet between the dome and the visceral sheet

RIGHT_LOBE = ((-36.0, 4.0, -22.0), (77.0, 75.0, 88.0), 2.2)  # centre, semi-axes (mm), exponent
LEFT_LOBE = ((30.0, -9.0, 10.0), (85.0, 53.0, 41.0), 2.1)
LOBE_BLEND = 40.0  # mm, width of the blend

# Bell-shaped dents in the visceral sheet: centre, half-widths (mm), turn about z (deg), depth (mm).
VISCERAL_DENTS = (
    ((-22.0, -48.0), (16.0, 34.0), -14.0, 9.0),  # gallbladder fossa, to the edge
    ((-2.0, 8.0), (24.0, 12.0), 10.0, 13.0),  # porta hepatis, across
    ((26.0, -28.0), (10.0, 34.0), 12.0, 6.0),  # fissure of the round ligament
    ((-70.0, 32.0), (30.0, 30.0), 0.0, 9.0),  # renal impression
    ((62.0, 0.0), (34.0, 26.0), 0.0, 5.0),  # gastric impression
)
# Bell-shaped dents in the dome: centre, half-widths, depth (mm).
DOME_DENTS = (
    ((-6.0, 72.0, 10.0), (14.0, 24.0, 70.0), 16.0),  # groove of the inferior vena cava
    ((38.0, -6.0, 60.0), (32.0, 34.0, 24.0), 3.0),  # cardiac impression
    ((20.0, -66.0, -20.0), (9.0, 20.0, 24.0), 4.0),  # notch at the falciform ligament
)


def lobe(p: Array, spec: tuple[Vector, Vector, float]) -> Array:
    """Distance-like value (mm) to a superellipsoid, negative inside."""
    centre, axes, power = spec
    scaled = np.abs((p - np.array(centre)) / np.array(axes))
    return (np.sum(scaled**power, axis=1) ** (1.0 / power) - 1.0) * min(axes)


def dome(p: Array) -> Array:
    """Diaphragmatic body: smooth union of both lobes, less its dents."""
    a, b = lobe(p, RIGHT_LOBE), lobe(p, LEFT_LOBE)
    blend = np.maximum(1.0 - np.abs(a - b) / LOBE_BLEND, 0.0)
    value = np.minimum(a, b) - LOBE_BLEND / 6.0 * blend**3
    for centre, axes, depth in DOME_DENTS:
        value = value + depth * np.exp(-np.sum(((p - np.array(centre)) / np.array(axes)) ** 2, axis=1))
    return value


def visceral(p: Array) -> Array:
    """Height (mm) of the visceral sheet over a point, negative inside the liver."""
    x, y = p[:, 0], p[:, 1]
    height = -24.0 + 0.43 * x + 0.38 * y
    height = height + 12.0 * np.exp(-(((x + 10.0) / 70.0) ** 2) - (y / 55.0) ** 2)
    for centre, axes, turn, depth in VISCERAL_DENTS:
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        dx, dy = x - centre[0], y - centre[1]
        u, w = (c * dx + s * dy) / axes[0], (c * dy - s * dx) / axes[1]
        height = height + depth * np.exp(-u * u - w * w)
    return height - p[:, 2]


def distance(field: Callable[[Array], Array], p: Array) -> tuple[Array, Array]:
    """First-order distance (mm) to the zero set of a field, and the unit gradient."""
    grad = np.stack([field(p + o) - field(p - o) for o in 0.05 * np.eye(3)], axis=1) / 0.1
    norm = np.maximum(np.linalg.norm(grad, axis=1), 0.2)
    return field(p) / norm, grad / norm[:, None]


def liver(p: Array) -> Array:
    """Distance-like value (mm), negative inside: dome and sheet with a filleted edge."""
    (d1, n1), (d2, n2) = distance(dome, p), distance(visceral, p)
    cosine = np.clip(np.sum(n1 * n2, axis=1), -0.95, 0.95)
    a, b = d1 + EDGE_RADIUS, d2 + EDGE_RADIUS  # heights along n1, n2 over the fillet's axis
    on_fillet = (a > b * cosine) & (b > a * cosine)
    radial = np.sqrt(np.maximum(a * a + b * b - 2.0 * a * b * cosine, 0.0) / (1.0 - cosine**2))
    return np.where(on_fillet, radial - EDGE_RADIUS, np.maximum(d1, d2))


def unit(v: Array) -> Array:
    """Rows scaled to length one."""
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def icosphere(frequency: int) -> tuple[Array, Faces]:
    """Unit icosahedron with each edge cut in ``frequency``; outward triangles."""
    g = (1.0 + 5.0**0.5) / 2.0
    base = np.array([v for s in (-1, 1) for t in (-g, g) for v in ((0, s, t), (s, t, 0), (t, 0, s))])
    sides = {(i, j) for i, j in combinations(range(12), 2) if np.linalg.norm(base[i] - base[j]) < 2.1}
    corner_trios = [t for t in combinations(range(12), 3) if sides.issuperset(combinations(t, 2))]
    index: dict[tuple[tuple[int, int], ...], int] = {}
    points: list[Array] = []

    def node(trio: tuple[int, int, int], weights: tuple[int, int, int]) -> int:
        """Number of the vertex with these integer weights on a corner trio."""
        key = tuple((c, w) for c, w in sorted(zip(trio, weights)) if w)
        if key not in index:
            points.append(sum(w * base[c] for c, w in key) / frequency)
        return index.setdefault(key, len(points) - 1)

    faces = []
    for trio in corner_trios:
        trio = trio if np.linalg.det(base[list(trio)]) > 0 else trio[::-1]
        for i in range(frequency):
            for j in range(frequency - i):
                k = frequency - i - j
                a, b, c = (node(trio, w) for w in ((k, i, j), (k - 1, i + 1, j), (k - 1, i, j + 1)))
                faces.append((a, b, c))
                if k > 1:
                    faces.append((b, node(trio, (k - 2, i + 1, j + 1)), c))
    return unit(np.array(points)), np.array(faces, dtype=np.int32)


def cast(rays: Array) -> Array:
    """Surface points along unit rays from CENTRE; asserts that it is star-shaped."""
    stations = np.arange(171.0)  # mm, past the farthest surface
    inside = np.stack([liver(CENTRE + t * rays) < 0.0 for t in stations])
    changes = np.sum(inside[1:] != inside[:-1], axis=0)
    assert inside[0].all() and (changes == 1).all(), "the liver is not star-shaped about CENTRE"
    high = np.sum(inside, axis=0).astype(float)
    low = high - 1.0
    for _ in range(40):
        mid = 0.5 * (low + high)
        within = liver(CENTRE + mid[:, None] * rays) < 0.0
        low, high = np.where(within, mid, low), np.where(within, high, mid)
    return CENTRE + low[:, None] * rays


def neighbour_mean(values: Array, edges: Faces, weights: Array) -> Array:
    """Weighted mean of the values of each vertex's neighbours."""
    total, mass = np.zeros_like(values), np.zeros((len(values), 1))
    for here, there in (edges.T, edges.T[::-1]):
        np.add.at(total, here, values[there] * weights[there, None])
        np.add.at(mass, here, weights[there, None])
    return total / mass


def normals_and_areas(v: Array, f: Faces) -> tuple[Array, Array]:
    """Unit vertex normals and the area of the triangles round each vertex."""
    cross = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    normal, area = np.zeros_like(v), np.zeros(len(v))
    for corner in f.T:
        np.add.at(normal, corner, cross)
        np.add.at(area, corner, 0.5 * np.linalg.norm(cross, axis=1))
    return unit(normal), area


def make_liver() -> tuple[Array, Faces]:
    """Vertices in metres (origin at the bounding-box centre) and triangles."""
    rays, f = icosphere(FREQUENCY)
    v = cast(rays)
    edges = np.unique(np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    for _ in range(300):  # slide towards large triangles, return to the surface
        n, area = normals_and_areas(v, f)
        move = neighbour_mean(v, edges, area) - v
        move = move - np.sum(move * n, axis=1, keepdims=True) * n
        v = v + 0.5 * move - 0.8 * liver(v + 0.5 * move)[:, None] * n
    for factor in (0.5, -0.52) * 3:  # Taubin: no shrinking
        v = v + factor * (neighbour_mean(v, edges, np.ones(len(v))) - v)
    a, b, c = (v - CENTRE)[f.T]  # each triangle faces away from CENTRE: no self-crossing
    assert (np.sum(a * np.cross(b, c), axis=1) > 0.0).all(), "the mesh is not star-shaped about CENTRE"
    v = np.round(v, 3)
    return (v - 0.5 * (v.min(axis=0) + v.max(axis=0))) * 1e-3, f


def write_ply(path: Path, v: Array, f: Faces, comment: str = "surgsim liver, metres, from make_liver.py") -> None:
    """Binary little-endian PLY: float32 metres, uchar-counted int32 triangles."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\n"
        f"element vertex {len(v)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.array([(3, face) for face in f], dtype=[("count", "u1"), ("index", "<i4", 3)])
    path.write_bytes(header.encode("ascii") + v.astype("<f4").tobytes() + rows.tobytes())


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("liver.ply")
    write_ply(target, *make_liver())
