"""The retraction scene of a patient's organ, turned so that a thin edge of it can be lifted."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msdm_core.mesh.ordering import in_sweep_order
from msdm_core.mesh.tet_mesh import FloatArray, IntArray, TetMesh
from msdm_core.organ.support import Support
from surgsim_env.patient.patient_scene import PatientScene, with_substeps
from surgsim_env.patient.rim import HIDING, NoRim, Rim, find_rim
from surgsim_env.scene.anatomy import Anatomy, anatomy_of
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import (
    Anchor,
    Box,
    Endoscope,
    Flap,
    MeshSource,
    PalpationSettings,
    Port,
    Retraction,
    Scene,
    TetFile,
    Vector,
)
from surgsim_env.tasks.visibility import Disc, uncovered

PATTERN = "lobe"
# Larger cells give no edge that fills a jaw evenly, and miss a bed of 24 mm [m].
CELL_MOST = 0.011
# In the scene lobe: y of the free edge and x of its middle [m].
LOBE_EDGE, LOBE_MIDDLE = 0.052, 0.040
# The part that is free to move: its extent inward from the edge, along it, below and above it [m]. The rest is held.
FLAP_DEPTH, FLAP_WIDTH, FLAP_BELOW, FLAP_ABOVE = 0.060, 0.140, 0.020, 0.080
FLAP_BEYOND = 0.015
# Height above the bed up to which the flap is observed and measured, as an edge in the jaw may reach it [m].
SEEN_HEIGHT = 0.025
# Distance of the bed's border inside the edge, clear of the jaw, and of its top below the organ above it [m].
BED_INSIDE, BED_GAP = 0.016, 0.002
BED_WIDTH, BED_THICKNESS = 0.030, 0.040
# The target disc: its radius, and the ranges of its centre, inward from the bed's border and along it [m].
TARGET_RADIUS, TARGET_IN, TARGET_ALONG = 0.004, (0.005, 0.008), 0.003
# Radius of a right arm's ball [m]; with a smaller one the neck behind it (3 mm) meets the bed first.
RIGHT_TIP_RADIUS = 0.005
# Standard deviation over mean of a healthy liver's modulus, 1.65 of 6.63 kPa (doi 10.1177/8756479317733713).
MODULUS_SPREAD = 0.25
# Endoscope positions that are tried in turn: aside, outward and up from the middle of the edge [m].
PLACES = tuple((aside, 0.075, up) for up in (0.045, 0.035, 0.055, 0.070) for aside in (0.038, -0.038, 0.0))
# Largest visible share of any target at rest, and least visible share without the flap.
HIDDEN_SHARE, SEEN_SHARE = 0.05, 0.95
# Height of targets above the bed for the test of visibility [m].
TARGET_LIFT = 1e-4


@dataclass(frozen=True, eq=False)
class RetractScene:
    """A patient's organ with its retraction scene.

    Fields:
        anatomy: the scene on the turned mesh
        origin, frame: a point p of the patient's mesh is at (p - origin) @ frame here [m], (3,) and (3, 3)
        rim: the edge to be lifted
    """

    anatomy: Anatomy
    origin: FloatArray
    frame: FloatArray
    rim: Rim


def find_retraction(found: PatientScene, folder: Path, mesh_file: str) -> RetractScene | str:
    """The retraction scene of an organ, with its mesh as `mesh_file` in `folder`; or the reason why there is none."""
    cell = found.patient.cell_size
    if cell > CELL_MOST:
        return (
            f"cells of {cell * 1e3:.3g} mm are too coarse for an edge between a jaw's pads: "
            f"use --cell-size {CELL_MOST:g} or less"
        )
    rim = find_rim(found.patient.mesh, -np.array(found.scene.instrument.approach))
    return rim.reason if isinstance(rim, NoRim) else retract_scene(found, rim, folder, mesh_file)


def retract_scene(found: PatientScene, rim: Rim, folder: Path, mesh_file: str) -> RetractScene | str:
    """The scene in which a given edge is lifted; or the reason why it cannot be lifted."""
    bed_top = rim.underside[0] - BED_GAP
    origin = rim.place - rim.frame @ np.array([0.5 * FLAP_WIDTH, FLAP_DEPTH, -bed_top])
    mesh = found.patient.mesh
    turned = in_sweep_order(TetMesh((mesh.points - origin) @ rim.frame, mesh.tets, mesh.region, mesh.region_names))
    if not (turned.points[:, 1] < 0.0).any():
        return (
            f"the organ ends {(FLAP_DEPTH - turned.points[:, 1].min()) * 1e3:.0f} mm behind its thin edge: nothing "
            f"would hold it where {FLAP_DEPTH * 1e3:g} mm are lifted"
        )
    anatomy = anatomy_of(_scene(found, rim, turned, folder, mesh_file), turned)
    first = anatomy.scene.endoscope
    assert first is not None
    endoscope = find_endoscope(anatomy, (0.5 * FLAP_WIDTH, FLAP_DEPTH, 0.0), first.fov_deg)
    if endoscope is None:
        return (
            f"an edge of {rim.thickness * 1e3:.0f} mm fits the jaw, but from its free side an endoscope sees what lies "
            "under it without lifting it, or the rest of the organ stands before it"
        )
    anatomy = replace(anatomy, scene=replace(anatomy.scene, endoscope=endoscope))
    return RetractScene(
        with_substeps(anatomy, [anatomy.organ(modulus_factor=1.0 + MODULUS_SPREAD)]), origin, rim.frame, rim
    )


def told(made: RetractScene | str) -> str:
    """The result of the search for an edge to lift, in a sentence."""
    if isinstance(made, str):
        return f"none: {made}"
    x, y, z = (made.rim.place * 1e3).round(1)
    up = ", ".join(f"{value:.2f}" for value in made.rim.frame[:, 2])
    return (
        f"the edge at {x:g}, {y:g}, {z:g} mm, {made.rim.thickness * 1e3:.0f} mm thick where a jaw takes it, is lifted "
        f"along {up}"
    )


def with_retraction(found: PatientScene, made: RetractScene | str, scene_file: str) -> PatientScene:
    """The organ with a palpation scene that names its retraction scene, or the reason why there is none."""
    said = {"retract_refusal": made} if isinstance(made, str) else {"retract_scene": scene_file}
    return replace(found, anatomy=replace(found.anatomy, scene=replace(found.scene, **said)))


def _scene(found: PatientScene, rim: Rim, mesh: TetMesh, folder: Path, mesh_file: str) -> Scene:
    lobe, patient = make_scene(PATTERN), found.scene
    tilt = math.atan2(rim.jaw[2], -rim.jaw[1])
    bed_end = FLAP_DEPTH - BED_INSIDE
    return replace(
        lobe,
        name=Path(mesh_file).stem,
        description=f"{patient.description}: a thin edge, its underside level, to be lifted",
        folder=folder,
        mesh=MeshSource(tets=TetFile(mesh_file, "m")),
        material=patient.material,
        capsule=patient.capsule,
        damping=patient.damping,
        # A scan shows the organ under its weight: that is its rest, and lifting works against stiffness alone.
        gravity=(0.0, 0.0, 0.0),
        anchors=_anchors(mesh),
        supports=(_bed(bed_end),),
        contact=replace(lobe.contact, stiffness=patient.contact.stiffness),
        instrument=replace(
            lobe.instrument,
            tip_radius=RIGHT_TIP_RADIUS,
            approach=_vector(0.0, -math.sin(tilt), -math.cos(tilt)),
            tip_direction=_vector(*rim.jaw),
        ),
        port=_port(lobe.port),
        ports=tuple(_port(port) for port in lobe.ports),
        palpation=PalpationSettings(press_depth=0.003, face_angle_deg=60.0),
        retract=_retract(found, bed_end),
        regions=tuple(replace(region, lesion=False) for region in patient.regions),
    )


def _anchors(mesh: TetMesh) -> tuple[Anchor, ...]:
    """Boxes around all but the flap, without those that hold no node."""
    low, high = mesh.points.min(axis=0) - 1e-3, mesh.points.max(axis=0) + 1e-3
    free_low = np.array([0.0, 0.0, -FLAP_BELOW])
    free_high = np.array([FLAP_WIDTH, FLAP_DEPTH + FLAP_BEYOND, FLAP_ABOVE])
    anchors = []
    for axis, names in enumerate((("left", "right"), ("behind", "before"), ("below", "above"))):
        for side, name in enumerate(names):
            lower, upper = low.copy(), high.copy()
            if side == 0:
                upper[axis] = free_low[axis]
            else:
                lower[axis] = free_high[axis]
            if ((mesh.points >= lower) & (mesh.points <= upper)).all(axis=1).any():
                anchors.append(Anchor(name, box=Box(_vector(*lower), _vector(*upper))))
    return tuple(anchors)


def _bed(end: float) -> Support:
    half = 0.5 * (HIDING[1] - HIDING[0]) + 0.003
    return Support(
        "bed",
        "box",
        _vector(0.5 * FLAP_WIDTH, end - half, -0.5 * BED_THICKNESS),
        size=_vector(0.5 * BED_WIDTH, half, 0.5 * BED_THICKNESS),
        friction=0.2,
    )


def _retract(found: PatientScene, bed_end: float) -> Retraction:
    lobe = make_scene(PATTERN).retract
    assert lobe is not None and lobe.right_start_lower is not None and lobe.right_start_upper is not None
    modulus, middle = found.scene.material.youngs_modulus, 0.5 * FLAP_WIDTH
    return Retraction(
        target_distance=(_round(bed_end - TARGET_IN[1]), _round(bed_end - TARGET_IN[0])),
        target_along=(_round(middle - TARGET_ALONG), _round(middle + TARGET_ALONG)),
        start_lower=_moved(lobe.start_lower),
        start_upper=_moved(lobe.start_upper),
        target_radius=TARGET_RADIUS,
        youngs_modulus=((1.0 - MODULUS_SPREAD) * modulus, (1.0 + MODULUS_SPREAD) * modulus),
        camera=lobe.camera,
        right_start_lower=_moved(lobe.right_start_lower),
        right_start_upper=_moved(lobe.right_start_upper),
        flap=Flap((0.0, 0.0, 0.0), (FLAP_WIDTH, FLAP_DEPTH, SEEN_HEIGHT)),
    )


def _port(port: Port | None) -> Port:
    assert port is not None
    return replace(port, point=_moved(port.point))


def _moved(place: Vector) -> Vector:
    """A point of the scene lobe at the same place relative to this edge [m]."""
    x, y, z = place
    return _vector(x - LOBE_MIDDLE + 0.5 * FLAP_WIDTH, y - LOBE_EDGE + FLAP_DEPTH, z)


def find_endoscope(anatomy: Anatomy, edge: Vector, fov_deg: float) -> Endoscope | None:
    """The first of PLACES before an edge (3,) [m] from which targets are hidden, and visible without the flap."""
    table, triangles = anatomy.scene.retract, anatomy.mesh.boundary_triangles
    assert table is not None
    held = triangles[np.isin(triangles, anatomy.anchors).all(axis=1)]
    targets = _targets(table)
    middle = np.mean([target.centre for target in targets], axis=0)
    for shift in PLACES:
        eye = np.array(edge) + shift
        if all(
            _visible_share(eye, target, anatomy.mesh.points, triangles) <= HIDDEN_SHARE
            and _visible_share(eye, target, anatomy.mesh.points, held) >= SEEN_SHARE
            for target in targets
        ):
            return Endoscope(_vector(*eye), _vector(*middle), fov_deg)
    return None


def _targets(table: Retraction) -> list[Disc]:
    """Target discs at the corners of the range from which they are drawn."""
    up = np.array([0.0, 0.0, 1.0])
    return [
        Disc(np.array([x, y, TARGET_LIFT]), up, table.target_radius)
        for x in table.target_along
        for y in table.target_distance
    ]


def _visible_share(eye: FloatArray, target: Disc, points: FloatArray, triangles: IntArray) -> float:
    return float(uncovered(eye, target.points(), points, triangles).mean())


def _vector(x: float, y: float, z: float) -> Vector:
    return _round(x), _round(y), _round(z)


def _round(value: float) -> float:
    return round(float(value), 6) + 0.0
