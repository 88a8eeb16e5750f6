"""What a jaw has hold of: its opening, grip, pull and what friction has left, read off the wrenches on its fingers."""

from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.instrument import Instrument


@dataclass(frozen=True)
class Grasp:
    """The state of a jaw's hold on tissue. A grasp is contact: nothing here is remembered.

    Args:
        opening: gap between the pads at their middles [m].
        grip_force: the smaller of the tissue's two forces along the pads' own normals [N].
        pull_force: size of the sum of the tissue's forces on both fingers [N].
        friction_left: what friction could hold beyond what it holds: mu (N1 + N2) - (T1 + T2) [N], N and T being the
            sizes of each pad's normal and tangential force; at 0 or below it slips.
        holds: whether tissue presses both pads.
    """

    opening: float
    grip_force: float
    pull_force: float
    friction_left: float
    holds: bool


def read_grasp(instrument: Instrument, wrench: FloatArray, friction: float) -> Grasp | None:
    """What an instrument's jaw holds, None where it has no jaw.

    Args:
        instrument: its poses as of now.
        wrench: tissue's force [N] and torque [N m] on each tool, (n_tool, 6).
        friction: Coulomb coefficient of the scene's contact law, which the pads' own multiplies.
    """
    jaw = instrument.jaw
    if jaw is None:
        return None
    forces, normals = wrench[jaw.tools, :3], jaw.normals
    # Tissue pushes a pad back, against its normal.
    along = (forces * normals).sum(axis=1)
    pressing = np.maximum(-along, 0.0)
    tangential = np.linalg.norm(forces - along[:, None] * normals, axis=1)
    return Grasp(
        opening=jaw.opening,
        grip_force=float(pressing.min()),
        pull_force=float(np.linalg.norm(forces.sum(axis=0))),
        friction_left=float((friction * jaw.friction * pressing - tangential).sum()),
        holds=bool((pressing > 0.0).all()),
    )
