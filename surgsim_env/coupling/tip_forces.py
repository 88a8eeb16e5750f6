"""Wrench of the tissue on an instrument's tip, of one arm or of two; apart, since it imports robot arms."""

import numpy as np
from numpy.typing import NDArray

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.pair import SIDES, Pair


def tip_wrench(simulation: Simulation) -> NDArray[np.float32]:
    """Force of the tissue on the instrument [N] and its torque about the tip [N m], on the world's axes, shape (6,).

    It is the simulation's own, the mean of the last haptic step on all tools of the instrument, without the errors of a
    force sensor: force sum_i F_i, torque sum_i (T_i + (c_i - tip) x F_i), where the tools' torques T_i are about their
    centres of mass c_i. Two arms have 12 numbers, the left arm's first.
    """
    instrument = simulation.instrument
    if isinstance(instrument, Pair):
        arms = [(instrument.tools_of(side), instrument.arms[side].tip_position) for side in SIDES]
    else:
        arms = [(np.arange(instrument.tool_count), instrument.tip_position)]
    wrench, centre = simulation.contact_wrench, instrument.shapes.tool_centre
    parts = []
    for tools, tip in arms:
        forces = wrench[tools, :3]
        torque = (wrench[tools, 3:] + np.cross(centre[tools] - tip, forces)).sum(axis=0)
        parts += [forces.sum(axis=0), torque]
    return np.concatenate(parts).astype(np.float32)
