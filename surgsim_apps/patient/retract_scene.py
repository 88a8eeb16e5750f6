"""Retraction scene of a patient's organ, turned so that a thin edge of it can be lifted."""

import math
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from msdm_core.arithmetic import arctan2, cos, matmul, norm, sin
from msdm_core.mesh import FloatArray, TetMesh, in_sweep_order, surface_cell
from msdm_core.organ import Support
from surgsim_apps.patient.fine_surface import mesh_source
from surgsim_apps.patient.patient_scene import PatientScene
from surgsim_apps.patient.rims import SEARCH, Rim, find_rim
from surgsim_env.scene import (
    Anatomy,
    Anchor,
    Box,
    Endoscope,
    Flap,
    PalpationSettings,
    Port,
    Retraction,
    Scene,
    Vector,
    anatomy_of,
    make_scene,
    with_substeps,
)
from surgsim_env.tasks import Disc, uncovered

PATTERN = "lobe"


@dataclass(frozen=True)
class RetractLayout:
    """Numbers of the scene; lengths [m]. Chosen, unless a source is given.

    Fields:
        cell_most: larger cells give no edge that fills a jaw evenly, and miss a bed of 24 mm
        lobe_edge, lobe_middle: y of the free edge and x of its middle in the scene lobe
        flap_depth, flap_width: extent of the free part inward from the edge and along it; the rest is held
        flap_beyond, flap_below, flap_above: its extent beyond the edge, below and above the bed's top
        flap_height: above the bed, up to which the flap is observed and measured: a jaw may lift its edge so far
        bed_inside: distance of the bed's border inside the edge, clear of the jaw
        bed_gap: distance of the bed's top below the organ above it
        bed_width, bed_thickness: of the bed along the edge and down
        bed_margin: half of the bed's depth beyond the depths at which the target is hidden
        bed_friction: as in the scene lobe
        target_radius: of the target disc
        target_in, target_along: ranges of its centre, inward from the bed's border and to both sides of its middle
        target_lift: height of targets above the bed for the test of visibility
        right_tip_radius: of a right arm's ball; with a smaller one the neck behind it (3 mm) meets the bed first
        modulus_spread: standard deviation over mean of a healthy liver's modulus, 1.65 of 6.63 kPa
            (doi 10.1177/8756479317733713)
        eyes: positions of the endoscope that are tried in turn: aside, outward and up from the middle of the edge
        hidden_share: largest visible share of any target at rest
        seen_share: least visible share of any target without the flap
    """

    cell_most: float = 0.011
    lobe_edge: float = 0.052
    lobe_middle: float = 0.040
    flap_depth: float = 0.060
    flap_width: float = 0.140
    flap_beyond: float = 0.015
    flap_below: float = 0.020
    flap_above: float = 0.080
    flap_height: float = 0.025
    bed_inside: float = 0.016
    bed_gap: float = 0.002
    bed_width: float = 0.030
    bed_thickness: float = 0.040
    bed_margin: float = 0.003
    bed_friction: float = 0.2
    target_radius: float = 0.004
    target_in: tuple[float, float] = (0.005, 0.008)
    target_along: float = 0.003
    target_lift: float = 1e-4
    right_tip_radius: float = 0.005
    modulus_spread: float = 0.25
    eyes: tuple[Vector, ...] = tuple(
        (aside, 0.075, up) for up in (0.045, 0.035, 0.055, 0.070) for aside in (0.038, -0.038, 0.0)
    )
    hidden_share: float = 0.05
    seen_share: float = 0.95


LAYOUT = RetractLayout()


@dataclass(frozen=True, eq=False)
class RetractScene:
    """A patient's organ with its retraction scene.

    Fields:
        anatomy: the scene on the turned mesh
        origin: a point p of the patient's mesh is at (p - origin) @ rim.frame here [m], (3,)
        rim: the edge to be lifted
    """

    anatomy: Anatomy
    origin: FloatArray
    rim: Rim


