"""Results of an evaluation of two arms: arrays over points."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh import FloatArray, IntArray
from surgsim_apps.arms.ports import Ports
from surgsim_apps.reports.turning_scene import TurningScene
from surgsim_env.instruments import SIDES
from surgsim_env.scene import ArmDescription, Port

# Reasons why an arm does not reach a point, in the order of the tests; 0 is reachable.
REASONS = ("reachable", "no joints put the tip there", "a joint limit", "the shaft misses its trocar",
           "the arm touches the organ", "the arm touches the wall", "the arm touches another obstacle")  # fmt: skip


@dataclass(frozen=True)
class ArmReach:
    """One arm at every point; figures that need joints are NaN at points out of reach.

    Fields:
        name: of the arm, from its description
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
        """Mask of points in reach, (n_point,)."""
        return self.reason == 0


@dataclass(frozen=True)
class ArmWithErrors:
    """One arm at the points in its reach, its joints with draws of the errors that its file states.

    Fields:
        tip_error: distance of the tip from its place with exact joints [m]       (n_draw, n_reached)
        depth_error: size of that along the surface's normal [m]                  (n_draw, n_reached)
        kept: share of points and draws without contact of shaft and links
    """

    tip_error: FloatArray
    depth_error: FloatArray
    kept: float


@dataclass(frozen=True)
class ArmThroughCycle:
    """One arm while the organ moves, at every point and position.

    A path begins at rest at a point in reach, keeps joint limits and trocar at every position, and touches neither
    organ nor wall. Its joints and clearance are NaN at points without one.

    Fields:
        reachable: at each position by itself, regardless of the joints before  (n_position, n_point)
        joints: along the path [m, rad]                                         (n_position, n_point, n_joint)
        clearance: smallest distance from organ and wall along the path [m]     (n_position, n_point)
    """

    reachable: NDArray[np.bool_]
    joints: FloatArray
    clearance: FloatArray

    @property
    def always(self) -> NDArray[np.bool_]:
        """Mask of points in reach at every position, (n_point,)."""
        return np.asarray(self.reachable.all(axis=0))

    @property
    def has_path(self) -> NDArray[np.bool_]:
        """Mask of points with a path, (n_point,)."""
        return np.isfinite(self.joints[0, :, 0])


@dataclass(frozen=True)
class ThroughCycle:
    """Both arms on an organ that moves with its ground, each motion in its largest and quickest cycle.

    Fields:
        motions: their names, the largest motion of the organ first
        travel: largest displacement of any point by each motion [m]                  (n_motion,)
        period: of each [s]                                                           (n_motion,)
        left, right: each arm
        both: reachable by both at once at each position                              (n_position, n_point)
    """

    motions: tuple[str, ...]
    travel: FloatArray
    period: FloatArray
    left: ArmThroughCycle
    right: ArmThroughCycle
    both: NDArray[np.bool_]

    @property
    def arms(self) -> dict[str, ArmThroughCycle]:
        """Both arms by side."""
        return {side: getattr(self, side) for side in SIDES}

    @property
    def both_always(self) -> NDArray[np.bool_]:
        """Mask of points in reach of both at once at every position, (n_point,)."""
        return np.asarray(self.both.all(axis=0))


@dataclass(frozen=True)
class PortMove:
    """A move of one port that lets both arms reach more.

    Fields:
        side: of the port
        words: length and direction, as the endoscope's picture shows it
        shift: along the body wall [m]                                               (3,)
        before, after: share of the surface's points that both arms reach at once
    """

    side: str
    words: str
    shift: FloatArray
    before: float
    after: float


@dataclass(frozen=True)
class Placement:
    """A placement of the search, its figures estimated by `QuickReach`.

    Fields:
        ports: of both arms and the endoscope
        share: of the points in reach of both arms at once
        clearance: median distance of the arms from organ, wall and each other, up to 20 mm [m]
        dexterity: median isotropy of the less isotropic arm
    """

    ports: Ports
    share: float
    clearance: float
    dexterity: float


@dataclass(frozen=True)
class PortsFound:
    """Result of a search.

    Fields:
        given, best: placement to begin with, and the one of the greatest worth
        front: no placement of the search is better in one figure and not worse in the others; most reach first
        gains: share of the points that both reach, with one port moved from given to best, by side, and with the
            "bases" alone in the best places
        count: number of placements tried
        arms: whose bases stand elsewhere in best, by side
    """

    given: Placement
    best: Placement
    front: tuple[Placement, ...]
    gains: dict[str, float]
    count: int
    arms: dict[str, ArmDescription]


@dataclass(frozen=True)
class ArmsEvaluation:
    """Both arms on one scene.

    Fields:
        points, normals: of the organ's surface, outward, then the inner targets [m]          (n_point, 3)
        inner: mask of the inner targets                                                      (n_point,)
        left, right: each arm alone
        both: reachable by both at once, the arms at least 5 mm apart                         (n_point,)
        arm_distance_inside, arm_distance_outside: smallest distance between the arms inside and outside the body
            with both tips at the point's neighbourhood [m], NaN unless both reach it         (n_point,)
        scene: name of the scene
        surface_points, surface_triangles: the organ's outer surface, for pictures            (n, 3), (m, 3)
        ports: of the arms ("left", "right") and the camera ("endoscope")
        with_errors: of the arms whose files state errors of the joints, by side
        cycle: both arms while the patient breathes; None for a motionless one
        move: of a port, that lets both reach more; None where no move is worth it, or none was tried
        moves_tried: True if moves of the ports were tried
        search: for the ports; None without one
        turning: scene of the arms in the patient; None without one
    """

    points: FloatArray
    normals: FloatArray
    inner: NDArray[np.bool_]
    left: ArmReach
    right: ArmReach
    both: NDArray[np.bool_]
    arm_distance_inside: FloatArray
    arm_distance_outside: FloatArray
    scene: str
    surface_points: FloatArray
    surface_triangles: IntArray
    ports: Mapping[str, Port]
    with_errors: Mapping[str, ArmWithErrors]
    cycle: ThroughCycle | None = None
    move: PortMove | None = None
    moves_tried: bool = False
    search: PortsFound | None = None
    turning: TurningScene | None = None

    @property
    def arms(self) -> dict[str, ArmReach]:
        """Both arms by side."""
        return {side: getattr(self, side) for side in SIDES}
