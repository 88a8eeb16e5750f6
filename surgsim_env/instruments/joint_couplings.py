"""Joints of a MuJoCo model that follow others: `<mimic>` of URDF, `<equality><joint>` of MJCF.

A coupling is q = sum_k c_k q_l^k, with the values of both joints measured from the model's initial ones. The leader may
follow another joint in turn, up to a root; on the way from there to the tip of an arm all couplings are linear.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray


class JointCoupling(NamedTuple):
    """A coupling: indices of the two joints, -1 for a constant in place of a leader, and c_0 to c_4 (5,)."""

    follower: int
    leader: int
    terms: FloatArray


class JointLaw(NamedTuple):
    """A joint's value by that of its root.

    Fields:
        path: from the joint to its root, each the leader of that before; -1 for a constant
        value: polynomial of the root's value [rad or m]
    """

    path: list[int]
    value: Polynomial


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


def joint_law(model: mujoco.MjModel, joint: int) -> JointLaw:
    """A joint's value by that of its root, which is the joint itself without a coupling.

    Raises:
        ValueError: a joint that follows two joints, or itself.
    """
    initial, path, value = model.qpos0[model.jnt_qposadr], [joint], Polynomial([0.0, 1.0])
    while own := [coupling for coupling in joint_couplings(model) if coupling.follower == path[-1]]:
        follower, leader, terms = own[0]
        if len(own) > 1 or leader in path:
            raise ValueError(
                f"joint {model.joint(follower).name!r} follows {'two joints' if len(own) > 1 else 'itself in a circle'}"
                ": leave it one coupling, to a joint that does not follow it"
            )
        led = Polynomial([-initial[leader], 1.0] if leader >= 0 else [0.0])
        value = value(initial[follower] + Polynomial(terms).trim()(led))
        path.append(leader)
    return JointLaw(path, value.trim())


def linear_law(model: mujoco.MjModel, joint: int) -> tuple[int, float, float]:
    """Root, slope and offset of a joint that follows its root by these alone.

    Raises:
        ValueError: a polynomial or constant coupling, or those of `joint_law`.
    """
    path, value = joint_law(model, joint)
    if value.degree() != 1:
        raise ValueError(
            f"joint {model.joint(joint).name!r} follows by the polynomial {value.coef.tolist()}; in an arm it follows "
            "by two numbers, the second not 0: change the coupling in the model, or hold the joint"
        )
    offset, slope = value.coef.tolist()
    return path[-1], slope, offset


def followers_of(model: mujoco.MjModel, driven: Sequence[int], joints: Iterable[int]) -> Followers:
    """The followers of driven joints among some joints.

    Raises:
        ValueError: a driven joint that follows another one, or a coupling that is refused.
    """
    drivers: dict[int, tuple[int, float, float]] = {}
    for index, joint in enumerate(driven):
        root, slope, offset = linear_law(model, joint)
        if root in drivers:
            raise ValueError(
                f"joint {model.joint(joint).name!r} follows another one in the model and cannot be driven as well: "
                "take it out of joints, home and control"
            )
        drivers[root] = index, slope, offset
    rows = []
    for joint in joints:
        root, slope, offset = linear_law(model, joint)
        if joint not in driven and root in drivers:
            driver, own_slope, own_offset = drivers[root]
            rows.append((joint, driver, slope / own_slope, offset - slope / own_slope * own_offset))
    table = np.array(rows).reshape(-1, 4)
    return Followers(*table[:, :2].T.astype(np.int64), *table[:, 2:].T)


def narrowed_limits(model: mujoco.MjModel, driven: Sequence[int], followers: Followers) -> FloatArray:
    """Limits of driven joints [rad or m] (n, 2) within which their followers keep their own; infinite without any.

    Raises:
        ValueError: a joint that its followers leave no range.
    """
    limited = model.jnt_limited[driven].astype(bool)
    narrow = np.where(limited[:, None], model.jnt_range[driven], [-np.inf, np.inf])
    for joint, driver, slope, offset in zip(*followers, strict=True):
        if model.jnt_limited[joint]:
            low, high = sorted((model.jnt_range[joint] - offset) / slope)
            narrow[driver] = max(narrow[driver, 0], low), min(narrow[driver, 1], high)
            if narrow[driver, 0] > narrow[driver, 1]:
                raise ValueError(
                    f"joint {model.joint(driven[driver]).name!r} has no range within its limits and those of "
                    f"{model.joint(joint).name!r}, which follows it: change these limits, or the coupling"
                )
    return narrow
