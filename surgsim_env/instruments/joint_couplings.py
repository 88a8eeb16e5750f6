"""Couplings of joints in a MuJoCo model (`<mimic>` of URDF, `<equality><joint>` of MJCF), and joints that follow others.

MuJoCo couples the values of two joints, measured from those of the model, q_f = c_0 + c_1 q_l + ... + c_4 q_l^4. A
joint that follows a driven one by c_0 and c_1 alone has the value offset + slope * driver.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray

# Largest difference of a joint's values by two couplings [rad or m].
COUPLING_TOLERANCE = 1e-6


class JointCoupling(NamedTuple):
    """A coupling: indices of the two joints, -1 for a leader that there is not, and c_0 to c_4."""

    follower: int
    leader: int
    coefficients: FloatArray

    @property
    def linear(self) -> bool:
        """True without terms of a higher order."""
        return not self.coefficients[2:].any()


class JointValue(NamedTuple):
    """A joint's value [rad or m], offset + slope times that of the joint `driver`; a constant has the slope 0."""

    driver: int
    slope: float
    offset: float

    def mapped(self, slope: float, offset: float) -> "JointValue":
        """The value offset + slope times this one."""
        return JointValue(self.driver, slope * self.slope, offset + slope * self.offset)


def joint_couplings(model: mujoco.MjModel) -> list[JointCoupling]:
    """Active couplings of a model's joints."""
    active = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 != 0))
    return [
        JointCoupling(int(model.eq_obj1id[index]), int(model.eq_obj2id[index]), model.eq_data[index, :5].copy())
        for index in active
    ]


def leaders_of(model: mujoco.MjModel, joint: int) -> list[int]:
    """A joint, the joint that it follows, and so on; a circle ends where it closes."""
    leader_of = {coupling.follower: coupling.leader for coupling in joint_couplings(model)}
    trail = []
    while joint >= 0 and joint not in trail:
        trail.append(joint)
        joint = leader_of.get(joint, -1)
    return trail


def coupled_values(
    model: mujoco.MjModel, driven: Sequence[int], fixed: Mapping[int, float] | None = None
) -> dict[int, JointValue]:
    """Values of the joints that couplings determine, as functions of driven joints, these included.

    A leader is determined by its follower too. A polynomial is evaluated where its leader is constant.

    Args:
        model: with the couplings.
        driven: indices of driven joints.
        fixed: constant values of other joints [rad or m].

    Raises:
        ValueError: a coupling that contradicts others, or couples two driven joints.
    """
    values = {joint: JointValue(joint, 1.0, 0.0) for joint in driven}
    values |= {joint: JointValue(joint, 0.0, value) for joint, value in (fixed or {}).items()}
    left = joint_couplings(model)
    while True:
        open_ones = [coupling for coupling in left if not _apply(model, coupling, values)]
        if len(open_ones) == len(left):
            return values
        left = open_ones


def _apply(model: mujoco.MjModel, coupling: JointCoupling, values: dict[int, JointValue]) -> bool:
    """Add the value that a coupling determines, or compare it; False while it determines none."""
    follower, leader, terms = coupling
    start = model.qpos0[model.jnt_qposadr[follower]]
    before = values.get(leader)
    if not terms[1:].any():
        value = JointValue(follower, 0.0, float(start + terms[0]))
    elif before is not None and (coupling.linear or before.slope == 0.0):
        led = before.mapped(1.0, -float(model.qpos0[model.jnt_qposadr[leader]]))
        if coupling.linear:
            value = led.mapped(float(terms[1]), float(start + terms[0]))
        else:
            value = JointValue(leader, 0.0, float(start + np.polynomial.polynomial.polyval(led.offset, terms)))
    elif before is None and follower in values and coupling.linear:
        origin = float(model.qpos0[model.jnt_qposadr[leader]])
        slope = 1.0 / float(terms[1])
        values[leader] = values[follower].mapped(slope, origin - slope * float(start + terms[0]))
        return True
    else:
        return False
    known = values.setdefault(follower, value)
    far = max(abs(known.slope - value.slope), abs(known.offset - value.offset))
    if far > COUPLING_TOLERANCE or (known.slope != 0.0 and known.driver != value.driver):
        name, other = model.joint(follower).name, model.joint(leader).name if leader >= 0 else "a constant"
        raise ValueError(
            f"joint {name!r} follows {other!r} in the model, so that it can neither be driven nor follow another rule: "
            "take it out of joints, home and control, or change the coupling in the model"
        )
    return True


class Followers(NamedTuple):
    """Joints that follow driven ones, with values offset + slope * driven[driver].

    Fields:
        joints: their indices in the model                  (k,)
        driver: indices among the driven joints             (k,)
        slope: [1, or rad/m, m/rad]                         (k,)
        offset: [rad or m]                                  (k,)
    """

    joints: np.ndarray
    driver: np.ndarray
    slope: FloatArray
    offset: FloatArray

    def values(self, driven: FloatArray) -> FloatArray:
        """Their values at driven joints' values (..., n) [rad or m], shape (..., k)."""
        return self.offset + self.slope * driven[..., self.driver]

    def narrowed(self, lower: FloatArray, upper: FloatArray, least: FloatArray, most: FloatArray) -> FloatArray:
        """The part of the driven joints' limits (n,) that keeps followers within theirs (k,), shape (n, 2)."""
        limits = np.stack([lower, upper], axis=1)
        for driver, slope, offset, low, high in zip(self.driver, self.slope, self.offset, least, most, strict=True):
            if slope != 0.0:
                first, last = sorted(((low - offset) / slope, (high - offset) / slope))
                limits[driver] = max(limits[driver, 0], first), min(limits[driver, 1], last)
        return limits


def followers_of(model: mujoco.MjModel, driven: Sequence[int]) -> Followers:
    """The joints of a model that follow driven ones.

    Raises:
        ValueError: a coupling that contradicts others, or couples two driven joints.
    """
    place = {joint: index for index, joint in enumerate(driven)}
    values = {joint: value for joint, value in coupled_values(model, driven).items() if joint not in place}
    return Followers(
        np.array(list(values), dtype=np.int64),
        np.array([place.get(value.driver, 0) for value in values.values()], dtype=np.int64),
        np.array([value.slope for value in values.values()]),
        np.array([value.offset for value in values.values()]),
    )


def narrowed_limits(model: mujoco.MjModel, driven: Sequence[int], limits: FloatArray) -> FloatArray:
    """Limits of driven joints [rad or m] within which their followers keep their own limits, both (n, 2).

    Raises:
        ValueError: a joint that its followers leave no range.
    """
    followers = followers_of(model, driven)
    limited = model.jnt_limited[followers.joints].astype(bool)
    least, most = np.where(limited[:, None], model.jnt_range[followers.joints], [-np.inf, np.inf]).T
    narrow = followers.narrowed(*limits.T, least, most)
    for index, (low, high) in enumerate(narrow):
        if not low < high:
            names = [model.joint(int(joint)).name for joint in followers.joints[followers.driver == index]]
            raise ValueError(
                f"joint {model.joint(driven[index]).name!r} has no range within the limits of the joints that follow "
                f"it ({', '.join(names)}): {low:g} to {high:g}; change these limits or the couplings"
            )
    return narrow
