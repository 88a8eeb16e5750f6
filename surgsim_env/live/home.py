"""Initial positions of the tips of a live session: in front of the organ, visible, without contact."""

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.arm.arm_instrument import ArmInstrument
from surgsim_env.instruments.arm.pair import Pair
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP
from surgsim_env.scene.anatomy import Anatomy

# Initial distance of a tip on slides from the organ, and smallest distance of any contact shape [m].
HOME_GAP, SHAPE_GAP = 0.015, 0.004


def home_of(anatomy: Anatomy, instrument: Instrument) -> FloatArray:
    """Initial tip positions [m], (3,) or (2, 3): over the middle of the palpable face, or where an arm parks.

    Farther away if an open jaw, which reaches beyond its tip, would touch. `instrument` is parked and is not moved.
    """
    face = anatomy.face
    if isinstance(instrument, ArmInstrument | Pair):
        place = instrument.parked
    else:
        corners = face.points[face.triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        point, normal = face.project(np.average(corners.mean(axis=1), axis=0, weights=area))
        place = point + normal * (anatomy.scene.instrument.tip_radius + HOME_GAP)
    missing = SHAPE_GAP - _clearance(anatomy, instrument, (place - instrument.parked).reshape(-1, 3)[0])
    return np.clip(place - max(0.0, missing) * face.approach, instrument.lower, instrument.upper)


def _clearance(anatomy: Anatomy, instrument: Instrument, shift: FloatArray) -> float:
    """Smallest distance [m] of a parked instrument, shifted by [m] (3,), from the organ along the approach."""
    model, data, face = instrument.model, instrument.data, anatomy.face
    out, gaps = -face.approach, []
    for geom in np.flatnonzero((model.geom_group == CONTACT_GROUP) & (model.geom_bodyid != 0)):
        turn = data.geom_xmat[geom].reshape(3, 3)
        centre = data.geom_xpos[geom] + turn @ model.geom_aabb[geom, :3] + shift
        half = float(np.abs(out @ turn) @ model.geom_aabb[geom, 3:])
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            half = float(model.geom_size[geom, 0])
        gaps.append(float((centre - face.project(centre)[0]) @ out) - half)
    return min(gaps)
