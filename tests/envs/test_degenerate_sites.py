"""SurgSim/PalpateSites-v0: no degenerate strategy is paid as much as a plain raster of presses."""

from collections.abc import Iterator

import numpy as np
import pytest

from surgsim_apps.scoring.site_search import RasterSites
from surgsim_apps.training.site_agent import site_facts
from tests.envs.strategies import Now, mean_return, play

ID = "SurgSim/PalpateSites-v0"
SIDE = 3


def raster(now: Now) -> Iterator[np.ndarray]:
    """The honest agent: presses the middles of 3 x 3 fields, without even looking at what was felt."""
    agent = RasterSites(SIDE)
    agent.reset(now.rng, site_facts(now.env))
    while True:
        yield agent.act(now.observation)


# ---- degenerate strategies --------------------------------------------------------------------------------------


def stay_in_the_middle(now: Now) -> Iterator[np.ndarray]:
    while True:
        yield np.zeros(2)


def leave(now: Now) -> Iterator[np.ndarray]:
    """The corner of the face that is farthest from most lesions."""
    while True:
        yield np.ones(2)


def follow_the_border(now: Now) -> Iterator[np.ndarray]:
    corners = np.array([[-1, -1], [0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0]], dtype=float)
    while True:
        yield from corners


def follow_a_line(now: Now) -> Iterator[np.ndarray]:
    """To and fro on a diagonal."""
    way = np.linspace(-0.8, 0.8, 5)
    while True:
        yield from np.column_stack([way, way])
        way = way[::-1]


def shake(now: Now) -> Iterator[np.ndarray]:
    """Between two opposite corners."""
    while True:
        yield np.array([-1.0, -1.0])
        yield np.array([1.0, 1.0])


def jitter(now: Now) -> Iterator[np.ndarray]:
    """Near the middle, never twice at the same place."""
    while True:
        yield now.rng.uniform(-0.1, 0.1, 2)


def search_one_quarter(now: Now) -> Iterator[np.ndarray]:
    while True:
        yield now.rng.uniform(0.0, 1.0, 2)


def guess_late(now: Now) -> Iterator[np.ndarray]:
    """The middle till two presses are left, which go anywhere."""
    while now.task.budget - now.task.step_count > 2:
        yield np.zeros(2)
    while True:
        yield now.rng.uniform(-1.0, 1.0, 2)


def saturate(now: Now) -> Iterator[np.ndarray]:
    """The stiffest site of the healthy organ, for the largest force that a press can have."""
    charted = now.task.charted
    stiffness = [now.task.felt.healthy.stiffness(place) for place in charted.chart.sites]
    while True:
        yield charted.chart.sites[int(np.argmax(stiffness))]


def stay_at_the_stiffest(now: Now) -> Iterator[np.ndarray]:
    """Three presses anywhere, then the place of the largest contrast again and again."""
    felt = []
    for place in now.rng.uniform(-1.0, 1.0, (3, 2)):
        yield place
        felt.append((float(now["last_contrast"][0]), now["last_place"]))
    while True:
        yield max(felt, key=lambda press: press[0])[1]


def farm_found(now: Now) -> Iterator[np.ndarray]:
    """Told what is found: over a lesion till it is found, beside it till it is lost again, and so on."""
    truth = [now.task.charted.chart.place(point) for point in now.task.truth]
    lesion = truth[0] if truth else np.zeros(2)
    while True:
        away = lesion + 0.35 * np.array([np.cos(angle := now.rng.uniform(0.0, 2.0 * np.pi)), np.sin(angle)])
        yield away if now.task.found > 0.0 else lesion


def press_healthy_tissue(now: Now) -> Iterator[np.ndarray]:
    """Told where the lesions are: always as far from them as the face allows, so that nothing is claimed."""
    chart = now.task.charted.chart
    places = np.array([chart.place(point) for point in now.task.truth]).reshape(-1, 2)
    gaps = [np.linalg.norm(places - site, axis=1).min(initial=np.inf) for site in chart.sites]
    while True:
        yield chart.sites[int(np.argmax(gaps))]


DEGENERATE = {
    strategy.__name__: strategy
    for strategy in (
        stay_in_the_middle,
        leave,
        follow_the_border,
        follow_a_line,
        shake,
        jitter,
        search_one_quarter,
        guess_late,
        saturate,
        stay_at_the_stiffest,
        farm_found,
        press_healthy_tissue,
    )
}


# ---- played -----------------------------------------------------------------------------------------------------

SCENE = "phantom_small"


def test_the_best_paid_of_them_are_paid_less_than_a_raster():
    """On few presses."""
    best = {strategy.__name__: strategy for strategy in (follow_the_border, stay_at_the_stiffest, farm_found)}
    paid = play(ID, {"raster": raster, **best}, range(6), scene=SCENE, budget=SIDE**2)
    honest = mean_return(paid.pop("raster"))
    for name, records in paid.items():
        assert mean_return(records) < honest, name


@pytest.mark.slow
def test_no_degenerate_strategy_is_paid_like_a_raster():
    """All presses of an episode; about a minute of processor time."""
    paid = play(ID, {"raster": raster, **DEGENERATE}, range(8), scene=SCENE)
    honest = mean_return(paid.pop("raster"))
    for name, records in paid.items():
        assert mean_return(records) < honest, name
