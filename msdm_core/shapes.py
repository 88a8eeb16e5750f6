"""Making contact shapes: balls, capsules and rounded boxes that tools carry."""

import numpy as np
from numpy.typing import ArrayLike

from msdm_core.kernels import ContactShapes
from msdm_core.mesh import FloatArray


def round_shapes(
    ends: ArrayLike,
    radius: ArrayLike,
    *,
    span: ArrayLike | None = None,
    friction: ArrayLike = 1.0,
    tool: ArrayLike | None = None,
    centre: ArrayLike | None = None,
    twist: ArrayLike | None = None,
) -> ContactShapes:
    """Contact shapes, each all within its radius of its core: two ends alike make a ball, a span a rounded box.

    Args:
        ends: of each core's axis [m], (n_shape, 2, 3).
        radius: [m], (n_shape,).
        span: from the axis to the border of a rounded box's core, square to the axis [m], (n_shape, 3); none for all.
        friction: Coulomb coefficient over the contact law's, (n_shape,) or one for all.
        tool: which tool carries each shape, (n_shape,); the first carries all.
        centre: each tool's centre of mass [m], (n_tool, 3); the middle of the first shape it carries.
        twist: of each tool [m/s, rad/s], (n_tool, 6); at rest.
    """
    axes = np.array(ends, dtype=np.float64).reshape(-1, 2, 3)
    count = len(axes)
    carrier = np.zeros(count, dtype=np.int32) if tool is None else np.array(tool, dtype=np.int32)
    if centre is None:
        tools, first = np.unique(carrier, return_index=True)
        centre = axes[first].mean(axis=1).reshape(len(tools), 3)
    centres: FloatArray = np.array(centre, dtype=np.float64).reshape(-1, 3)
    return ContactShapes(
        shape_ends=axes,
        shape_radius=np.array(radius, dtype=np.float64).reshape(count),
        shape_tool=carrier,
        tool_centre=centres,
        tool_twist=np.zeros((len(centres), 6)) if twist is None else np.array(twist, dtype=np.float64).reshape(-1, 6),
        shape_span=np.zeros((count, 3)) if span is None else np.array(span, dtype=np.float64).reshape(count, 3),
        shape_friction=np.broadcast_to(np.asarray(friction, dtype=np.float64), (count,)).copy(),
    )
