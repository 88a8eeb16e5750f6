"""Joint values with which an arm comes to each point: from several starts, many directions, and its neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray
from surgsim_env.evaluation.approach import APPROACH_ANGLE, DIRECTION_COUNT
from surgsim_env.evaluation.joint_search import Wanted, search_joints
from surgsim_env.evaluation.kinematics import BatchKinematics

# The tip is at a point, the shaft in its trocar within this [m].
REACHED = 1e-3
NEIGHBOURS = 3


@dataclass
class Candidates:
    """k sets of joint values for each of n points.

    Fields:
        joints: [rad or m]                                          (n, k, n_joint)
        position_error, trocar_error: [m]                           (n, k)
        pointing: unit vector out of the tip                        (n, k, 3)
    """

    joints: FloatArray
    position_error: FloatArray
    trocar_error: FloatArray
    pointing: FloatArray

    @property
    def met(self) -> NDArray[np.bool_]:
        """Which have the tip at its point and the shaft in its trocar, (n, k)."""
        return (self.position_error <= REACHED) & (self.trocar_error <= REACHED)

    def add(self, other: "Candidates") -> "Candidates":
        """Both, side by side."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Candidates(*(np.concatenate(pair, axis=1) for pair in pairs))


def spread_starts(kinematics: BatchKinematics) -> FloatArray:
    """Home, the middle of all limits, and each joint alone half way from there to either limit, (k, n_joint).

    No random numbers: the starts of a mirrored arm are the mirrored starts.
    """
    middle = 0.5 * (kinematics.lower + kinematics.upper)
    aside = np.diag(0.25 * (kinematics.upper - kinematics.lower))
    return np.concatenate([kinematics.arm.home[None], middle[None], middle + aside, middle - aside])


def from_starts(
    kinematics: BatchKinematics, tips: FloatArray, starts: FloatArray, *, limits: bool = True, trocar: bool = True
) -> Candidates:
    """Candidates for places of the tip (n, 3) [m] from starts (k, n_joint), or (n, k, n_joint) of each its own."""
    count, each = len(tips), starts.shape[-2]
    begin = np.broadcast_to(starts, (count, each, kinematics.joint_count)).reshape(-1, kinematics.joint_count)
    wanted = Wanted(np.repeat(tips, each, axis=0), limits=limits, trocar=trocar)
    return _search(kinematics, wanted, begin, (count, each))


def from_neighbours(kinematics: BatchKinematics, tips: FloatArray, found: Candidates) -> Candidates:
    """One more candidate for points that have none: from the nearest points' that have."""
    met = found.met
    has = met.any(axis=1)
    need = np.flatnonzero(~has)
    if need.size == 0 or not has.any():
        return found
    first = np.where(has, met.argmax(axis=1), 0)
    tree, owners = KDTree(tips[has]), np.flatnonzero(has)
    near = owners[tree.query(tips[need], k=min(NEIGHBOURS, len(owners)))[1].reshape(len(need), -1)]
    more = from_starts(kinematics, tips[need], found.joints[near, first[near]])
    rows = np.arange(near.shape[1])
    for index, point in enumerate(need):
        for name in vars(found):
            getattr(found, name)[point, rows] = getattr(more, name)[index]
    return found


def from_directions(
    kinematics: BatchKinematics, tips: FloatArray, directions: FloatArray, found: Candidates, usable: NDArray[np.bool_]
) -> Candidates:
    """A candidate for each approach direction (n, 32, 3), begun at the usable one that points most nearly that way."""
    cosine = -np.einsum("nki,ndi->ndk", found.pointing, directions)
    cosine = np.where(usable[:, None], cosine, -np.inf)
    best = cosine.argmax(axis=2)
    rows = np.arange(len(tips))[:, None]
    begin = found.joints[rows, best].reshape(-1, kinematics.joint_count)
    wanted = Wanted(np.repeat(tips, DIRECTION_COUNT, axis=0), -directions.reshape(-1, 3))
    return _search(kinematics, wanted, begin, (len(tips), DIRECTION_COUNT))


def still_open(directions: FloatArray, found: Candidates, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which directions (n, 32, 3) no usable candidate has yet, (n, 32)."""
    cosine = -np.einsum("nki,ndi->ndk", found.pointing, directions)
    return ~((cosine >= np.cos(APPROACH_ANGLE)) & usable[:, None]).any(axis=2)


def _search(kinematics: BatchKinematics, wanted: Wanted, begin: FloatArray, shape: tuple[int, int]) -> Candidates:
    found = search_joints(kinematics, wanted, begin)
    pointing = kinematics.at(found.joints, shapes=False).direction
    return Candidates(
        found.joints.reshape(*shape, -1),
        found.position_error.reshape(shape),
        found.trocar_error.reshape(shape),
        pointing.reshape(*shape, 3),
    )
