"""The physics' side of a session, step by step in this process: what hands do, requests, recordings, faults."""

import multiprocessing
from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.haptics.pacing import PaceSettings
from surgsim_apps.live.exchange_records import (
    TRACE_STEPS,
    Change,
    End,
    Pause,
    Phase,
    Record,
    Reset,
    new_exchange,
)
from surgsim_apps.live.organ_choice import (
    HIDDEN,
    NONE,
    OrganChoice,
    chosen_lesions,
    chosen_organ,
    lesion_kinds,
)
from surgsim_apps.live.painted_tissue import PaintedTissue
from surgsim_apps.live.physics import Physics
from surgsim_apps.live.stage import FeltMap, contrast_shares
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.rendering.painted_fields import PAINTED_FIELDS
from surgsim_env.rendering.scene_model import shown_geoms
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Scene
from tests.live.served import on_a_fast_machine

ASIDE, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


class Bench:
    """A physics without a process: its hands are moved, and it is stepped, by the test."""

    def __init__(self, scene: Scene | None = None) -> None:
        self.anatomy = on_a_fast_machine(scene or make_scene("phantom_small"))
        self.scene = self.anatomy.scene
        simulation = Simulation(self.anatomy)
        geoms = shown_geoms(simulation.instrument.model)
        self.exchange = new_exchange(1, self.anatomy.mesh.node_count, len(geoms), simulation.get_state())
        self.pipe, child = multiprocessing.Pipe()
        self.kind = lesion_kinds(self.scene)[0]
        self.physics = Physics(self.anatomy, OrganChoice(lesions=self.kind), PaceSettings(), self.exchange, child)
        point, self.normal = self.anatomy.face.project(self.anatomy.mesh.points.mean(axis=0) + UP)
        self.above = point + self.normal * (self.scene.instrument.tip_radius + 0.004)
        self.pressed = point + self.normal * (self.scene.instrument.tip_radius - 0.004)

    def hold(self, place, *, beats: bool = True, buttons: int = 0) -> None:
        with self.exchange.hand.writing() as hand:
            hand["target"], hand["buttons"] = place, buttons
            hand["beat"] += beats

    def step(self, count: int, place=None, buttons: int = 0) -> None:
        """`count` steps of `Physics.run`, without the clock."""
        for _ in range(count):
            if place is not None:
                self.hold(place, buttons=buttons)
            if self.physics._phase == Phase.RUNNING:
                self.physics._last = self.physics._loop.step()
                self.physics._record_step(self.physics._last)
        self.physics._write_frame()

    def ask(self, request) -> bool:
        self.pipe.send(request)
        return self.physics._handle_requests(lambda: True)

    @property
    def frame(self):
        return self.exchange.frame.read()

    @property
    def tip(self):
        return self.physics._last.tip


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_hand_presses_the_organ_and_the_page_is_told(bench):
    rest = bench.frame["node"].copy()
    bench.step(400, bench.above)
    assert not bench.frame["force"].any()
    bench.step(1000, bench.pressed)
    frame = bench.frame
    assert 0.03 < frame["force"][0] @ bench.normal < 1.0
    # At the place that it is led to, a millimetre or so behind it; and the tissue has given way.
    assert np.linalg.norm(frame["tip"][0] - bench.pressed) < 0.002
    assert np.linalg.norm(frame["node"] - rest, axis=1).max() > 0.002
    assert frame["phase"] == Phase.RUNNING and frame["time"] == pytest.approx(1.4, abs=0.002)
    trace = bench.exchange.trace.read()
    assert trace["count"] == 1400 // TRACE_STEPS
    row = trace["row"][int(trace["count"]) - 1]
    assert 0.002 < row["depth"][0] < 0.005 and row["peak"][0] >= np.linalg.norm(row["force"][0]) - 1e-9


