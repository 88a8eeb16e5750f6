"""Presses that end before they begin, and the slope of complete ones."""

from dataclasses import replace

import numpy as np
import pytest

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


def test_the_slope_of_a_press_is_that_between_shallower_and_deeper_ones():
    """Central difference of the forces held at 0.95 and 1.05 of the depth; a fit of d^n below it is within a tenth."""
    scene, forces = make_scene("phantom_small"), []
    for share in (0.95, 1.0, 1.05):
        depth = share * scene.palpation.press_depth
        anatomy = load_anatomy(replace(scene, palpation=replace(scene.palpation, press_depth=depth)))
        simulation = Simulation(anatomy)
        simulation.reset(anatomy.organ(), simulation.instrument.upper)
        result = press(simulation, *anatomy.face.project([0.02, 0.02, 0.02]))
        forces.append((result.depth, result.force, result.slope))
    (low, shallow, _), (_, _, slope), (high, deep, _) = forces
    assert slope == pytest.approx((deep - shallow) / (high - low), rel=0.1)
