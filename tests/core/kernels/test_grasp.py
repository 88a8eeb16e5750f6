"""A strip held between two pads: it hangs, stretches, slips and comes free as Coulomb's law and Hooke's say."""

import numpy as np
import pytest

from surgsim_apps.validation.friction import (
    GAUGE,
    HELD,
    LENGTH,
    MODULUS,
    WIDTH,
    HangingStrip,
    grip,
    gripped_strip,
    slip,
)


@pytest.fixture
def hanging() -> HangingStrip:
    """The strip gripped, in no gravity yet, come to rest."""
    strip = gripped_strip()
    assert grip(strip.run(0.1)) == pytest.approx(0.30, abs=0.03)
    return strip


@pytest.mark.slow
def test_jaw_carries_the_load_and_the_strip_stretches_by_it(hanging: HangingStrip):
    """Reaction = weight below and between the pads, to 0.1 %; strain = F / (E A), to 10 %, below 3 %; pads balance."""
    resting = hanging.gauge_length
    for gravity in (3.0, 8.5):
        wrench = hanging.run(0.6, gravity=gravity)
        assert -wrench[:, 2].sum() == pytest.approx(gravity * hanging.model.node_mass.sum(), rel=1e-3)
        assert wrench[0, 0] == pytest.approx(-wrench[1, 0], rel=1e-3)
        strain = hanging.gauge_length / resting - 1.0
        assert strain < 0.03
        assert strain == pytest.approx(hanging.carried(gravity) / (MODULUS * WIDTH**2), rel=0.10)


def test_strip_slips_at_two_mu_n():
    """With less rough pads than in `surgsim validate`: the last load that holds is 2 mu N, N as it is then, to 5 %."""
    load, held = slip(gripped_strip(friction=0.25), 9.0)
    assert load == pytest.approx(2.0 * 0.25 * held, rel=0.05)


@pytest.mark.slow
def test_open_jaw_leaves_nothing(hanging: HangingStrip):
    """No force, no memory of contact or stretch; afterwards the strip floats without strain."""
    hanging.run(0.3, gravity=5.0)
    wrench = hanging.run(0.2, closing=-0.01)
    assert not wrench.any()
    assert not hanging.state.contact_engaged.any() and not hanging.state.contact_stretch.any()
    hanging.run(0.8)
    assert hanging.gauge_length == pytest.approx(GAUGE[1] - GAUGE[0], rel=1e-4)


@pytest.mark.slow
def test_hold_turns_with_the_jaw(hanging: HangingStrip):
    """Jaw and gravity turn together by a right angle: seen from the jaw nothing changes, friction's memory included.

    The springs of friction are stretched by 30 um; were they to keep their direction in the world, the strip would have
    crept by as much times sqrt(2).
    """
    model, state, pads = hanging.model, hanging.state, hanging.pads
    held = np.flatnonzero(model.node_rest_position[:, 2] > LENGTH - HELD)
    hanging.run(1.5, gravity=9.0)
    before, middle = state.node_position[held].mean(axis=0), pads.tool_centre.mean(axis=0)
    reaction = hanging.run(0.1, gravity=9.0)[:, :3].sum(axis=0)
    for step in range(30):
        hanging.run(0.1, gravity=9.0, tilt=np.pi / 60.0 * (step + 0.5), turning=np.pi / 6.0)
    after = hanging.run(1.5, gravity=9.0, tilt=np.pi / 2.0)
    # z has become -y.
    x, y, z = state.node_position[held].mean(axis=0) - pads.tool_centre.mean(axis=0)
    np.testing.assert_allclose([x, z, -y], before - middle, atol=8e-6)
    np.testing.assert_allclose(after[:, 1].sum(), -reaction[2], rtol=0.01)
