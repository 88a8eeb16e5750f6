"""Joint values with which an arm reaches each point: from several starts, neighbours, and approach directions.

A point can be approached along 32 directions over the half space about its outward normal.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.joint_search import Wanted, search_joints
from surgsim_env.arm_study.kinematics import BatchKinematics

# The tip is at a point, and the shaft in its trocar, within this [m].
REACHED = 1e-3
NEIGHBOURS = 3
# Directions of each ring; every direction covers the same share of the half space.
RINGS = (1, 6, 11, 14)
DIRECTION_COUNT = sum(RINGS)
# A direction counts as reached within this [rad].
APPROACH_ANGLE = math.radians(10.0)


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
        """Which candidates have the tip at its point and the shaft in its trocar, (n, k)."""
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
    """Candidates for positions of the tip (n, 3) [m] from starts (k, n_joint), or of each (n, k, n_joint)."""
    count, each = len(tips), starts.shape[-2]
    begin = np.broadcast_to(starts, (count, each, kinematics.joint_count)).reshape(-1, kinematics.joint_count)
    wanted = Wanted(np.repeat(tips, each, axis=0), limits=limits, trocar=trocar)
    return _search(kinematics, wanted, begin, (count, each))


def from_neighbours(kinematics: BatchKinematics, tips: FloatArray, found: Candidates) -> Candidates:
    """Candidates for points that have none, started from those of the nearest points that have one."""
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


def approach_directions(normals: FloatArray, towards: FloatArray, line: FloatArray) -> FloatArray:
    """Unit vectors out of the tissue, from which a tip may come, about outward normals (n, 3), shape (n, 32, 3).

    Rings of 1, 6, 11 and 14 directions lie in the middles of bands of equal area: after k of 32 directions a band of m
    has cos(theta) = 1 - (k + m/2) / 32 (the first is the normal itself). Azimuths are evenly spaced. The first is that
    of `towards` (n, 3), from the surface to the endoscope, so that a mirrored scene has mirrored directions; where the
    normal is parallel to it, that of `line` (3,).
    """
    first = _across(towards, normals)
    short = np.linalg.norm(first, axis=1) < 1e-6 * np.linalg.norm(towards, axis=1)
    first[short] = _across(np.broadcast_to(line, first.shape), normals)[short]
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normals, first)
    found = [normals]
    before = 1
    for count in RINGS[1:]:
        cosine = 1.0 - (before + 0.5 * count) / DIRECTION_COUNT
        sine = math.sqrt(1.0 - cosine**2)
        for index in range(count):
            azimuth = 2.0 * math.pi * index / count
            found.append(cosine * normals + sine * (math.cos(azimuth) * first + math.sin(azimuth) * second))
        before += count
    return np.stack(found, axis=1)


def _across(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    return vectors - (vectors * normals).sum(axis=1)[:, None] * normals


def approach_share(pointing: FloatArray, usable: np.ndarray, directions: FloatArray) -> FloatArray:
    """Share of directions (n, 32, 3) that usable tips (n, k), pointing along (n, k, 3), have within 10 degrees."""
    cosine = -np.einsum("nki,ndi->nkd", pointing, directions)
    return ((cosine >= math.cos(APPROACH_ANGLE)) & usable[:, :, None]).any(axis=1).mean(axis=1)