def find_retraction(organ: PatientScene, out: Path) -> RetractScene | str:
    """Retraction scene of an organ, with its mesh to be written to `out`; or the reason for none."""
    mesh, cell = organ.patient.mesh, organ.patient.cell_size
    if cell > LAYOUT.cell_most:
        return _too_coarse(cell)
    rim = find_rim(mesh, -np.array(organ.scene.instrument.approach))
    if isinstance(rim, str):
        return rim
    # Cells may be coarse away from the face that the probe presses.
    triangles = mesh.boundary_triangles
    near = norm(mesh.points[triangles].mean(axis=1) - rim.place, axis=1) < LAYOUT.flap_depth
    cell = surface_cell(mesh, triangles[near])
    return _too_coarse(cell) if cell > LAYOUT.cell_most else _retract_scene(organ, rim, out)


def _too_coarse(cell: float) -> str:
    return (
        f"cells of {cell * 1e3:.3g} mm are too coarse for an edge between a jaw's pads: "
        f"use --cell-size {LAYOUT.cell_most:g} or less"
    )


def _retract_scene(organ: PatientScene, rim: Rim, out: Path) -> RetractScene | str:
    """The scene with an edge to be lifted; or the reason for none."""
    depth, middle = LAYOUT.flap_depth, 0.5 * LAYOUT.flap_width
    bed_top = rim.underside[0] - LAYOUT.bed_gap
    origin = rim.place - matmul(rim.frame, np.array([middle, depth, -bed_top]))
    mesh = organ.patient.mesh
    turned = in_sweep_order(TetMesh(matmul(mesh.points - origin, rim.frame), mesh.tets, mesh.region, mesh.region_names))
    if not (turned.points[:, 1] < 0.0).any():
        return (
            f"the organ ends {(depth - turned.points[:, 1].min()) * 1e3:.0f} mm behind its thin edge: nothing "
            f"would hold it where {depth * 1e3:g} mm are lifted"
        )
    anatomy = anatomy_of(_scene(organ, rim, turned, out), turned)
    endoscope = _find_endoscope(anatomy, (middle, depth, 0.0))
    if endoscope is None:
        return (
            f"an edge of {rim.thickness * 1e3:.0f} mm fits the jaw, but from its free side an endoscope sees what lies "
            "under it without lifting it, or the rest of the organ stands before it"
        )
    anatomy = replace(anatomy, scene=replace(anatomy.scene, endoscope=endoscope))
    stiffest = anatomy.organ(modulus_factor=1.0 + LAYOUT.modulus_spread)
    return RetractScene(with_substeps(anatomy, [stiffest], most=math.inf), origin, rim)


def retraction_text(retraction: RetractScene | str) -> str:
    """Result of the search for an edge to lift, in a sentence."""
    if isinstance(retraction, str):
        return f"none: {retraction}"
    rim = retraction.rim
    x, y, z = (rim.place * 1e3).round(1)
    up = ", ".join(f"{value:.2f}" for value in rim.frame[:, 2])
    return (
        f"the edge at {x:g}, {y:g}, {z:g} mm, {rim.thickness * 1e3:.0f} mm thick where a jaw takes it, is lifted "
        f"along {up}"
    )


def _scene(organ: PatientScene, rim: Rim, mesh: TetMesh, out: Path) -> Scene:
    lobe, patient = make_scene(PATTERN), organ.scene
    tilt = float(arctan2(rim.jaw[2], -rim.jaw[1]))
    bed_end = LAYOUT.flap_depth - LAYOUT.bed_inside
    half_depth = 0.5 * (SEARCH.hiding[1] - SEARCH.hiding[0]) + LAYOUT.bed_margin
    half_thickness = 0.5 * LAYOUT.bed_thickness
    bed = Support(
        "bed",
        "box",
        _vector(0.5 * LAYOUT.flap_width, bed_end - half_depth, -half_thickness),
        size=_vector(0.5 * LAYOUT.bed_width, half_depth, half_thickness),
        friction=LAYOUT.bed_friction,
    )
    return replace(
        lobe,
        name=out.stem,
        description=f"{patient.description}: a thin edge, its underside level, to be lifted",
        folder=out.parent,
        mesh=mesh_source(out, organ.patient.surface),
        material=patient.material,
        capsule=patient.capsule,
        damping=patient.damping,
        stiffness_rule=patient.stiffness_rule,
        # A scan shows the organ under its weight: that is its rest, and lifting works against stiffness alone.
        gravity=(0.0, 0.0, 0.0),
        anchors=_anchors(mesh),
        supports=(bed,),
        instrument=replace(
            lobe.instrument,
            tip_radius=LAYOUT.right_tip_radius,
            approach=_vector(0.0, -float(sin(tilt)), -float(cos(tilt))),
            tip_direction=_vector(*rim.jaw),
        ),
        port=_port(lobe.port),
        ports=tuple(_port(port) for port in lobe.ports),
        palpation=PalpationSettings(press_depth=0.003, face_angle_deg=60.0),
        retract=_retract(lobe.retract, patient.material.youngs_modulus, bed_end),
        regions=tuple(replace(region, lesion=False) for region in patient.regions),
        cranial=_vector(*matmul(np.array(patient.cranial), rim.frame)),
    )


