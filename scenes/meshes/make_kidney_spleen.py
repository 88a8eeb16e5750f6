#!/usr/bin/env python3
"""Write ``kidney.ply`` and ``spleen.ply``: a kidney-like bean and a spleen-like cap of this project's own making.

Both are ellipsoids bent by squares of their coordinates: the bean's middle bulges to the front and its poles lie back
and towards the hilum; the cap's crown points to the front and its rim lies back.

Axes: x to the patient's left, y to the back, z to the head; an instrument palpates the front.  Coordinates are rounded
to one micrometre.

    python scenes/meshes/make_kidney_spleen.py [folder]
"""

import sys
from pathlib import Path

import numpy as np
from make_liver import Array, Faces, icosphere, write_ply

FREQUENCY = 14  # each icosahedron edge is cut in so many
# Half axes along x, y, z (mm): human kidneys are 110 x 60 x 40 mm, spleens 110 x 70 x 40 mm.
KIDNEY, SPLEEN = np.array([29.0, 21.0, 55.0]), np.array([37.0, 21.0, 56.0])
# Of the kidney's poles towards the hilum (+x) and the back, of the spleen's rim towards the back (mm).
KIDNEY_HILUM, KIDNEY_BACK, SPLEEN_BACK = 11.0, 6.0, 9.0


def make_kidney() -> tuple[Array, Faces]:
    """Vertices in metres and triangles."""
    ball, faces = icosphere(FREQUENCY)
    x, y, z = (ball * KIDNEY).T
    bend = (z / KIDNEY[2]) ** 2
    return _metres(np.column_stack([x + KIDNEY_HILUM * bend, y + KIDNEY_BACK * bend, z])), faces


def make_spleen() -> tuple[Array, Faces]:
    """Vertices in metres and triangles."""
    ball, faces = icosphere(FREQUENCY)
    x, y, z = (ball * SPLEEN).T
    bend = (x / SPLEEN[0]) ** 2 + (z / SPLEEN[2]) ** 2
    return _metres(np.column_stack([x, y + SPLEEN_BACK * bend, z])), faces


def _metres(vertices: Array) -> Array:
    """Vertices (mm) about the middle of their box, in metres."""
    rounded = np.round(vertices, 3)
    return (rounded - 0.5 * (rounded.min(axis=0) + rounded.max(axis=0))) * 1e-3


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for name, made in (("kidney", make_kidney()), ("spleen", make_spleen())):
        write_ply(folder / f"{name}.ply", *made, f"surgsim {name}, metres, from make_kidney_spleen.py")
