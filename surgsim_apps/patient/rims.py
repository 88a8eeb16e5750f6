"""Search for a thin edge of an organ that a jaw can grasp and lift."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.arithmetic import cos, eigh, lstsq, matmul, norm
from msdm_core.mesh import FloatArray, TetMesh
from surgsim_apps.patient.surface_files import voxels_inside


@dataclass(frozen=True, eq=False)
class RimSearch:
    """Numbers of the search; lengths [m]. All but the jaw's are chosen.

    Fields:
        jaw_opening, pad_width: of the grasper (scenes/instruments/grasper.xml)
        jaw_play: least play of an edge in the opening
        overlap: least depth to which an edge is grasped
        voxel: edge of the voxels
        ball, ball_wide: radii of balls around points of the surface; the less of them is filled, the sharper the edge
        filled_most: largest filled share of the first ball at an edge; a half space fills 0.5
        place_count: number of the sharpest places that are examined, on both sides
        along, depths, heights: samples of the thickness along the edge, inward and across
        hiding: range of depths at which the target is hidden
        uneven_most: largest unevenness of the side that hides it
        bend_most: largest bend of an edge's border over the width of a pad
        turn_most: largest angle of a preferred side from the upward direction [rad]
    """

    jaw_opening: float = 0.020
    pad_width: float = 0.016
    jaw_play: float = 0.003
    overlap: float = 0.012
    voxel: float = 0.0015
    ball: float = 0.015
    ball_wide: float = 0.030
    filled_most: float = 0.45
    place_count: int = 60
    along: FloatArray = field(default_factory=lambda: np.linspace(-0.012, 0.012, 9))
    depths: FloatArray = field(default_factory=lambda: np.arange(0.001, 0.0365, 0.001))
    heights: FloatArray = field(default_factory=lambda: np.arange(-0.03, 0.0601, 0.001))
    hiding: tuple[float, float] = (0.012, 0.030)
    uneven_most: float = 0.006
    bend_most: float = 0.004
    turn_most: float = math.radians(60.0)


SEARCH = RimSearch()


@dataclass(frozen=True, eq=False)
class Rim:
    """An edge of an organ that a jaw can grasp.

    Fields:
        place: a point on the edge (3,) [m]
        frame: columns are x along the edge, y outward, z up, normal to the side that hides (3, 3)
        thickness: opening of a jaw that grasps it to the least depth [m]
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


class OrganVoxels:
    """Voxels of edge `step` [m] inside an organ's boundary."""

    def __init__(self, mesh: TetMesh, step: float) -> None:
        """Voxelise the inside of a mesh's boundary."""
        self.step = step
        self._inside, self._first = voxels_inside(mesh.points, mesh.boundary_triangles.astype(np.int64), step)
        self._centres = (np.argwhere(self._inside) + self._first) * step
        self._tree = KDTree(self._centres)

    def contains(self, places: FloatArray) -> NDArray[np.bool_]:
        """True for points (..., 3) [m] in the organ (...,)."""
        index = np.rint(places / self.step).astype(np.int64) - self._first
        in_grid = np.logical_and(index >= 0, index < self._inside.shape).all(axis=-1)
        x, y, z = np.moveaxis(np.where(np.expand_dims(in_grid, -1), index, 0), -1, 0)
        return np.logical_and(in_grid, self._inside[x, y, z])

    def near(self, place: FloatArray, radius: float) -> FloatArray:
        """Vectors from a point (3,) [m] to the organ's voxels within a radius [m] (n, 3)."""
        return self._centres[self._tree.query_ball_point(place, radius)] - place

    def filled_share(self, places: FloatArray, radius: float) -> FloatArray:
        """Share of the organ in a ball of a radius [m] around each point (n, 3) (n,)."""
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
            height: samples along z [m], evenly spaced, (n_height,).

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
    """Most flexible edge of an organ that fits into a jaw, z towards `up` (3,) if possible; or the reason for none."""
    voxels, thinnest, rims = OrganVoxels(mesh, SEARCH.voxel), math.inf, list[Rim]()
    for place, frame in _edges(mesh, voxels, up):
        thickness = _thickness(voxels, place, frame)
        thinnest = min(thinnest, thickness)
        if thickness > SEARCH.jaw_opening - SEARCH.jaw_play:
            continue
        sides = (_rim(voxels, place, side, thickness) for side in (frame, frame * [-1.0, 1.0, -1.0]))
        rims += [rim for rim in sides if rim is not None]
    if not rims:
        return _no_rim(thinnest)
    upright = [rim for rim in rims if matmul(rim.frame[:, 2], up) >= float(cos(SEARCH.turn_most))]
    return min(upright or rims, key=lambda rim: rim.stiffness)


