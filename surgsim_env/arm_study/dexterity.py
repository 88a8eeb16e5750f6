"""How well an arm moves and pushes at given joint values: manipulability, isotropy, margins, forces, camera angle."""

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.kinematics import BatchKinematics, Chain, cross, dot

# One radian of rotation of the tip counts as this travel [m].
CHARACTERISTIC_LENGTH = 0.1


def scaled_singular_values(kinematics: BatchKinematics, chain: Chain) -> FloatArray:
    """Singular values, largest first, of J = [J_v; L J_w] with L = 0.1 m, shape (n, k).

    k is the smaller of 6 and the degrees of freedom that the trocar leaves: where control keeps the shaft in the
    trocar, J acts on the n_joint - 2 motions that keep it there.
    """
    linear, angular = kinematics.tip_jacobian(chain)
    jacobian = np.concatenate([linear, CHARACTERISTIC_LENGTH * angular], axis=1)
    freedoms = kinematics.joint_count
    if not kinematics.arm.remote_centre_fixed:
        shaft = kinematics.shaft_jacobian(chain)
        across = shaft - chain.along[:, :, None] * np.einsum("ni,nij->nj", chain.along, shaft)[:, None]
        idle = np.linalg.svd(across)[2][:, 2:]
        jacobian, freedoms = jacobian @ np.swapaxes(idle, 1, 2), freedoms - 2
    values: FloatArray = np.asarray(np.linalg.svd(jacobian, compute_uv=False), dtype=np.float64)
    return values[:, : min(6, freedoms)]


def manipulability(singular_values: FloatArray) -> FloatArray:
    """Yoshikawa's measure, the product of the singular values: sqrt(det J J^T) at full rank, (n,)."""
    return singular_values.prod(axis=1)


def isotropy(singular_values: FloatArray) -> FloatArray:
    """Smallest over largest singular value: 1 moves alike in all directions, 0 is singular, (n,)."""
    return singular_values[:, -1] / singular_values[:, 0]


def limit_margin(kinematics: BatchKinematics, joints: FloatArray) -> FloatArray:
    """Prod 4 (q - low)(high - q) / (high - low)^2 over joints: 1 in the middle of all limits, 0 at any, (n,)."""
    low, high = kinematics.lower, kinematics.upper
    return (4.0 * (joints - low) * (high - joints) / (high - low) ** 2).prod(axis=-1)


def tip_force(kinematics: BatchKinematics, chain: Chain, directions: FloatArray) -> FloatArray:
    """Largest static force along unit vectors (n, 3) within the joints' torques [N], (n,); inf if none is stated.

    tau = J_v^T F d, so F = min over joints of tau_max / |J_v^T d|. Gravity is compensated; the trocar bears no load.
    """
    torque = np.abs(np.einsum("nij,ni->nj", kinematics.tip_jacobian(chain)[0], directions))
    with np.errstate(divide="ignore"):
        return np.where(torque > 1e-12, kinematics.effort / np.maximum(torque, 1e-300), np.inf).min(axis=1)


def trocar_load(kinematics: BatchKinematics, chain: Chain, directions: FloatArray) -> FloatArray:
    """Sideways force on the trocar [N] at 1 N on the tip along unit vectors (n, 3), (n,).

    The shaft is a lever, supported by the trocar and held at its outer end without a moment: the case of an arm whose
    mechanism does not fix the remote centre. Moments about the outer end o, with the shaft's direction a, the
    tip x and the trocar t: N = |a x ((x - o) x f)| / (t - o).a; for a straight instrument and a sideways force that
    is (outer + inner length) / outer length. NaN where no shape of the shaft reaches outside.
    """
    ends = chain.shape_ends[:, kinematics.shaft_index].reshape(len(chain.tip), -1, 3)
    if ends.shape[1] == 0:
        return np.full(len(chain.tip), np.nan)
    along = dot(ends - chain.near[:, None], chain.along[:, None])
    outer = np.min(along, axis=1)
    start = chain.near + outer[:, None] * chain.along
    moment = cross(chain.along, cross(chain.tip - start, directions))
    return np.where(outer < -1e-3, np.linalg.norm(moment, axis=1) / np.maximum(-outer, 1e-3), np.nan)


def camera_angle(chain: Chain, points: FloatArray, endoscope: FloatArray) -> FloatArray:
    """Angle between the shafts and the lines of sight from the endoscope's port (3,) to points (n, 3) [rad], (n,)."""
    sight = points - endoscope
    return np.arctan2(np.linalg.norm(cross(chain.along, sight), axis=1), dot(chain.along, sight))
