"""The game of the live page, and touches of the pointer."""

from datetime import date

import numpy as np
import pytest

from surgsim_apps.live.lesion_search import LesionSearch
from surgsim_apps.live.organ_choice import HIDDEN, OrganChoice, chosen_lesions
from surgsim_apps.live.session import CLEARANCE
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from tests.live.served import wait_until

DAY = date(2026, 11, 29)


@pytest.fixture(scope="module")
def anatomy():
    return load_anatomy(make_scene("phantom_small"))


def searched(anatomy, aside=0.0, presses=1, force=0.2):
    """The guess of a search by presses beside the lesion [m]."""
    search = LesionSearch(anatomy, DAY)
    search.begin()
    lesions = chosen_lesions(anatomy, OrganChoice(lesions=HIDDEN, seed=search.seed))
    over, outward = anatomy.face.project(lesions[0].centre)
    middle, _ = anatomy.face.project(anatomy.mesh.points.mean(axis=0) + 0.1 * outward)
    tip = over + aside * (middle - over) / np.linalg.norm(middle - over)
    for _ in range(presses):
        for reading in (0.0, force, 0.5 * force, 0.0):
            search.feel(tip, reading)
    # Above the surface, on the way out.
    search.feel(tip + 0.02 * outward + 0.01, 0.0)
    search.mark(lesions)
    return search


def test_the_lesion_of_a_day_is_the_same_for_everybody(anatomy):
    first, again, tomorrow = (
        LesionSearch(anatomy, DAY),
        LesionSearch(anatomy, DAY),
        LesionSearch(anatomy, date(2026, 11, 30)),
    )
    for search in (first, again, tomorrow):
        search.begin()
    assert first.seed == again.seed != tomorrow.seed
    again.begin()
    assert len({first.seed, again.seed, tomorrow.seed}) == 3


def test_the_guess_is_the_place_of_the_last_press(anatomy):
    guess = searched(anatomy).guess
    assert guess.error < 0.001 and guess.presses == 1 and guess.force_peak == 0.2 and guess.points > 95
    assert searched(anatomy, aside=0.005).guess.error == pytest.approx(0.005, abs=0.0015)


def test_error_presses_and_force_cost_points(anatomy):
    best, hard = searched(anatomy).guess.points, anatomy.scene.limits.hard_force
    assert searched(anatomy, aside=0.005).guess.points < best
    assert searched(anatomy, presses=10).guess.points == best - 9
    assert searched(anatomy, force=hard).guess.points == best - 50


def test_a_search_without_a_press_goes_on(anatomy):
    search = LesionSearch(anatomy, DAY)
    search.begin()
    search.feel(np.zeros(3), 0.0)
    search.mark(chosen_lesions(anatomy, OrganChoice(lesions=HIDDEN, seed=search.seed)))
    assert search.open and search.guess is None


@pytest.mark.usefixtures("fresh")
def test_a_touch_comes_from_above_slides_and_leaves(served):
    session, anatomy = served.session, served.session.anatomy
    radius, depth = session.scene.instrument.tip_radius, session.scene.palpation.press_depth
    out, away = session.directions[2], session.directions[1]
    place, outward = anatomy.face.project(anatomy.mesh.points.mean(axis=0) + 0.1 * out - 0.010 * away)

    def wait_for_beats() -> None:
        before = int(session.exchange.hand.peek["beat"])
        wait_until(lambda: int(session.exchange.hand.peek["beat"]) > before + 1)

    def height() -> float:
        return float((session.targets[0] - place) @ outward) - radius

    def aside(from_place) -> float:
        way = session.targets[0] - from_place
        return float(np.linalg.norm(way - (way @ outward) * outward))

    session.touch(0, place, outward, depth)
    deepest_beside = []
    while height() > -0.99 * depth:
        served.hand_clock.now += 0.01
        wait_for_beats()
        if aside(place) > 0.001:
            deepest_beside.append(height())
    assert min(deepest_beside) > 0.5 * CLEARANCE
    wait_until(lambda: served.force > 0.05)
    # A slide stays in the tissue.
    beside = place + 0.006 * (away - (away @ outward) * outward)
    session.touch(0, beside, outward, depth)
    while aside(beside) > 1e-4:
        served.hand_clock.now += 0.01
        wait_for_beats()
        assert height() == pytest.approx(-depth, abs=1e-4)
    session.lift(0)
    served.hand_clock.now += 1.0
    for _ in range(40):
        served.hand_clock.now += 0.05
        wait_for_beats()
    assert height() == pytest.approx(CLEARANCE, abs=1e-4) and aside(beside) < 1e-4