def _no_rim(thickness: float) -> str:
    """Reason for an organ without an edge to be lifted, from the opening that its thinnest edge needs [m]."""
    opening, play = SEARCH.jaw_opening, SEARCH.jaw_play
    jaw = f"the jaw opens {opening * 1e3:g} mm and needs {play * 1e3:g} mm of play"
    if thickness <= opening - play:
        return (
            f"an edge of {thickness * 1e3:.0f} mm fits the jaw ({jaw}), but none has an even side of "
            f"{np.ptp(SEARCH.along) * 1e3:.0f} x {np.ptp(SEARCH.hiding) * 1e3:.0f} mm behind it that could hide "
            "something"
        )
    if math.isinf(thickness):
        return f"this organ has no edge that is straight over the jaw's {SEARCH.pad_width * 1e3:g} mm; {jaw}"
    return (
        f"no edge is thin enough to be grasped {SEARCH.overlap * 1e3:g} mm deep: the thinnest is "
        f"{thickness * 1e3:.0f} mm thick, {jaw}"
    )


def _edges(mesh: TetMesh, voxels: OrganVoxels, up: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Points on edges with frames: y away from the organ nearby, z along its smallest extent, on the side of `up`."""
    places = mesh.points[mesh.boundary_nodes]
    sharp = np.flatnonzero(voxels.filled_share(places, SEARCH.ball) < SEARCH.filled_most)
    flexible = sharp[np.argsort(voxels.filled_share(places[sharp], SEARCH.ball_wide), kind="stable")]
    for place in places[flexible[: SEARCH.place_count]]:
        near = voxels.near(place, SEARCH.ball)
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
    """Opening of a jaw that grasps an edge to the least depth over its pads [m]; infinite if the edge bends."""
    depths = SEARCH.depths
    bottom, top = voxels.columns(place, frame, SEARCH.along, depths, SEARCH.heights)
    held = np.abs(SEARCH.along) <= 0.5 * SEARCH.pad_width + 1e-6
    border = depths[np.argmax(np.isfinite(bottom[held]), axis=1)]
    if not np.isfinite(bottom[held]).any(axis=1).all() or np.ptp(border) > SEARCH.bend_most:
        return math.inf
    # All tissue between the border and that depth must fit.
    within = depths <= border.min() + SEARCH.overlap + 1e-6
    return float(np.nanmax(top[held][:, within]) - np.nanmin(bottom[held][:, within]))


def _rim(voxels: OrganVoxels, place: FloatArray, frame: FloatArray, thickness: float) -> Rim | None:
    """The edge with its frame turned until the side below is level; None if that side is uneven or missing."""
    along, depths = SEARCH.along, SEARCH.depths
    hiding = (depths >= SEARCH.hiding[0]) & (depths <= SEARCH.hiding[1])
    x, depth = (part.ravel() for part in np.meshgrid(along, depths[hiding], indexing="ij"))
    level = turned = frame
    bottom, top = np.zeros(0), np.zeros(0)
    for _ in range(4):
        columns = voxels.columns(place, turned, along, depths, SEARCH.heights)
        bottom, top = (side[:, hiding].ravel() for side in columns)
        if not np.isfinite(bottom).all():
            return None
        _, sideways, inward = lstsq(np.stack([np.ones_like(x), x, depth], axis=1), bottom)
        level, turned = turned, _levelled(turned, matmul(turned, np.array([-sideways, inward, 1.0])))
    if np.ptp(bottom) > SEARCH.uneven_most:
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
