"""The retraction scene of a patient's organ, turned so that a thin edge of it, which a jaw can grasp, can be lifted."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.arithmetic import arctan2, cos, eigh, lstsq, matmul, norm, sin
from msdm_core.mesh import FloatArray, TetMesh, in_sweep_order, surface_cell
from msdm_core.organ import Support
from surgsim_apps.patient.fine_surface import mesh_source
from surgsim_apps.patient.patient_scene import PatientScene
from surgsim_apps.patient.surface_files import voxels_inside
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

# Opening and pad width of the grasper's jaw (scenes/instruments/grasper.xml), play that is left in the opening, and
# least depth to which an edge is grasped [m].
JAW_OPENING, PAD_WIDTH = 0.020, 0.016
JAW_PLAY, OVERLAP_LEAST = 0.003, 0.012
# Edge of voxels; radii of the balls whose filled share finds edges (a half space fills 0.5) [m].
VOXEL = 0.0015
BALL, BALL_WIDE, FILLED_MOST = 0.015, 0.030, 0.45
# Number of the thinnest places that are examined, on both sides.
PLACES_TRIED = 60
# Sampling of the thickness: positions along the edge, inward, and across [m].
ALONG = np.linspace(-0.012, 0.012, 9)
DEPTHS = np.arange(0.001, 0.0365, 0.001)
HEIGHTS = np.arange(-0.03, 0.0601, 0.001)
# Depths between which the target is hidden, and largest unevenness of the side that hides it [m].
HIDING = (0.012, 0.030)
UNEVEN_MOST = 0.006
# Largest bend of an edge's border over the width of a pad [m].
BEND_MOST = 0.004
# A side turned further from the given upward direction is taken only if there is no other.
TURN_MOST = math.radians(60.0)
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
class Rim:
    """An edge of an organ that a jaw can grasp.

    Fields:
        place: a point on the edge (3,) [m]
        frame: columns are x along the edge, y outward, z up, normal to the side that hides (3, 3)
        thickness: opening of a jaw that grasps it OVERLAP_LEAST deep [m]
        underside: lowest and highest point of the side that hides, along z from `place` [m]
        jaw: direction in which the jaw points, in the frame (3,)
        stiffness: mean cubed thickness above the hidden area [m^3], to compare edges
    """

    place: FloatArray
    frame: FloatArray
    thickness: float
    underside: tuple[float, float]
    jaw: FloatArray
    stiffness: float


def _no_rim(thickness: float) -> str:
    """The reason why an organ has no edge to be lifted, from the opening that its thinnest one needs [m]."""
    jaw = f"the jaw opens {JAW_OPENING * 1e3:g} mm and needs {JAW_PLAY * 1e3:g} mm of play"
    if thickness <= JAW_OPENING - JAW_PLAY:
        return (
            f"an edge of {thickness * 1e3:.0f} mm fits the jaw ({jaw}), but none has an even side of "
            f"{np.ptp(ALONG) * 1e3:.0f} x {np.ptp(HIDING) * 1e3:.0f} mm behind it that could hide something"
        )
    if math.isinf(thickness):
        return f"this organ has no edge that is straight over the jaw's {PAD_WIDTH * 1e3:g} mm; {jaw}"
    return (
        f"no edge is thin enough to be grasped {OVERLAP_LEAST * 1e3:g} mm deep: the thinnest is "
        f"{thickness * 1e3:.0f} mm thick, {jaw}"
    )


class OrganVoxels:
    """The voxels of edge `step` [m] inside an organ's boundary."""

    def __init__(self, mesh: TetMesh, step: float) -> None:
        """Voxelise the inside of a mesh's boundary."""
        self.step = step
        self._inside, self._first = voxels_inside(mesh.points, mesh.boundary_triangles.astype(np.int64), step)
        self._centres = (np.argwhere(self._inside) + self._first) * step
        self._tree = KDTree(self._centres)

    def contains(self, places: FloatArray) -> NDArray[np.bool_]:
        """Whether points (..., 3) [m] lie in the organ (...,)."""
        index = np.rint(places / self.step).astype(np.int64) - self._first
        there = np.logical_and(index >= 0, index < self._inside.shape).all(axis=-1)
        x, y, z = np.moveaxis(np.where(np.expand_dims(there, -1), index, 0), -1, 0)
        return np.logical_and(there, self._inside[x, y, z])

    def near(self, place: FloatArray, radius: float) -> FloatArray:
        """Vectors from a point (3,) [m] to the organ's voxels within a radius [m] (n, 3)."""
        return self._centres[self._tree.query_ball_point(place, radius)] - place

    def filled_share(self, places: FloatArray, radius: float) -> FloatArray:
        """Share of a ball of a radius [m] around each point (n, 3) that the organ fills (n,)."""
        count = self._tree.query_ball_point(places, radius, return_length=True)
        share = self.step / radius
        return np.asarray(count) * (share * share * share) / (4.0 / 3.0 * np.pi)

    def columns(
        self, origin: FloatArray, frame: FloatArray, x: FloatArray, depth: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Bottom and top of the organ along the z lines of a frame, from its edge inward.

        Args:
            origin: on the organ's edge [m], (3,).
            frame: columns are the axes x, y (outward) and z (3, 3).
            x: positions along the edge [m], (n_x,).
            depth: distances inward from the edge, against y [m], rising, (n_depth,).
            height: positions along z that are sampled [m], evenly spaced, (n_height,).

        Returns:
            Two arrays of heights (n_x, n_depth) [m], NaN where a line misses the organ. If a line meets several pieces,
            the one nearest to the middle of the previous piece is taken.
        """
        places = (
            origin
            + x[:, None, None, None] * frame[:, 0]
            - depth[:, None, None] * frame[:, 1]
            + height[:, None] * frame[:, 2]
        )
        inside = self.contains(places)
        bottom = np.full(inside.shape[:2], np.nan)
        top, half = bottom.copy(), 0.5 * float(height[1] - height[0])
        for row in range(len(x)):
            middle = 0.0
            for place in range(len(depth)):
                edges = np.flatnonzero(np.diff(inside[row, place].astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
                if not len(edges):
                    continue
                low, high = height[edges[:, 0]], height[edges[:, 1] - 1]
                nearest = int(np.argmin(np.maximum(np.maximum(low - middle, middle - high), 0.0)))
                bottom[row, place], top[row, place] = low[nearest] - half, high[nearest] + half
                middle = 0.5 * float(low[nearest] + high[nearest])
        return bottom, top


def find_rim(mesh: TetMesh, up: FloatArray) -> Rim | str:
    """The most flexible edge of an organ that fits into a jaw, with z on the side of `up` (3,) if possible.

    If there is none, the reason in a sentence.
    """
    voxels, thinnest, found = OrganVoxels(mesh, VOXEL), math.inf, list[Rim]()
    for place, frame in _edges(mesh, voxels, up):
        thickness = _thickness(voxels, place, frame)
        thinnest = min(thinnest, thickness)
        if thickness > JAW_OPENING - JAW_PLAY:
            continue
        sides = (_rim(voxels, place, side, thickness) for side in (frame, frame * [-1.0, 1.0, -1.0]))
        found += [rim for rim in sides if rim is not None]
    if not found:
        return _no_rim(thinnest)
    upright = [rim for rim in found if matmul(rim.frame[:, 2], up) >= float(cos(TURN_MOST))]
    return min(upright or found, key=lambda rim: rim.stiffness)


def _edges(mesh: TetMesh, voxels: OrganVoxels, up: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Points on edges with frames: y away from the organ nearby, z along its smallest extent, on the side of `up`."""
    places = mesh.points[mesh.boundary_nodes]
    sharp = np.flatnonzero(voxels.filled_share(places, BALL) < FILLED_MOST)
    flexible = sharp[np.argsort(voxels.filled_share(places[sharp], BALL_WIDE), kind="stable")]
    for place in places[flexible[:PLACES_TRIED]]:
        near = voxels.near(place, BALL)
        if len(near) < 10:
            continue
        outward = -near.mean(axis=0)
        outward /= norm(outward)
        centred = near - near.mean(axis=0)
        thin = eigh(matmul(centred.T, centred))[1][:, 0]
        across = thin - matmul(thin, outward) * outward
        across *= np.copysign(1.0, matmul(across, up)) / norm(across)
        yield place, np.stack([np.cross(outward, across), outward, across], axis=1)


def _thickness(voxels: OrganVoxels, place: FloatArray, frame: FloatArray) -> float:
    """Opening of a jaw that grasps an edge OVERLAP_LEAST deep over its pads [m]; infinite where the edge bends."""
    bottom, top = voxels.columns(place, frame, ALONG, DEPTHS, HEIGHTS)
    held = np.abs(ALONG) <= 0.5 * PAD_WIDTH + 1e-6
    border = DEPTHS[np.argmax(np.isfinite(bottom[held]), axis=1)]
    if not np.isfinite(bottom[held]).any(axis=1).all() or np.ptp(border) > BEND_MOST:
        return math.inf
    # All tissue between the border and that depth must fit.
    within = DEPTHS <= border.min() + OVERLAP_LEAST + 1e-6
    return float(np.nanmax(top[held][:, within]) - np.nanmin(bottom[held][:, within]))


def _rim(voxels: OrganVoxels, place: FloatArray, frame: FloatArray, thickness: float) -> Rim | None:
    """The edge with its frame turned until the side below is level; None where that side is uneven or missing."""
    hiding = (DEPTHS >= HIDING[0]) & (DEPTHS <= HIDING[1])
    x, depth = (part.ravel() for part in np.meshgrid(ALONG, DEPTHS[hiding], indexing="ij"))
    level = turned = frame
    bottom, top = np.zeros(0), np.zeros(0)
    for _ in range(4):
        bottom, top = (side[:, hiding].ravel() for side in voxels.columns(place, turned, ALONG, DEPTHS, HEIGHTS))
        if not np.isfinite(bottom).all():
            return None
        _, along, inward = lstsq(np.stack([np.ones_like(x), x, depth], axis=1), bottom)
        level, turned = turned, _levelled(turned, matmul(turned, np.array([-along, inward, 1.0])))
    if np.ptp(bottom) > UNEVEN_MOST:
        return None
    jaw = matmul(level.T, -frame[:, 1])
    jaw[0] = 0.0
    # The bending stiffness of a plate grows with its thickness cubed.
    thick = top - bottom
    stiffness = float((thick * thick * thick).mean())
    underside = (float(bottom.min()), float(bottom.max()))
    return Rim(place, level, thickness, underside, jaw / norm(jaw), stiffness)


def _levelled(frame: FloatArray, up: FloatArray) -> FloatArray:
    """The frame with another z, turned by the smallest angle."""
    up = up / norm(up)
    outward = frame[:, 1] - matmul(frame[:, 1], up) * up
    outward /= norm(outward)
    return np.stack([np.cross(outward, up), outward, up], axis=1)


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


def find_retraction(found: PatientScene, out: Path) -> RetractScene | str:
    """The retraction scene of an organ, with its mesh to be written to `out`; or the reason why there is none."""
    mesh, cell = found.patient.mesh, found.patient.cell_size
    if cell > CELL_MOST:
        return _too_coarse(cell)
    rim = find_rim(mesh, -np.array(found.scene.instrument.approach))
    if isinstance(rim, str):
        return rim
    # Cells may be coarse away from the face that the probe presses.
    triangles = mesh.boundary_triangles
    near = norm(mesh.points[triangles].mean(axis=1) - rim.place, axis=1) < FLAP_DEPTH
    cell = surface_cell(mesh, triangles[near])
    return _too_coarse(cell) if cell > CELL_MOST else retract_scene(found, rim, out)


def _too_coarse(cell: float) -> str:
    return (
        f"cells of {cell * 1e3:.3g} mm are too coarse for an edge between a jaw's pads: "
        f"use --cell-size {CELL_MOST:g} or less"
    )


def retract_scene(found: PatientScene, rim: Rim, out: Path) -> RetractScene | str:
    """The scene in which a given edge is lifted; or the reason why it cannot be lifted."""
    bed_top = rim.underside[0] - BED_GAP
    origin = rim.place - matmul(rim.frame, np.array([0.5 * FLAP_WIDTH, FLAP_DEPTH, -bed_top]))
    mesh = found.patient.mesh
    turned = in_sweep_order(TetMesh(matmul(mesh.points - origin, rim.frame), mesh.tets, mesh.region, mesh.region_names))
    if not (turned.points[:, 1] < 0.0).any():
        return (
            f"the organ ends {(FLAP_DEPTH - turned.points[:, 1].min()) * 1e3:.0f} mm behind its thin edge: nothing "
            f"would hold it where {FLAP_DEPTH * 1e3:g} mm are lifted"
        )
    anatomy = anatomy_of(_scene(found, rim, turned, out), turned)
    first = anatomy.scene.endoscope
    assert first is not None
    endoscope = find_endoscope(anatomy, (0.5 * FLAP_WIDTH, FLAP_DEPTH, 0.0), first.fov_deg)
    if endoscope is None:
        return (
            f"an edge of {rim.thickness * 1e3:.0f} mm fits the jaw, but from its free side an endoscope sees what lies "
            "under it without lifting it, or the rest of the organ stands before it"
        )
    anatomy = replace(anatomy, scene=replace(anatomy.scene, endoscope=endoscope))
    stiffest = anatomy.organ(modulus_factor=1.0 + MODULUS_SPREAD)
    return RetractScene(with_substeps(anatomy, [stiffest], most=math.inf), origin, rim)


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


def _scene(found: PatientScene, rim: Rim, mesh: TetMesh, out: Path) -> Scene:
    lobe, patient = make_scene(PATTERN), found.scene
    tilt = float(arctan2(rim.jaw[2], -rim.jaw[1]))
    bed_end, half = FLAP_DEPTH - BED_INSIDE, 0.5 * (HIDING[1] - HIDING[0]) + 0.003
    return replace(
        lobe,
        name=out.stem,
        description=f"{patient.description}: a thin edge, its underside level, to be lifted",
        folder=out.parent,
        mesh=mesh_source(out, found.patient.surface),
        material=patient.material,
        capsule=patient.capsule,
        damping=patient.damping,
        # A scan shows the organ under its weight: that is its rest, and lifting works against stiffness alone.
        gravity=(0.0, 0.0, 0.0),
        anchors=_anchors(mesh),
        supports=(
            Support(
                "bed",
                "box",
                _vector(0.5 * FLAP_WIDTH, bed_end - half, -0.5 * BED_THICKNESS),
                size=_vector(0.5 * BED_WIDTH, half, 0.5 * BED_THICKNESS),
                friction=0.2,
            ),
        ),
        contact=replace(lobe.contact, stiffness=patient.contact.stiffness),
        instrument=replace(
            lobe.instrument,
            tip_radius=RIGHT_TIP_RADIUS,
            approach=_vector(0.0, -float(sin(tilt)), -float(cos(tilt))),
            tip_direction=_vector(*rim.jaw),
        ),
        port=_port(lobe.port),
        ports=tuple(_port(port) for port in lobe.ports),
        palpation=PalpationSettings(press_depth=0.003, face_angle_deg=60.0),
        retract=_retract(found, bed_end),
        regions=tuple(replace(region, lesion=False) for region in patient.regions),
        cranial=_vector(*matmul(np.array(patient.cranial), rim.frame)),
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
    table, points, triangles = anatomy.scene.retract, anatomy.mesh.points, anatomy.mesh.boundary_triangles
    assert table is not None
    held = triangles[np.isin(triangles, anatomy.anchors).all(axis=1)]
    up, corners = np.array([0.0, 0.0, 1.0]), product(table.target_along, table.target_distance)
    # At the corners of the range from which targets are drawn.
    targets = [Disc(np.array([x, y, TARGET_LIFT]), up, table.target_radius) for x, y in corners]
    middle = np.mean([target.centre for target in targets], axis=0)
    for shift in PLACES:
        eye = np.array(edge) + shift
        if all(
            uncovered(eye, target.points(), points, triangles).mean() <= HIDDEN_SHARE
            and uncovered(eye, target.points(), points, held).mean() >= SEEN_SHARE
            for target in targets
        ):
            return Endoscope(_vector(*eye), _vector(*middle), fov_deg)
    return None


def _vector(x: float, y: float, z: float) -> Vector:
    return _round(x), _round(y), _round(z)


def _round(value: float) -> float:
    return round(float(value), 6) + 0.0
