"""Presses that end before they begin."""

import numpy as np

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.site_press import press
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


def test_a_press_with_a_fault_in_its_first_step_measures_nothing():
    """From below, with the shaft through the block: force and depth are 0, not the mean of no readings."""
    anatomy = load_anatomy(make_scene("phantom_small"))
    simulation = Simulation(anatomy)
    simulation.reset(anatomy.organ(), simulation.instrument.upper)
    result = press(simulation, np.array([0.03, 0.03, 0.0]), np.array([0.0, 0.0, -1.0]))
    assert "contact lost" in result.end
    assert result.force == 0.0 and result.depth == 0.0 and not len(result.curve)
