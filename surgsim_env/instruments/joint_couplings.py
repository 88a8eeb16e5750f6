"""Joints of a MuJoCo model that follow others: `<mimic>` of URDF, `<equality><joint>` of MJCF.

A coupling is q = sum_k c_k q_l^k, with the values of both joints measured from the model's initial ones. The leader may
follow another joint in turn, up to a root; on the way from there to the tip of an arm all couplings are linear.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray


class JointCoupling(NamedTuple):
    """A coupling: indices of the two joints, -1 for a constant in place of a leader, and c_0 to c_4 (5,)."""

    follower: int
    leader: int
    terms: FloatArray


class JointValue(NamedTuple):
    """A joint's value by that of its root, offset + slope * root [rad or m]."""

    root: int
    slope: float
    offset: float


class Followers(NamedTuple):
    """Joints that follow driven ones, with the values offset + slope * driven[driver].

    Fields:
        joints: their indices in the model                  (k,)
        driver: indices among the driven joints             (k,)
        slope: [1, rad/m or m/rad]                          (k,)
        offset: [rad or m]                                  (k,)
    """

    joints: NDArray[np.int64]
    driver: NDArray[np.int64]
    slope: FloatArray
    offset: FloatArray

    def values(self, driven: FloatArray) -> FloatArray:
        """Their values at values of the driven joints (..., n) [rad or m], shape (..., k)."""
        return self.offset + self.slope * driven[..., self.driver]


def joint_couplings(model: mujoco.MjModel) -> list[JointCoupling]:
    """Active couplings of a model's joints."""
    active = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 != 0))
    return [JointCoupling(int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5]) for e in active]


def couplings_to_root(model: mujoco.MjModel, joint: int) -> list[JointCoupling]:
    """Couplings from a joint to its leader, from there to the next, and so on.

    Raises:
        ValueError: a joint that follows two joints, or itself.
    """
    couplings: list[JointCoupling] = []
    while own := [coupling for coupling in joint_couplings(model) if coupling.follower == joint]:
        if len(own) > 1 or joint in [coupling.follower for coupling in couplings]:
            raise ValueError(
                f"joint {model.joint(joint).name!r} follows {'two joints' if len(own) > 1 else 'itself in a circle'}: "
                "leave it one coupling, to a joint that does not follow it"
            )
        couplings.extend(own)
        joint = own[0].leader
    return couplings


def joint_value(model: mujoco.MjModel, joint: int) -> JointValue:
    """A joint's value by that of its root, which is the joint itself without a coupling.

    Raises:
        ValueError: a polynomial coupling, or those of `couplings_to_root`.
    """
    couplings = couplings_to_root(model, joint)
    for follower, leader, terms in couplings:
        if terms[2:].any():
            raise ValueError(
                f"joint {model.joint(follower).name!r} follows {model.joint(leader).name!r} by the polynomial "
                f"{terms.tolist()}; in an arm it follows by the first two numbers: set the others to 0 in the model"
            )
    offset = coupled_value(model, couplings, 0.0)
    slope = coupled_value(model, couplings, 1.0) - offset
    return JointValue(couplings[-1].leader if couplings else joint, slope, offset)


def coupled_value(model: mujoco.MjModel, couplings: Sequence[JointCoupling], value: float) -> float:
    """Value of a joint by its couplings to the root, at a value of that [rad or m]."""
    initial = model.qpos0[model.jnt_qposadr]
    for follower, leader, terms in reversed(couplings):
        led = value - initial[leader] if leader >= 0 else 0.0
        value = float(initial[follower] + np.polynomial.polynomial.polyval(led, terms))
    return value


def followers_of(model: mujoco.MjModel, driven: Sequence[int], joints: Iterable[int]) -> Followers:
    """The followers of driven joints among some joints, constant ones included.

    Raises:
        ValueError: a driven joint that follows another one or is constant, or a coupling that is refused.
    """
    roots: dict[int, tuple[int, JointValue]] = {}
    for index, joint in enumerate(driven):
        value = joint_value(model, joint)
        if value.slope == 0.0 or value.root in roots:
            raise ValueError(
                f"joint {model.joint(joint).name!r} follows another one in the model and cannot be driven as well: "
                "take it out of joints, home and control"
            )
        roots[value.root] = index, value
    found = []
    for joint in joints:
        value = joint_value(model, joint)
        if joint not in driven and (value.root in roots or value.slope == 0.0):
            driver, own = roots.get(value.root, (0, value))
            slope = value.slope / own.slope if value.slope else 0.0
            found.append((joint, driver, slope, value.offset - slope * own.offset))
    table = np.array(found).reshape(-1, 4)
    return Followers(*table[:, :2].T.astype(np.int64), *table[:, 2:].T)


def narrowed_limits(
    model: mujoco.MjModel, driven: Sequence[int], followers: Followers, limits: FloatArray
) -> FloatArray:
    """Limits of driven joints [rad or m] within which their followers keep their own, both (n, 2).

    Raises:
        ValueError: a joint that its followers leave no range.
    """
    narrow = limits.copy()
    for joint, driver, slope, offset in zip(*followers, strict=True):
        if model.jnt_limited[joint] and slope != 0.0:
            low, high = sorted((model.jnt_range[joint] - offset) / slope)
            narrow[driver] = max(narrow[driver, 0], low), min(narrow[driver, 1], high)
            if narrow[driver, 0] > narrow[driver, 1]:
                raise ValueError(
                    f"joint {model.joint(driven[driver]).name!r} has no range within its limits and those of "
                    f"{model.joint(joint).name!r}, which follows it: change these limits, or the coupling"
                )
    return narrow
