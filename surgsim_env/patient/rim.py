"""The edge of an organ that a jaw can take: where it is thin, which way it points, what it hides."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray, TetMesh
from surgsim_env.patient.organ_voxels import OrganVoxels

# The grasper's jaw (scenes/instruments/grasper.xml): it opens so far, its pads are so wide [m]. So much of the
# opening is left free, and the edge goes in so deep.
JAW_OPENING, PAD_WIDTH = 0.020, 0.016
JAW_PLAY, OVERLAP_LEAST = 0.003, 0.012
# Voxels [m], and the balls by whose filling edges are found: what a half space fills is no edge.
VOXEL = 0.0015
BALL, BALL_WIDE, FILLED_MOST = 0.015, 0.030, 0.45
# So many of the most flexible places are looked at, on both sides.
PLACES_TRIED = 60
# Lines by which thickness is measured: along the edge, inward, across [m].
ALONG = np.linspace(-0.012, 0.012, 9)
DEPTHS = np.arange(0.001, 0.0365, 0.001)
HEIGHTS = np.arange(-0.03, 0.0601, 0.001)
# Between these depths lies what is hidden; the side that hides it is to be even to so much [m].
HIDING = (0.012, 0.030)
UNEVEN_MOST = 0.006
# An edge's border may bend by so much over the width of a pad [m].
BEND_MOST = 0.004
# A side that is turned from the given upward direction by more than this is taken only if no other is found.
TURN_MOST = math.radians(60.0)


@dataclass(frozen=True, eq=False)
class Rim:
    """An edge of an organ that a jaw can take.

    Fields:
        place: on the edge [m], (3,)
        frame: columns are x along the edge, y outward, z up, normal to the side that hides (3, 3)
        thickness: how wide a jaw must open to take it OVERLAP_LEAST deep [m]
        underside: height of the side that hides over `place`, lowest and highest [m]
        jaw: where the jaw points, in the frame, (3,)
        stiffness: mean cube of the thickness above what it hides [m^3]; edges are compared by it
    """

    place: FloatArray
    frame: FloatArray
    thickness: float
    underside: tuple[float, float]
    jaw: FloatArray
    stiffness: float


@dataclass(frozen=True)
class NoRim:
    """An organ without an edge to be lifted; `thickness` is how wide a jaw must open for its thinnest one [m]."""

    thickness: float

    @property
    def reason(self) -> str:
        """Why it cannot be retracted, in a sentence."""
        jaw = f"the jaw opens {JAW_OPENING * 1e3:g} mm and needs {JAW_PLAY * 1e3:g} mm of play"
        if self.thickness <= JAW_OPENING - JAW_PLAY:
            return (
                f"an edge of {self.thickness * 1e3:.0f} mm fits the jaw ({jaw}), but none has an even side of "
                f"{np.ptp(ALONG) * 1e3:.0f} x {np.ptp(HIDING) * 1e3:.0f} mm behind it that could hide something"
            )
        if math.isinf(self.thickness):
            return f"this organ has no edge that is straight over the jaw's {PAD_WIDTH * 1e3:g} mm; {jaw}"
        return (
            f"no edge is thin enough to be grasped {OVERLAP_LEAST * 1e3:g} mm deep: the thinnest is "
            f"{self.thickness * 1e3:.0f} mm thick, {jaw}"
        )


def find_rim(mesh: TetMesh, up: FloatArray) -> Rim | NoRim:
    """The most flexible edge of an organ that fits in a jaw, lifted to the side nearest to `up` (3,)."""
    voxels, thinnest, found = OrganVoxels(mesh, VOXEL), math.inf, list[Rim]()
    for place, frame in _edges(mesh, voxels, up):
        thickness = _thickness(voxels, place, frame)
        thinnest = min(thinnest, thickness)
        if thickness > JAW_OPENING - JAW_PLAY:
            continue
        sides = (_rim(voxels, place, side, thickness) for side in (frame, frame * [-1.0, 1.0, -1.0]))
        found += [rim for rim in sides if rim is not None]
    if not found:
        return NoRim(thinnest)
    upright = [rim for rim in found if rim.frame[:, 2] @ up >= math.cos(TURN_MOST)]
    return min(upright or found, key=lambda rim: rim.stiffness)


def _edges(mesh: TetMesh, voxels: OrganVoxels, up: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Places on edges and frames: outward is away from the organ near by, z along its thinnest way, on up's side."""
    places = mesh.points[mesh.boundary_nodes]
    sharp = np.flatnonzero(voxels.filled_share(places, BALL) < FILLED_MOST)
    flexible = sharp[np.argsort(voxels.filled_share(places[sharp], BALL_WIDE), kind="stable")]
    for place in places[flexible[:PLACES_TRIED]]:
        near = voxels.near(place, BALL)
        if len(near) < 10:
            continue
        outward = -near.mean(axis=0)
        outward /= np.linalg.norm(outward)
        thin = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        across = thin - (thin @ outward) * outward
        across *= np.copysign(1.0, across @ up) / np.linalg.norm(across)
        yield place, np.stack([np.cross(outward, across), outward, across], axis=1)