def _anchors(mesh: TetMesh) -> tuple[Anchor, ...]:
    """Boxes around all but the flap, without those that hold no node."""
    low, high = mesh.points.min(axis=0) - 1e-3, mesh.points.max(axis=0) + 1e-3
    free_low = np.array([0.0, 0.0, -LAYOUT.flap_below])
    free_high = np.array([LAYOUT.flap_width, LAYOUT.flap_depth + LAYOUT.flap_beyond, LAYOUT.flap_above])
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


def _retract(lobe: Retraction | None, modulus: float, bed_end: float) -> Retraction:
    assert lobe is not None and lobe.right_start_lower is not None and lobe.right_start_upper is not None
    middle, spread = 0.5 * LAYOUT.flap_width, LAYOUT.modulus_spread
    return Retraction(
        target_distance=(_round(bed_end - LAYOUT.target_in[1]), _round(bed_end - LAYOUT.target_in[0])),
        target_along=(_round(middle - LAYOUT.target_along), _round(middle + LAYOUT.target_along)),
        start_lower=_moved(lobe.start_lower),
        start_upper=_moved(lobe.start_upper),
        target_radius=LAYOUT.target_radius,
        youngs_modulus=((1.0 - spread) * modulus, (1.0 + spread) * modulus),
        camera=lobe.camera,
        right_start_lower=_moved(lobe.right_start_lower),
        right_start_upper=_moved(lobe.right_start_upper),
        flap=Flap((0.0, 0.0, 0.0), (LAYOUT.flap_width, LAYOUT.flap_depth, LAYOUT.flap_height)),
    )


def _port(port: Port | None) -> Port:
    assert port is not None
    return replace(port, point=_moved(port.point))


def _moved(place: Vector) -> Vector:
    """A point of the scene lobe at the same place relative to this edge [m]."""
    x, y, z = place
    return _vector(x - LAYOUT.lobe_middle + 0.5 * LAYOUT.flap_width, y - LAYOUT.lobe_edge + LAYOUT.flap_depth, z)


def _find_endoscope(anatomy: Anatomy, edge: Vector) -> Endoscope | None:
    """The first endoscope before an edge (3,) [m] with targets hidden, and visible without the flap."""
    table, points, triangles = anatomy.scene.retract, anatomy.mesh.points, anatomy.mesh.boundary_triangles
    pattern = anatomy.scene.endoscope
    assert table is not None and pattern is not None
    held = triangles[np.isin(triangles, anatomy.anchors).all(axis=1)]
    # At the corners of the range from which targets are drawn.
    up, corners = np.array([0.0, 0.0, 1.0]), product(table.target_along, table.target_distance)
    targets = [Disc(np.array([x, y, LAYOUT.target_lift]), up, table.target_radius) for x, y in corners]
    middle = np.mean([target.centre for target in targets], axis=0)
    for shift in LAYOUT.eyes:
        eye = np.array(edge) + shift
        if all(
            uncovered(eye, target.points(), points, triangles).mean() <= LAYOUT.hidden_share
            and uncovered(eye, target.points(), points, held).mean() >= LAYOUT.seen_share
            for target in targets
        ):
            return Endoscope(_vector(*eye), _vector(*middle), pattern.fov_deg)
    return None


def _vector(x: float, y: float, z: float) -> Vector:
    return _round(x), _round(y), _round(z)


def _round(value: float) -> float:
    return round(float(value), 6) + 0.0
