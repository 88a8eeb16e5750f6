"""Occlusion of points by triangles of a surface and MuJoCo's primitive shapes, ray by ray."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from msdm_core.kernels.option_kernels import INNER, KERNEL
from msdm_core.kernels.ray_kernels import ray_hit
from msdm_core.kernels.space_kernels import edge, minus, row_of, scalar_product

FloatArray = NDArray[np.float64]

# MuJoCo's mjtGeom of the opaque shapes.
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = 0, 2, 3, 4, 5, 6


@njit(cache=True, error_model="numpy", inline="always")
def _near_cone(x, y, z, radius, eye, axis, cosine, sine, reach):
    """True if a ball comes into the cone from an eye along a unit axis, no farther than `reach` [m]."""
    x, y, z = x - eye[0], y - eye[1], z - eye[2]
    along = x * axis[0] + y * axis[1] + z * axis[2]
    if along < -radius or along > reach + radius:
        return False
    across = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
    return across * cosine - along * sine <= radius


@njit(**KERNEL)
def hide_behind_triangles(eye, points, axis, cosine, sine, reach, position, triangles, hidden):
    """Mark the points hidden from the eye by a triangle.

    In:  eye [m] (3,), points [m] (n, 3), the cone from the eye around them: unit axis (3,), cosine and sine of
         its half angle, reach [m]; position of nodes [m] (n_node, 3), triangles (m, 3)
    Out: hidden (n,): 1 for a hidden point
    """
    for triangle in range(triangles.shape[0]):
        a, b, c = row_of(triangles, triangle)
        first, ab, ac = row_of(position, a), edge(position, a, b), edge(position, a, c)
        # Radius of a ball about corner a around the triangle.
        size = math.sqrt(max(scalar_product(ab, ab), scalar_product(ac, ac)))
        if not _near_cone(first[0], first[1], first[2], size, eye, axis, cosine, sine, reach):
            continue
        from_a = minus(eye, first)
        for point in range(points.shape[0]):
            if hidden[point]:
                continue
            if 0.0 < ray_hit(from_a, minus(row_of(points, point), eye), ab, ac) < 1.0:
                hidden[point] = 1


@njit(**INNER)
def _meets_ball(x, y, z, dx, dy, dz):
    """True if the segment from (x, y, z) by (dx, dy, dz) meets the unit ball."""
    a = dx * dx + dy * dy + dz * dz
    b = x * dx + y * dy + z * dz
    square = b * b - a * (x * x + y * y + z * z - 1.0)
    if square < 0.0:
        return False
    root = math.sqrt(square)
    return -b - root < a and -b + root > 0.0


@njit(**INNER)
def _meets_slabs(x, y, z, dx, dy, dz, size, first, low, high):
    """True if the part from `low` to `high` of a segment meets the slabs |coordinate| < size, from axis `first` on."""
    for axis in range(first, 3):
        start = x if axis == 0 else (y if axis == 1 else z)
        way = dx if axis == 0 else (dy if axis == 1 else dz)
        if way == 0.0:
            if abs(start) > size[axis]:
                return False
            continue
        near, far = (-size[axis] - start) / way, (size[axis] - start) / way
        low, high = max(low, min(near, far)), min(high, max(near, far))
    return low < high


@njit(**INNER)
def _meets_cylinder(x, y, z, dx, dy, dz, radius, half_length, limits):
    """True if a segment meets the cylinder about z; `limits` (3,) is scratch."""
    a = dx * dx + dy * dy
    b = x * dx + y * dy
    c = x * x + y * y - radius * radius
    low, high = 0.0, 1.0
    if a == 0.0:
        if c > 0.0:
            return False
    else:
        square = b * b - a * c
        if square < 0.0:
            return False
        root = math.sqrt(square)
        low, high = max(low, (-b - root) / a), min(high, (-b + root) / a)
    limits[2] = half_length
    return _meets_slabs(x, y, z, dx, dy, dz, limits, 2, low, high)


@njit(**INNER)
def _meets_shape(kind, size, x, y, z, dx, dy, dz, limits):
    """True if a segment, in the shape's own frame, meets one of MuJoCo's shapes."""
    if kind == PLANE:
        return z * (z + dz) < 0.0
    if kind == BOX:
        return _meets_slabs(x, y, z, dx, dy, dz, size, 0, 0.0, 1.0)
    r = size[0]
    if kind == SPHERE:
        return _meets_ball(x / r, y / r, z / r, dx / r, dy / r, dz / r)
    if kind == ELLIPSOID:
        return _meets_ball(x / r, y / size[1], z / size[2], dx / r, dy / size[1], dz / size[2])
    if _meets_cylinder(x, y, z, dx, dy, dz, r, size[1], limits):
        return True
    if kind == CYLINDER:
        return False
    low, high = (z - size[1]) / r, (z + size[1]) / r
    return _meets_ball(x / r, y / r, low, dx / r, dy / r, dz / r) or _meets_ball(
        x / r, y / r, high, dx / r, dy / r, dz / r
    )


@njit(**KERNEL)
def hide_behind_shapes(
    eye, points, axis, cosine, sine, reach, geoms, kind, size, ball, position, rotation, limits, hidden
):
    """Mark the points hidden from the eye by a MuJoCo shape.

    In:  eye to reach: as in `hide_behind_triangles`; geoms: opaque shapes of the model; geom_type (n_geom,),
         geom_size (n_geom, 3), geom_rbound (n_geom,), geom_xpos (n_geom, 3), geom_xmat (n_geom, 9)
    Out: hidden (n,): 1 for a hidden point; scratch: limits (3,)
    """
    for place in range(geoms.shape[0]):
        geom = geoms[place]
        centre = position[geom]
        bounded = kind[geom] != PLANE
        if bounded and not _near_cone(
            centre[0], centre[1], centre[2], ball[geom], eye, axis, cosine, sine, reach
        ):  # fmt: skip
            continue
        turn = rotation[geom]
        x, y, z = eye[0] - centre[0], eye[1] - centre[1], eye[2] - centre[2]
        ex = turn[0] * x + turn[3] * y + turn[6] * z
        ey = turn[1] * x + turn[4] * y + turn[7] * z
        ez = turn[2] * x + turn[5] * y + turn[8] * z
        for point in range(points.shape[0]):
            if hidden[point]:
                continue
            x, y, z = points[point, 0] - eye[0], points[point, 1] - eye[1], points[point, 2] - eye[2]
            dx = turn[0] * x + turn[3] * y + turn[6] * z
            dy = turn[1] * x + turn[4] * y + turn[7] * z
            dz = turn[2] * x + turn[5] * y + turn[8] * z
            if _meets_shape(kind[geom], size[geom], ex, ey, ez, dx, dy, dz, limits):
                hidden[point] = 1