def _thickness(voxels: OrganVoxels, place: FloatArray, frame: FloatArray) -> float:
    """How wide a jaw must open to take an edge OVERLAP_LEAST deep over its pads [m]; infinite where it bends."""
    bottom, top = voxels.columns(place, frame, ALONG, DEPTHS, HEIGHTS)
    held = np.abs(ALONG) <= 0.5 * PAD_WIDTH + 1e-6
    border = DEPTHS[np.argmax(np.isfinite(bottom[held]), axis=1)]
    if not np.isfinite(bottom[held]).any(axis=1).all() or np.ptp(border) > BEND_MOST:
        return math.inf
    # What has gone in before must fit, too.
    within = DEPTHS <= border.min() + OVERLAP_LEAST + 1e-6
    return float(np.nanmax(top[held][:, within]) - np.nanmin(bottom[held][:, within]))


def _rim(voxels: OrganVoxels, place: FloatArray, frame: FloatArray, thickness: float) -> Rim | None:
    """The edge with its frame turned until the side below is level; None where that side is uneven or not there."""
    hiding = (DEPTHS >= HIDING[0]) & (DEPTHS <= HIDING[1])
    x, depth = (part.ravel() for part in np.meshgrid(ALONG, DEPTHS[hiding], indexing="ij"))
    turned, bottom, top = frame, np.zeros(0), np.zeros(0)
    for _ in range(4):
        bottom, top = (side[:, hiding].ravel() for side in voxels.columns(place, turned, ALONG, DEPTHS, HEIGHTS))
        if not np.isfinite(bottom).all():
            return None
        _, along, inward = np.linalg.lstsq(np.stack([np.ones_like(x), x, depth], axis=1), bottom, rcond=None)[0]
        level, turned = turned, _levelled(turned, turned @ np.array([-along, inward, 1.0]))
    if np.ptp(bottom) > UNEVEN_MOST:
        return None
    jaw = level.T @ -frame[:, 1]
    jaw[0] = 0.0
    # A plate bends by its thickness cubed.
    stiffness = float(((top - bottom) ** 3).mean())
    underside = (float(bottom.min()), float(bottom.max()))
    return Rim(place, level, thickness, underside, jaw / np.linalg.norm(jaw), stiffness)


def _levelled(frame: FloatArray, up: FloatArray) -> FloatArray:
    """The frame with another z, turned as little as can be about its x and y."""
    up = up / np.linalg.norm(up)
    outward = frame[:, 1] - (frame[:, 1] @ up) * up
    outward /= np.linalg.norm(outward)
    return np.stack([np.cross(outward, up), outward, up], axis=1)
