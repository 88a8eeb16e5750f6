"""What an episode of retraction draws from a scene's ranges, and the organ, target and endoscope that follow."""

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray, IntArray, TetMesh
from msdm_core.regions import Capsule
from surgsim_env.anatomy import Anatomy
from surgsim_env.retraction import Range, Retraction, RetractionCamera
from surgsim_env.scenes import Endoscope

Vector = tuple[float, float, float]

# A drawn capsule is this thick [m]; what counts is its modulus times this.
CAPSULE_THICKNESS = 1e-4
# A target lies this far above its bed [m], so that the bed does not hide it.
TARGET_LIFT = 1e-4


@dataclass(frozen=True)
class RetractionDraw:
    """One episode's draw, SI units.

    Args:
        scale: factor on the whole lobe.
        youngs_modulus: of its tissue [Pa].
        capsule_stiffness: modulus times thickness of its capsule [N/m], 0 without one.
        held_share: which share of the anchored edge is held.
        target: centre of the disc on the bed [m].
        eye, looks_at: where the endoscope stands and looks [m].
        start: the tip's place [m].
    """

    scale: float
    youngs_modulus: float
    capsule_stiffness: float
    held_share: float
    target: Vector
    eye: Vector
    looks_at: Vector
    start: Vector

    def to_json(self) -> str:
        """All of it, exact (numbers are written in full)."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "RetractionDraw":
        """What `to_json` wrote."""
        table: dict[str, Any] = json.loads(text)
        vectors: dict[str, Any] = {name: tuple(value) for name, value in table.items() if isinstance(value, list)}
        return cls(**table | vectors)


def draw_retraction(table: Retraction, endoscope: Endoscope, rng: np.random.Generator) -> RetractionDraw:
    """Draw an episode from the ranges of a scene's table, around the scene's endoscope."""
    scale, modulus = float(rng.uniform(*table.scale)), float(rng.uniform(*table.youngs_modulus))
    capsule = float(rng.uniform(*table.capsule_stiffness)) if rng.uniform() < table.capsule_share else 0.0
    held = float(rng.uniform(*table.held_share))
    target = (_even(table.target_along, rng), _even(table.target_distance, rng), TARGET_LIFT)
    eye, looks_at = _moved(endoscope, table.camera, rng)
    start = rng.uniform(table.start_lower, table.start_upper)
    return RetractionDraw(scale, modulus, capsule, held, target, _vector(eye), _vector(looks_at), _vector(start))


def drawn_organ(anatomy: Anatomy, drawn: RetractionDraw) -> OrganModel:
    """The scene's lobe as an episode has it."""
    plain = anatomy.specification()
    mesh = anatomy.mesh
    capsule = plain.capsule
    if drawn.capsule_stiffness > 0.0:
        capsule = Capsule(drawn.capsule_stiffness / CAPSULE_THICKNESS, CAPSULE_THICKNESS)
    specification = replace(
        plain,
        mesh=TetMesh(mesh.points * drawn.scale, mesh.tets, mesh.region, mesh.region_names),
        materials=replace(anatomy.scene.material, youngs_modulus=drawn.youngs_modulus),
        capsule=capsule,
        anchors=held_nodes(mesh.points, anatomy.anchors, drawn.held_share),
    )
    return anatomy.compiled(specification)


def lifted_box(table: Retraction, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the box of what is lifted, of an organ whose nodes are at some places [m]: two of shape (3,)."""
    if table.flap is None:
        return points.min(axis=0), points.max(axis=0)
    return np.array(table.flap.lower), np.array(table.flap.upper)


def held_nodes(points: FloatArray, anchors: IntArray, share: float) -> IntArray:
    """Those of the anchored nodes that lie in the middle share of the edge, along x."""
    along = points[anchors, 0]
    middle, half = 0.5 * (along.min() + along.max()), 0.5 * np.ptp(along)
    # A node that lies on the border by rounding is held.
    return anchors[np.abs(along - middle) <= share * half * (1.0 + 1e-9)]


def _moved(endoscope: Endoscope, camera: RetractionCamera, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """An endoscope moved evenly within a ball, its view turned about an axis across it: where it stands and looks."""
    way = rng.normal(size=3)
    shift = way / np.linalg.norm(way) * camera.shift * rng.uniform() ** (1.0 / 3.0)
    view = np.subtract(endoscope.target, endoscope.position)
    across = np.cross(view, rng.normal(size=3))
    across /= np.linalg.norm(across)
    angle = math.radians(camera.turn_deg) * rng.uniform()
    # The axis lies across the view, so that turning it (Rodrigues) needs no third term.
    turned = view * math.cos(angle) + np.cross(across, view) * math.sin(angle)
    eye = np.asarray(endoscope.position) + shift
    return eye, eye + turned


def _even(bounds: Range, rng: np.random.Generator) -> float:
    return float(rng.uniform(*bounds))


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
