"""Start of tips: in sight, and touching nothing, whatever the instrument is."""

import numpy as np
import pytest

from surgsim_apps.live.physics import SHAPE_GAP, home_of
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, with_instrument


@pytest.mark.parametrize(
    ("scene", "instrument"),
    [("phantom_small", None), ("phantom_small", "psm_palpator"), ("lobe", "grasper"), ("lobe", "psm_pair")],
)
def test_tips_begin_before_the_face_and_feel_nothing(scene, instrument):
    anatomy = load_anatomy(with_instrument(make_scene(scene), instrument))
    simulation = Simulation(anatomy)
    parked = simulation.instrument.get_state()
    home = home_of(anatomy, simulation.instrument)
    assert np.array_equal(simulation.instrument.get_state(), parked)
    simulation.reset(anatomy.organ(), home)
    simulation.control_step(50)
    assert not simulation.contact_wrench.any()
    out = -anatomy.face.approach
    for place in home.reshape(-1, 3):
        gap = (place - anatomy.face.project(place)[0]) @ out
        assert SHAPE_GAP < gap < 0.03
