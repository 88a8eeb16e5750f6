"""What is measured over an episode of retraction: forces, strains, slips and the tip's path."""

import json
from dataclasses import asdict, dataclass, field

import numpy as np

from msdm_core.kernels import OrganModel
from msdm_core.mesh import FloatArray
from surgsim_env.grasp import Grasp

# The lobe's thirds, from the anchored edge to the free one.
REGIONS = ("held", "middle", "free")
# A hold slips where friction has less than this share of what it could bear left.
SLIP_SHARE = 0.02


@dataclass
class RetractionRecord:
    """Running measures of an episode; `info` names them.

    Fields:
        steps: control steps so far
        held_steps: of these, with tissue between the pads
        grip_peak, pull_peak: largest grip force and pull [N]; the pull's of every haptic step
        grip_sum, pull_sum: summed over the steps that held something [N]
        impulse: the pull's integral over time [N s]
        slips: how often a hold began to slip, or was lost though the jaw was told to be closed
        path: how far the tip went [m]
        strain: largest strain of an edge in each of REGIONS, lengthening over length at rest
    """

    steps: int = 0
    held_steps: int = 0
    grip_peak: float = 0.0
    pull_peak: float = 0.0
    grip_sum: float = 0.0
    pull_sum: float = 0.0
    impulse: float = 0.0
    slips: int = 0
    path: float = 0.0
    strain: list[float] = field(default_factory=lambda: [0.0] * len(REGIONS))
    slipping: bool = False
    held: bool = False
    tip: list[float] | None = None

    def note(
        self, grasp: Grasp, pull_peak: float, tip: FloatArray, strain: list[float], closing: bool, duration: float
    ) -> None:
        """Take in a control step.

        Args:
            grasp: at its end.
            pull_peak: largest pull of its haptic steps [N].
            tip: position at its end [m], (3,).
            strain: largest strain of each region at its end.
            closing: whether the jaw is told to be closed more than open.
            duration: of the step [s].
        """
        self.steps += 1
        if grasp.holds:
            self.held_steps += 1
            self.grip_sum += grasp.grip_force
            self.pull_sum += grasp.pull_force
        self.grip_peak = max(self.grip_peak, grasp.grip_force)
        self.pull_peak = max(self.pull_peak, pull_peak, grasp.pull_force)
        self.impulse += grasp.pull_force * duration
        slipping = grasp.holds and grasp.friction_left <= SLIP_SHARE * grasp.grip_force
        lost = self.held and not grasp.holds and closing
        self.slips += int((slipping and not self.slipping) or lost)
        self.slipping, self.held = slipping, grasp.holds
        if self.tip is not None:
            self.path += float(np.linalg.norm(tip - self.tip))
        self.tip = tip.tolist()
        self.strain = [max(one, other) for one, other in zip(self.strain, strain)]

    def info(self) -> dict[str, bool | float | str]:
        """The measures so far, by the names that `info` has."""
        held = max(self.held_steps, 1)
        return {
            "grip_force_peak": self.grip_peak,
            "grip_force_mean": self.grip_sum / held,
            "pull_force_peak": self.pull_peak,
            "pull_force_mean": self.pull_sum / held,
            "pull_impulse": self.impulse,
            "slips": float(self.slips),
            "path_length": self.path,
            **{f"strain_{region}": value for region, value in zip(REGIONS, self.strain)},
        }

    def to_json(self) -> str:
        """All of it, exact."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "RetractionRecord":
        """What `to_json` wrote."""
        return cls(**json.loads(text))


def region_strains(model: OrganModel, node_position: FloatArray, box: tuple[FloatArray, FloatArray]) -> list[float]:
    """Largest strain of an edge in each third of what is lifted, by the middle of the edge at rest along y.

    The strain of an edge is its lengthening over its length at rest; shortening counts as 0.

    Args:
        model: the organ.
        node_position: of its nodes now [m], (n_node, 3).
        box: corners of the box of what is lifted [m], (3,) each; other edges do not count.
    """
    first, second = model.spring_nodes.T
    lengths = np.linalg.norm(node_position[first] - node_position[second], axis=1)
    strain = lengths / model.spring_rest_length - 1.0
    rest = model.node_rest_position
    middle = 0.5 * (rest[first] + rest[second])
    lifted = ((middle >= box[0]) & (middle <= box[1])).all(axis=1)
    low, high = float(box[0][1]), float(box[1][1])
    share = (len(REGIONS) * (middle[:, 1] - low) / (high - low)).astype(np.int64)
    third = np.where(lifted, np.minimum(share, len(REGIONS) - 1), -1)
    return [float(strain[third == region].max(initial=0.0)) for region in range(len(REGIONS))]
