"""What an evaluation of two arms found: arrays over points, for the report, the tables and the pictures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.arms.port import Port

# Why a point is out of an arm's reach, in the order of the tests; 0 is reachable.
REASONS = ("reachable", "no joints put the tip there", "a joint limit", "the shaft misses its trocar",
           "the arm touches the organ", "the arm touches the wall")  # fmt: skip


@dataclass(frozen=True)
class ArmReach:
    """One arm at every point; what needs joints is NaN where the point is not reachable.

    Fields:
        name: of the arm, as its description says
        reason: index into REASONS                                                           (n_point,)
        joints: the best found [m, rad]                                                      (n_point, n_joint)
        position_error: of the tip [m]                                                       (n_point,)
        approach_share: share of 32 approach directions reached within 10 degrees            (n_point,)
        manipulability: Yoshikawa's sqrt(det J J^T), rotations scaled by the stated length   (n_point,)
        isotropy: smallest over largest singular value of that J                             (n_point,)
        limit_margin: product over joints of 4 (q - low)(high - q) / (high - low)^2          (n_point,)
        tip_force: largest static force along the inward normal within joint torques [N]     (n_point,)
        trocar_load: sideways force on the trocar at 1 N at the tip [N]                      (n_point,)
        camera_angle: between instrument shaft and the endoscope's line of sight [rad]       (n_point,)
        organ_clearance: smallest distance of shaft and links from the organ [m]             (n_point,)
        wall_clearance: smallest distance of shaft and links from the body wall [m]          (n_point,)
        trocar_error: distance of the shaft's axis from the trocar [m]                       (n_point,)
    """

    name: str
    reason: IntArray
    joints: FloatArray
    position_error: FloatArray
    approach_share: FloatArray
    manipulability: FloatArray
    isotropy: FloatArray
    limit_margin: FloatArray
    tip_force: FloatArray
    trocar_load: FloatArray
    camera_angle: FloatArray
    organ_clearance: FloatArray
    wall_clearance: FloatArray
    trocar_error: FloatArray

    @property
    def reachable(self) -> NDArray[np.bool_]:
        """Which points the arm reaches, (n_point,)."""
        return self.reason == 0


@dataclass(frozen=True)
class ArmsEvaluation:
    """Both arms on one scene.

    Fields:
        points, normals: of the organ's surface, outward, then the inner targets [m]          (n_point, 3)
        inner: which points are inner targets                                                 (n_point,)
        left, right: each arm alone
        both: reachable by both at once, the arms at least 5 mm apart                         (n_point,)
        arm_distance_inside, arm_distance_outside: smallest distance between the arms inside and outside the body
            with both tips at the point's neighbourhood [m], NaN where not both reach it      (n_point,)
        summary: what summary.json holds (shares, extremes, versions, seed, inputs), plain JSON types
        scene: name of the scene
        surface_points, surface_triangles: the organ's outer surface, for pictures            (n, 3), (m, 3)
        pictures: RGB images (height, width, 3) uint8 of the arms in the patient, by caption
        ports: where the arms ("left", "right") and the camera ("endoscope") enter, for pictures; may be empty
    """

    points: FloatArray
    normals: FloatArray
    inner: NDArray[np.bool_]
    left: ArmReach
    right: ArmReach
    both: NDArray[np.bool_]
    arm_distance_inside: FloatArray
    arm_distance_outside: FloatArray
    summary: Mapping[str, Any]
    scene: str
    surface_points: FloatArray
    surface_triangles: IntArray
    pictures: Mapping[str, NDArray[np.uint8]]
    ports: Mapping[str, Port] = field(default_factory=dict)
