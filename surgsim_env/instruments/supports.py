"""Supports of an organ as fixed geoms of an instrument's MuJoCo model, for contact with tools and for pictures."""

from collections.abc import Sequence

import mujoco

from msdm_core.organ.support import Support
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP

SUPPORT_PREFIX = "support_"
# Bit of the contact masks by which supports meet the tools' contact geoms, and nothing else.
SUPPORT_BIT = 2
# As soft as cloth over a soft base: 1500 N/m for a tool of 0.1 kg, more for a heavier one, critically damped.
# MuJoCo's negative solref [1/s^2, 1/s] gives a contact of impedance 1/2 a stiffness of 2 x 7500 N/m per kilogram of
# the tool.
SOLREF = (-7500.0, -173.0)
SOLIMP = (0.5, 0.5, 0.001, 0.5, 2.0)
COLOUR = (0.125, 0.335, 0.375, 1.0)
_GEOMS = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}


def add_supports(spec: mujoco.MjSpec, supports: Sequence[Support]) -> None:
    """Add supports to a model's world as geoms `support_NAME`, in the scene's frame; its tools then meet them.

    Without supports nothing changes. Call it after every geom has its group and the world its final frame.
    """
    if not supports:
        return
    # A pyramidal friction cone would make the contact 1 / mu^2 times as stiff.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    for geom in spec.geoms:
        if geom.group == CONTACT_GROUP:
            geom.conaffinity |= SUPPORT_BIT
    for support in supports:
        spec.worldbody.add_geom(
            name=SUPPORT_PREFIX + support.name,
            type=_GEOMS[support.kind],
            pos=support.position,
            quat=support.quaternion,
            # Half sizes of 0 draw an infinite plane.
            size=(*support.size, 0.0, 0.0, 0.0)[:3] if support.kind != "plane" else (0.0, 0.0, 0.05),
            friction=(support.friction, 0.005, 0.0001),
            contype=SUPPORT_BIT,
            conaffinity=0,
            # The contact parameters of the support apply, not those of the tool.
            priority=1,
            condim=3,
            solref=SOLREF,
            solimp=SOLIMP,
            rgba=COLOUR,
        )
