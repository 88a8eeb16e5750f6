"""Prescribed motion of the ground of an organ, as in breathing: anchored nodes, foundations and supports.

A motion m displaces the ground at a place X by s_m(t) d_m(X). The caller sets its signal s_m and rate in the state;
kernels move the ground in each substep and count its work. Damping by mass (alpha) acts on velocities relative to the
ground, as the tissue around an organ moves with it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.errors import OrganError, require_distinct
from msdm_core.kernels.structure_kernels import OrganModel, OrganState
from msdm_core.mesh.tet_mesh import FloatArray

# Columns of `OrganState.motion`.
SIGNAL, RATE, RATE_BEFORE, WORK = range(4)

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """A motion of the ground, per unit of its signal.

    Args:
        name: used in messages.
        displacement: largest d_m [m].
        centre: of the moving part [m]; None if all of the ground moves alike.
        reach: radius of the moving part [m]: d_m falls as (1 - r^2 / reach^2)^2.
    """

    name: str
    displacement: Vector
    centre: Vector | None = None
    reach: float = math.inf

    def __post_init__(self) -> None:
        for entry in ("displacement", "centre"):
            value = getattr(self, entry)
            if value is not None and (len(value) != 3 or not all(math.isfinite(number) for number in value)):
                raise OrganError(f"motion {self.name!r}: {entry} is {value}; it must be 3 finite numbers [m]")
        if not self.reach > 0.0:
            raise OrganError(f"motion {self.name!r}: reach is {self.reach:g} m; it must be above 0")
        if (self.centre is None) != math.isinf(self.reach):
            raise OrganError(
                f"motion {self.name!r}: centre is {self.centre}, reach {self.reach:g} m; give both for a part of the "
                "ground, neither for all of it"
            )

    def shift(self, points: ArrayLike) -> FloatArray:
        """Displacement of the ground at points [m] (n, 3) per unit of the signal [m], (n, 3)."""
        places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        share = np.ones(len(places))
        if self.centre is not None:
            share = np.square(
                np.maximum(1.0 - np.square(places - np.array(self.centre)).sum(axis=1) / np.square(self.reach), 0.0)
            )
        return share[:, None] * np.array(self.displacement)


def motion_fields(
    motions: Sequence[Motion],
    points: FloatArray,
    anchored: NDArray[np.bool_],
    foundation_nodes: ArrayLike,
    support_position: FloatArray,
) -> dict[str, Any]:
    """Fields of an OrganModel for the motions of its ground.

    Args:
        motions: of the ground.
        points: rest positions of the nodes [m], shape (n_node, 3).
        anchored: True for the nodes held fixed, shape (n_node,).
        foundation_nodes: nodes on foundations, shape (n_held,).
        support_position: of the supports [m], shape (n_support, 3).

    Raises:
        OrganError: two motions of one name.
    """
    require_distinct("motions", [motion.name for motion in motions])
    places = {
        "motion_node_shift": points,
        "motion_foundation_shift": points[np.asarray(foundation_nodes)],
        "motion_support_shift": support_position,
    }
    fields: dict[str, Any] = {
        field: np.array([motion.shift(origin) for motion in motions]).reshape(len(motions), len(origin), 3)
        for field, origin in places.items()
    }
    fields["motion_node_shift"] = np.pad(fields["motion_node_shift"], ((0, 0), (0, 0), (0, 1)))
    fields["motion_anchored_nodes"] = np.flatnonzero(anchored if motions else False)
    return fields


def place_on_ground(model: OrganModel, state: OrganState, signal: ArrayLike, rate: ArrayLike) -> None:
    """Move an organ at rest with its ground to signals (n_motion,), at their rates (n_motion,) [1/s].

    All nodes move with the ground: exact for a ground that moves alike everywhere and evenly.
    """
    state.motion[:, SIGNAL] = signal
    state.motion[:, RATE] = state.motion[:, RATE_BEFORE] = rate
    shift = model.motion_node_shift[:, :, :3]
    state.node_position[:] += (state.motion[:, SIGNAL, None, None] * shift).sum(axis=0)
    state.node_velocity[:] += (state.motion[:, RATE, None, None] * shift).sum(axis=0)
