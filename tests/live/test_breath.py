"""The physics of a patient who breathes: the switch, recordings of it, what is drawn and felt of the ground."""

from dataclasses import replace

import numpy as np
import pytest

from msdm_core.organ.motion import SIGNAL
from msdm_core.organ.support import Support
from surgsim_apps.live.exchange_records import TRACE_STEPS, Reset
from surgsim_apps.live.session import BREATH_BUTTON
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion, Scene
from tests.live.test_physics import Bench

RISE = 0.003
BREATH = CyclicMotion(
    "breathing", (0.0, 0.001, RISE), period=(0.3, 0.4), rise=0.4, fall=0.4, variation=0.1, stops_in_apnoea=True
)
BEAT = CyclicMotion("heartbeat", (0.0, 0.0005, 0.0), period=(0.15, 0.2), rise=0.3, fall=0.3)


def breathing_scene(**changes) -> Scene:
    return replace(make_scene("phantom_small"), motions=(BREATH, BEAT), **changes)


@pytest.fixture
def bench() -> Bench:
    return Bench(breathing_scene())


def signals(bench: Bench, count: int, place, buttons: int = 0) -> np.ndarray:
    """Of both motions after each of some steps, (count, 2)."""
    rows = []
    for _ in range(count):
        bench.step(1, place, buttons)
        rows.append(bench.physics._simulation.organ_state.motion[:, SIGNAL].copy())
    return np.array(rows)


def test_the_switch_holds_the_breath_and_the_heart_goes_on(bench):
    breath, _ = signals(bench, 600, bench.above).T
    assert breath.max() > 0.5 and not bench.frame["breath_held"]
    signals(bench, 600, bench.above, BREATH_BUTTON)
    breath, heart = signals(bench, 400, bench.above, BREATH_BUTTON).T
    assert np.abs(breath).max() < 1e-15 and np.ptp(heart) > 0.5
    assert bench.frame["breath_held"]
    # A reset leaves it held, and letting go begins a breath.
    bench.ask(Reset())
    assert bench.frame["breath_held"]
    breath, _ = signals(bench, 300, bench.above, BREATH_BUTTON).T
    assert not breath.any()
    breath, _ = signals(bench, 200, bench.above).T
    assert breath.max() > 0.5 and not bench.frame["breath_held"]


def test_supports_are_drawn_where_the_ground_carries_them_and_other_parts_are_not():
    bed = Support("bed", "box", (0.02, 0.02, -0.02), size=(0.02, 0.02, 0.01))
    # Supports are as stiff as contact, and act explicitly: at the phantom's 1e8 N/m^3 they ask for ten substeps.
    contact = make_scene("lobe").contact
    bench = Bench(breathing_scene(supports=(bed,), contact=contact))
    geoms = bench.physics._geoms.tolist()
    model = bench.physics._simulation.instrument.model
    (place,) = [index for index, geom in enumerate(geoms) if model.geom(geom).name == "support_bed"]
    rows = []
    for _ in range(40):
        bench.step(10, bench.above)
        shift = bench.physics._simulation.organ_state.motion[:, SIGNAL] @ [BREATH.displacement, BEAT.displacement]
        # As it was at the start of the last haptic step, in which the ground moves by less than this.
        np.testing.assert_allclose(bench.frame["geom"][place], np.array(bed.position) + shift, atol=5e-5)
        others = np.arange(len(geoms)) != place
        there = bench.physics._simulation.instrument.data.geom_xpos[np.array(geoms)[others]]
        np.testing.assert_allclose(bench.frame["geom"][others], there, atol=1e-8)
        rows.append(shift)
    assert np.ptp(rows, axis=0)[2] > 0.5 * RISE


def test_the_map_is_told_where_on_the_organ_a_tip_touched(bench):
    """A tip that is held still touches, as the organ goes to and fro below it, here and there."""
    bench.step(800, bench.pressed)
    rest = bench.exchange.trace.read()["row"][60 : 800 // TRACE_STEPS]
    tip = rest["tip"][:, 0]
    # The tip is where its hand holds it; of the organ it is that place less what the breath has moved.
    assert 0.8 * RISE < np.ptp(tip[:, 2]) < 1.5 * 1.3 * RISE
    surface = bench.anatomy.mesh.points[:, 2].max()
    touches = rest["depth"][:, 0] > 0.0
    assert touches.any()
    depth = surface + bench.scene.instrument.tip_radius - tip[touches, 2]
    np.testing.assert_allclose(rest["depth"][touches, 0], depth, atol=1e-12)
