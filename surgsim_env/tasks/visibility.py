"""Visibility of a target past an organ's surface and an instrument: rays to points, no picture."""

import math
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import cos, matmul, norm, sin
from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP
from surgsim_env.scene.palpable_surface import tangent_axes
from surgsim_env.tasks.visibility_kernels import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    PLANE,
    SPHERE,
    hide_behind_shapes,
    hide_behind_triangles,
)

# Sampled points of a disc: enough for a share to be right to about half a percent.
POINT_COUNT = 500
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Disc:
    """A flat disc: centre [m] (3,), unit normal (3,) and radius [m]."""

    centre: FloatArray
    normal: FloatArray
    radius: float

    def moved(self, shift: FloatArray) -> "Disc":
        """The disc elsewhere, by a shift [m] (3,)."""
        return replace(self, centre=self.centre + shift)

    @property
    def rotation(self) -> FloatArray:
        """Columns are two unit vectors along the disc and its normal, shape (3, 3)."""
        across, _ = tangent_axes(self.normal)
        return np.stack([across, np.cross(self.normal, across), self.normal], axis=1)

    def points(self) -> FloatArray:
        """Points spread evenly over the disc as a sunflower's seeds are [m], shape (POINT_COUNT, 3).

        Each stands for an equal part of the disc's area, not of its projection in a picture.
        """
        index = np.arange(POINT_COUNT)
        distance = self.radius * np.sqrt((index + 0.5) / POINT_COUNT)
        angle = index * GOLDEN_ANGLE
        level = np.stack([distance * cos(angle), distance * sin(angle)])
        return self.centre + matmul(self.rotation[:, :2], level).T


def hiding_geoms(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Opaque shapes of an instrument's model: primitives that are visible or touch tissue.

    Meshes count by their contact shapes.
    """
    solid = np.isin(model.geom_type, (PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX))
    seen = (model.geom_group < CONTACT_GROUP) & (model.geom_rgba[:, 3] > 0.0)
    return np.flatnonzero(solid & (seen | (model.geom_group == CONTACT_GROUP)))


def visible(
    eye: FloatArray,
    points: FloatArray,
    node_position: FloatArray,
    triangles: IntArray,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geoms: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Visibility of points from an eye.

    Args:
        eye: position of the camera [m], (3,).
        points: of the target [m], (n, 3).
        node_position: of the organ's deformed nodes [m], (n_node, 3).
        triangles: of its whole surface, (m, 3).
        model: an instrument's.
        data: of the same model, poses up to date.
        geoms: opaque shapes of the model, see `hiding_geoms`.

    Returns:
        True for each point with a free line of sight, shape (n,).
    """
    hidden, cone = _hidden_by(eye, points, node_position, triangles)
    hide_behind_shapes(
        *cone, geoms, model.geom_type, model.geom_size, model.geom_rbound, data.geom_xpos, data.geom_xmat,
        np.zeros(3), hidden,
    )  # fmt: skip
    return hidden == 0


def uncovered(eye: FloatArray, points: FloatArray, node_position: FloatArray, triangles: IntArray) -> NDArray[np.bool_]:
    """Visibility of points from an eye past triangles alone; arguments and result as those of `visible`."""
    return _hidden_by(eye, points, node_position, triangles)[0] == 0


def _hidden_by(
    eye: FloatArray, points: FloatArray, node_position: FloatArray, triangles: IntArray
) -> tuple[NDArray[np.uint8], tuple[FloatArray, FloatArray, FloatArray, float, float, float]]:
    """1 for each point hidden by triangles, (n,), and the kernels' cone from the eye around the points."""
    rays = points - eye
    middle = rays.mean(axis=0)
    distances = norm(rays, axis=1)
    cosine = float((matmul(rays, middle) / (distances * norm(middle))).min())
    axis, sine = middle / norm(middle), math.sqrt(max(1.0 - cosine * cosine, 0.0))
    hidden = np.zeros(len(points), dtype=np.uint8)
    cone = (np.asarray(eye, dtype=np.float64), points, axis, cosine, sine, float(distances.max()))
    hide_behind_triangles(*cone, node_position, triangles, hidden)
    return hidden, cone