def test_a_page_that_is_gone_lets_the_force_fade(bench):
    """Its process beats no more: the watchdog takes what is shown to zero, and the tip stays where it is."""
    bench.step(1500, bench.pressed)
    assert np.linalg.norm(bench.tip.force) > 0.02 and bench.tip.share == 1.0
    before = bench.frame["tip"][0].copy()
    bench.step(400)
    assert not bench.tip.force.any() and bench.tip.share == 0.0
    assert np.linalg.norm(bench.frame["tip"][0] - before) < 0.002
    bench.step(1200, bench.above)
    assert bench.tip.share == 1.0


def test_a_place_that_is_not_finite_moves_nothing(bench):
    bench.step(300, bench.above)
    before = bench.frame["tip"][0].copy()
    bench.step(200, np.full(3, np.nan))
    bench.step(300)
    assert bench.frame["phase"] == Phase.RUNNING
    assert np.linalg.norm(bench.frame["tip"][0] - before) < 0.005


def test_pause_and_reset(bench):
    bench.step(500, bench.pressed)
    bench.ask(Pause(True))
    time = float(bench.frame["time"])
    bench.step(50, bench.pressed)
    assert bench.frame["phase"] == Phase.PAUSED and bench.frame["time"] == time
    bench.ask(Pause(False))
    bench.step(50, bench.pressed)
    assert bench.frame["time"] == pytest.approx(time + 0.050)
    bench.ask(Reset())
    assert bench.frame["time"] == 0.0 and not bench.frame["force"].any()
    assert bench.exchange.trace.read()["count"] == 0
    assert not bench.ask(End())


@pytest.mark.slow
def test_sliders_make_another_organ(bench):
    forces = []
    for factor in (1.0, 2.0):
        bench.ask(Change(OrganChoice(modulus_factor=factor, lesions=NONE)))
        bench.step(600, bench.above)
        bench.step(1200, bench.pressed)
        forces.append(float(bench.frame["force"][0] @ bench.normal))
    # A coupling lies between hand and tip, so that twice the stiffness is a little less than twice the force.
    assert 1.6 < forces[1] / forces[0] < 2.0
    assert bench.frame["organ"] == 3


def test_the_page_computes_the_fields_of_the_physics(bench):
    choices = [OrganChoice(lesions=bench.kind)]
    session = SimpleNamespace(
        anatomy=bench.anatomy,
        simulation=Simulation(bench.anatomy),
        exchange=bench.exchange,
        choices=choices,
        ask=bench.ask,
    )
    tissue = PaintedTissue(session)
    bench.step(400, bench.above)
    assert tissue.shares() is None and not bench.exchange.tissue.read()["organ"]
    tissue.choose("pressure")
    assert not tissue.shares().any() and tissue.shares() is None
    # A refused organ keeps the number of the one before; the next one has the number of its own choice.
    for choice in (OrganChoice(lesions=HIDDEN, lesion_ratio=1e6), OrganChoice(modulus_factor=2.0, lesions=NONE)):
        choices.append(choice)
        bench.ask(Change(choice))
    bench.step(400, bench.above)
    bench.step(1000, bench.pressed)
    shares, simulation = tissue.shares(), bench.physics._simulation
    field = PAINTED_FIELDS["pressure"]
    values = field.node_values(simulation.organ_model, simulation.fields())
    # Restored shapes are those of the next step, micrometres from the last substep's.
    np.testing.assert_allclose(shares * tissue.end, values, rtol=0, atol=0.01 * values.max())
    assert shares.max() == 1.0 and tissue.end == pytest.approx(values.max(), rel=0.01)
    bench.step(600, bench.above)
    before = tissue.end
    assert not tissue.shares().any() and tissue.end == before
    bench.ask(Reset())
    assert not tissue.shares().any() and tissue.end < before


def test_an_organ_that_cannot_be_is_refused_and_the_last_one_stays(bench):
    bench.ask(Change(OrganChoice(lesions=HIDDEN, lesion_ratio=1e6)))
    frame = bench.frame
    assert bytes(frame["message"]).startswith(b"this organ cannot be made") and frame["organ"] == 1
    bench.step(200, bench.above)
    assert bench.frame["phase"] == Phase.RUNNING


