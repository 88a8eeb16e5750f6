"""Cameras of a scene, derived from the organ, its palpable face and the direction of the instrument."""

import math
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.model import Endoscope
from surgsim_env.scene.palpable_surface import tangent_axes

# Share of the overview's picture filled by the organ, and height of the aim above its middle, as a share of
# half the height.
OVERVIEW_FOV, OVERVIEW_SHARE, OVERVIEW_SHIFT = 32.0, 0.72, 0.2
# The organ lies within this share of half that picture's height.
EDGE = 0.96
# Elevation and azimuth of the overview [degrees].
OVERVIEW_HEIGHT, OVERVIEW_SIDE = 32.0, 28.0
# Elevation of the side view [degrees], and height of its aim, as for the overview.
SIDE_HEIGHT, SIDE_SHIFT = 10.0, 0.25
# Angle of the endoscope to the palpable face [degrees]; its distance is the face's width within bounds [m].
ENDOSCOPE_FOV, ENDOSCOPE_TILT = 60.0, 38.0
ENDOSCOPE_DISTANCES = (0.10, 0.20)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Fields:
        position, target: the pinhole, and the point in the middle of the picture [m] (3,) each
        up: unit vector, upright in the picture                                     (3,)
        rotation: columns are the picture's right, its up and the way back          (3, 3)
        fov: vertical field of view [degrees]                                       scalar
    """

    position: FloatArray
    target: FloatArray
    up: FloatArray
    rotation: FloatArray
    fov: float

    @classmethod
    def looking(cls, position: FloatArray, target: FloatArray, up: FloatArray, fov: float) -> "Camera":
        """Camera at a position, aimed at a target [m], with `up` upright in the picture."""
        back = (position - target) / np.linalg.norm(position - target)
        right = cross(up, back)
        if np.linalg.norm(right) < 1e-6:
            # The view is along `up`: any other upright direction will do.
            right, _ = tangent_axes(back)
        right /= np.linalg.norm(right)
        return cls(position, target, up, np.column_stack([right, cross(back, right), back]), fov)

    def sees_above_level(self) -> bool:
        """True if some ray of the picture passes above the drape, so that background is seen."""
        climb = math.degrees(math.asin(float(np.clip(-self.rotation[:, 2] @ self.up, -1.0, 1.0))))
        return climb + 0.5 * self.fov > -1.0

    def project(self, points: FloatArray, width: int, height: int) -> tuple[FloatArray, FloatArray]:
        """Column and row of points (n, 3) in a picture [pixels] (n, 2), and their depth along the view [m] (n,)."""
        x, y, z = ((points - self.position) @ self.rotation).T
        focal = 0.5 * height / math.tan(math.radians(0.5 * self.fov))
        return np.column_stack([0.5 * width - focal * x / z, 0.5 * height + focal * y / z]), -z


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross product of two vectors (3,); ten times as fast as numpy's."""
    (a, b, c), (d, e, f) = first.tolist(), second.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def scene_cameras(anatomy: Anatomy, aspect: float = 4.0 / 3.0) -> dict[str, Camera]:
    """Cameras of a scene by their names in `options.CAMERAS`, for an aspect ratio (width over height)."""
    points = anatomy.mesh.points
    up = -anatomy.downward
    across, along = tangent_axes(anatomy.downward)
    front, place = cut_direction(anatomy), anatomy.scene.endoscope
    return {
        "overview": _framing(points, _raised(front, up, OVERVIEW_HEIGHT), up, aspect, OVERVIEW_SHIFT),
        "endoscope": _endoscope(anatomy, _raised(-along, up, 90.0 - ENDOSCOPE_TILT), up)
        if place is None
        else placed_endoscope(anatomy, place),
        "side": _framing(points, _raised(across, up, SIDE_HEIGHT), up, aspect, SIDE_SHIFT),
        "above": _framing(points, up, along, aspect, 0.0),
    }


def cut_direction(anatomy: Anatomy) -> FloatArray:
    """Horizontal unit direction towards the overview camera, normal to the cut of a cut-open organ, shape (3,)."""
    across, along = tangent_axes(anatomy.downward)
    side = math.radians(OVERVIEW_SIDE)
    return across * math.sin(side) - along * math.cos(side)


def _framing(points: FloatArray, direction: FloatArray, up: FloatArray, aspect: float, shift: float) -> Camera:
    """Camera in a direction with all points in the middle OVERVIEW_SHARE of the picture.

    The aim is above their middle by a share of the picture's height: room for an instrument.
    """
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    camera = Camera.looking(middle + direction, middle, up, OVERVIEW_FOV)
    seen = (points - middle) @ camera.rotation
    offset = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * [1.0, 1.0, 0.0]
    middle, seen = middle + camera.rotation @ offset, seen - offset
    half = math.tan(math.radians(0.5 * OVERVIEW_FOV))
    room = OVERVIEW_SHARE * half * np.array([aspect, 1.0])
    distance = float((np.abs(seen[:, :2]) / room + seen[:, 2:]).max())
    # Aimed higher, the picture still has to contain the lower edge.
    lowest = (EDGE * seen[:, 2] - seen[:, 1] / half) / (EDGE - shift)
    distance = max(distance, float(lowest.max()))
    target = middle + camera.rotation[:, 1] * shift * half * distance
    return Camera.looking(target + distance * camera.rotation[:, 2], target, up, OVERVIEW_FOV)


def _raised(level: FloatArray, up: FloatArray, angle: float) -> FloatArray:
    """Horizontal unit direction raised by an angle [degrees]."""
    return level * math.cos(math.radians(angle)) + up * math.sin(math.radians(angle))


def placed_endoscope(anatomy: Anatomy, place: Endoscope) -> Camera:
    """Upright camera of an endoscope with a given pose."""
    up = -anatomy.downward
    return Camera.looking(np.asarray(place.position), np.asarray(place.target), up, place.fov_deg)


def _endoscope(anatomy: Anatomy, direction: FloatArray, up: FloatArray) -> Camera:
    """Camera in a direction from the palpable face, at the face's width from it, within ENDOSCOPE_DISTANCES."""
    face = anatomy.mesh.points[np.unique(anatomy.face.triangles)]
    middle = 0.5 * (face.min(axis=0) + face.max(axis=0))
    seen = (face - middle) @ Camera.looking(middle + direction, middle, up, ENDOSCOPE_FOV).rotation
    distance = float(np.clip(np.ptp(seen[:, :2], axis=0).max(), *ENDOSCOPE_DISTANCES))
    target, _ = anatomy.face.project(middle)
    return Camera.looking(target + distance * direction, target, up, ENDOSCOPE_FOV)
