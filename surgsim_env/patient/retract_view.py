"""Where an endoscope sees what an edge hides: nothing of it at rest, all of it once the flap is out of the way."""

import numpy as np

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.retraction import Retraction
from surgsim_env.scenes import Endoscope, Vector
from surgsim_env.visibility import Disc, uncovered

# Places before the edge that are tried in turn: aside, out, up, from the middle of the edge [m].
PLACES = tuple((aside, 0.075, up) for up in (0.045, 0.035, 0.055, 0.070) for aside in (0.038, -0.038, 0.0))
# At rest and at most, and with the flap away and at least, this share of any target is seen.
HIDDEN_SHARE, SEEN_SHARE = 0.05, 0.95
LIFT = 1e-4


def find_endoscope(anatomy: Anatomy, edge: Vector, fov_deg: float) -> Endoscope | None:
    """The first of PLACES before an edge [m] (3,) from where targets are hidden, and seen without the flap."""
    table, triangles = anatomy.scene.retract, anatomy.mesh.boundary_triangles
    assert table is not None
    held = triangles[np.isin(triangles, anatomy.anchors).all(axis=1)]
    targets = _targets(table)
    middle = np.mean([target.centre for target in targets], axis=0)
    for shift in PLACES:
        eye = np.array(edge) + shift
        if all(
            _share(eye, target, anatomy.mesh.points, triangles) <= HIDDEN_SHARE
            and _share(eye, target, anatomy.mesh.points, held) >= SEEN_SHARE
            for target in targets
        ):
            return Endoscope(_vector(eye), _vector(middle), fov_deg)
    return None


def _targets(table: Retraction) -> list[Disc]:
    """The discs in the corners of a table's range."""
    up = np.array([0.0, 0.0, 1.0])
    return [
        Disc(np.array([x, y, LIFT]), up, table.target_radius) for x in table.target_along for y in table.target_distance
    ]


def _share(eye: FloatArray, target: Disc, points: FloatArray, triangles: IntArray) -> float:
    return float(uncovered(eye, target.points(), points, triangles).mean())


def _vector(values: FloatArray) -> Vector:
    x, y, z = (round(value, 6) for value in values.tolist())
    return x, y, z