def test_a_fault_stops_and_a_reset_goes_on(bench):
    bench.step(100, bench.above)
    bench.physics._simulation.organ_state.node_velocity[:, 2] = np.nan
    bench.step(5, bench.above)
    frame = bench.frame
    assert frame["phase"] == Phase.FAULT and bytes(frame["message"])
    assert not bench.tip.force.any()
    bench.ask(Pause(False))
    assert bench.frame["phase"] == Phase.FAULT
    bench.ask(Reset())
    bench.step(100, bench.above)
    assert bench.frame["phase"] == Phase.RUNNING and np.isfinite(bench.frame["node"]).all()


def test_a_recording_that_runs_is_not_begun_again(bench):
    bench.ask(Record(True))
    bench.step(50, bench.above)
    bench.ask(Record(True))
    bench.step(50, bench.above)
    bench.ask(Record(False))
    steps = bench.exchange.recorded.steps
    assert len(steps) == 100 and np.allclose(np.diff(steps["time"]), 1e-3)


def test_nobody_left_ends_it(bench):
    assert not bench.physics._handle_requests(lambda: False)
    bench.pipe.close()
    assert not bench.physics._handle_requests(lambda: True)


def test_choices_are_what_they_say():
    anatomy = load_anatomy(make_scene("liver"))
    plain = chosen_lesions(anatomy, OrganChoice())
    assert [lesion.name for lesion in plain] == [lesion.name for lesion in anatomy.demonstration_lesions()]
    changed = chosen_lesions(anatomy, OrganChoice(modulus_factor=2.0, lesion_ratio=3.0, lesion_size=0.5))
    for lesion, resized in zip(plain, changed, strict=True):
        assert resized.radius == pytest.approx(0.5 * lesion.radius) and resized.centre == lesion.centre
        assert resized.material.youngs_modulus == pytest.approx(6.0 * anatomy.scene.material.youngs_modulus)
    assert chosen_lesions(anatomy, OrganChoice(lesions=NONE)) == []
    hidden = [chosen_lesions(anatomy, OrganChoice(lesions=HIDDEN, seed=seed))[0].centre for seed in (1, 1, 2)]
    assert hidden[0] == hidden[1] != hidden[2]
    damped = chosen_organ(anatomy, OrganChoice(damping_factor=3.0, lesions=NONE))
    assert damped.alpha == pytest.approx(3.0 * anatomy.scene.damping.alpha)


def test_the_map_is_stiff_where_touches_were():
    anatomy = load_anatomy(make_scene("phantom_small"))
    felt = FeltMap(anatomy)
    assert not felt.felt.any()
    radius, depth = anatomy.scene.instrument.tip_radius, anatomy.scene.palpation.press_depth
    healthy = felt._indenter.force(depth)
    middle = anatomy.mesh.points.mean(axis=0)
    places = []
    for aside, factor in ((-0.012, 1.0), (0.012, 2.0)):
        point, normal = anatomy.face.project(middle + aside * ASIDE + UP)
        places.append(point)
        for _ in range(5):
            felt.feel(point + normal * (radius - depth), depth, factor * healthy)
    assert felt.felt.any() and not felt.felt.all()
    for place, factor in zip(places, (1.0, 2.0), strict=True):
        nearest = np.argmin(np.linalg.norm(anatomy.mesh.points[felt.nodes] - place, axis=1))
        assert felt.felt[nearest] and felt.contrast[nearest] == pytest.approx(factor, rel=0.05)
    version = felt.version
    felt.feel(places[0] + radius * UP, 0.0, 1.0)
    felt.feel(places[0] + UP, depth, 1.0)
    assert felt.version == version
    felt.clear()
    assert not felt.felt.any()


def test_colours_go_from_soft_to_stiff():
    felt = SimpleNamespace(contrast=np.array([0.0, 1.0, 1.0, 1.0, 1.5, 9.0]), felt=np.arange(6) > 0)
    shares = contrast_shares(felt)
    assert shares[0] == 0.0 < shares[1] < shares[4] < shares[5] < 1.0 and shares[5] > 0.999
    assert not contrast_shares(SimpleNamespace(contrast=np.zeros(3), felt=np.zeros(3, dtype=bool))).any()
