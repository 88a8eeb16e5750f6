"""The force and torque sensor at an arm's wrist: the load beyond it, the weight of what it carries taken off."""

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray

FORCE, TORQUE = "wrist_force", "wrist_torque"


class WristSensor:
    """MuJoCo's sensors `wrist_force` and `wrist_torque`, read as the load on everything beyond their site.

    MuJoCo gives the force and torque between the site's body and the link that carries it, in the site's frame and with
    the weight of all beyond it, whether that is compensated at the joints or not. A wrist that is tared knows that
    weight; what is left at rest is the load. In motion the inertia of the parts beyond the site is in it too.
    """

    def __init__(self, model: mujoco.MjModel, site: int) -> None:
        """Take a model with both sensors on a site."""
        self._model, self._site = model, site
        self._force = int(model.sensor(FORCE).adr[0])
        self._torque = int(model.sensor(TORQUE).adr[0])
        self._body = int(model.site_bodyid[site])

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "WristSensor | None":
        """The sensor of a model, or None where it has none."""
        names = {model.sensor(index).name for index in range(model.nsensor)}
        if not {FORCE, TORQUE} <= names:
            return None
        return cls(model, int(model.sensor(FORCE).objid[0]))

    def read(self, data: mujoco.MjData) -> FloatArray:
        """Load beyond the sensor as of the last step: force [N] and torque about its site [N m], world frame, (6,)."""
        rotation = data.site_xmat[self._site].reshape(3, 3)
        force = rotation @ data.sensordata[self._force : self._force + 3]
        torque = rotation @ data.sensordata[self._torque : self._torque + 3]
        weight = self._model.body_subtreemass[self._body] * self._model.opt.gravity
        arm = data.subtree_com[self._body] - data.site_xpos[self._site]
        return np.concatenate([-force - weight, -torque - np.cross(arm, weight)])
