"""The edge of an organ that a jaw can grasp: its place, direction and thickness, and the side that hides a target."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray, TetMesh
from surgsim_env.patient.voxels import OrganVoxels

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


@dataclass(frozen=True)
class NoRim:
    """An organ without an edge to be lifted; `thickness` is the opening that its thinnest one needs [m]."""

    thickness: float

    @property
    def reason(self) -> str:
        """The reason why the organ cannot be retracted, in a sentence."""
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
    """The most flexible edge of an organ that fits into a jaw, with z on the side of `up` (3,) if possible."""
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
    """Points on edges with frames: y away from the organ nearby, z along its smallest extent, on the side of `up`."""
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
        _, along, inward = np.linalg.lstsq(np.stack([np.ones_like(x), x, depth], axis=1), bottom, rcond=None)[0]
        level, turned = turned, _levelled(turned, turned @ np.array([-along, inward, 1.0]))
    if np.ptp(bottom) > UNEVEN_MOST:
        return None
    jaw = level.T @ -frame[:, 1]
    jaw[0] = 0.0
    # The bending stiffness of a plate grows with its thickness cubed.
    stiffness = float(((top - bottom) ** 3).mean())
    underside = (float(bottom.min()), float(bottom.max()))
    return Rim(place, level, thickness, underside, jaw / np.linalg.norm(jaw), stiffness)


def _levelled(frame: FloatArray, up: FloatArray) -> FloatArray:
    """The frame with another z, turned by the smallest angle."""
    up = up / np.linalg.norm(up)
    outward = frame[:, 1] - (frame[:, 1] @ up) * up
    outward /= np.linalg.norm(outward)
    return np.stack([np.cross(outward, up), outward, up], axis=1)
