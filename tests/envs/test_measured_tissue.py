"""Environments on tissue that stiffens and relaxes keep the promises that those on linear tissue keep."""

from dataclasses import replace

import numpy as np
import pytest

from msdm_core import Relaxation, Stiffening
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.palpation.site_press import SitePress, press_alone, press_phases
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


@pytest.fixture(scope="module")
def scene():
    plain = make_scene("phantom_small")
    material = replace(
        plain.material,
        stiffening=Stiffening(onset_strain=0.05, cap_strain=0.2, tangent_cap=8.0),
        relaxation=Relaxation(relative_moduli=(0.3, 0.3), times=(0.05, 0.5)),
    )
    return replace(plain, name="measured", material=material)


def press_once(simulation, scene):
    point = np.array([0.5, 0.5, 1.0]) * np.ptp(simulation.anatomy.mesh.points, axis=0)
    return press_alone(SitePress(simulation, point, np.array([0.0, 0.0, 1.0])), press_phases(scene))


def test_a_second_press_equals_the_first(scene):
    """A restart brings Maxwell arms to rest too."""
    simulation = Simulation(load_anatomy(scene))
    first, second = press_once(simulation, scene), press_once(simulation, scene)
    assert first.force_peak > 0.1
    np.testing.assert_array_equal(second.force, first.force)
    assert second.force_peak == first.force_peak
