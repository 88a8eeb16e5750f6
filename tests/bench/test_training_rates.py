"""Rates of training: what is listed of them, and what is absent with its reason; nothing looks at how long it takes."""

from surgsim_apps.bench import training
from surgsim_apps.bench.measurement import QUICK
from surgsim_apps.bench.report import AbsentError


def test_rates_are_medians_and_what_cannot_run_says_why(monkeypatch):
    def step(figure, effort):
        if "pictures" in figure.case:
            raise AbsentError("no OpenGL here")
        clock = training.Clock()
        clock.rates = {training.WALL: [100.0, 500.0, 300.0], training.PROCESSOR: [50.0, 60.0, 70.0]}
        return clock

    def learn(figure, effort):
        raise AbsentError("stable-baselines3 cannot be imported")

    monkeypatch.setattr(training, "step", step)
    monkeypatch.setattr(training, "learn", learn)
    figures = {(figure.case, figure.quantity): figure for figure in training.measure(QUICK).figures}
    assert figures["Palpate, phantom_small, memory", "stepping, wall"].value == 300.0
    assert figures["Palpate, phantom_small, memory", "stepping, processor"].value == 60.0
    absent = figures["Retract, pictures", "stepping, wall"]
    assert absent.value is None and absent.note == "no OpenGL here"
    assert sum(figure.note == "stable-baselines3 cannot be imported" for figure in figures.values()) == 3


def test_a_round_ends_where_the_next_begins(monkeypatch):
    """Two rounds of 100 and 300 steps, after 1 s and 3 s of wall clock, 0.5 s and 1 s of processor time."""
    walls, processors = iter([10.0, 11.0, 13.0]), iter([1.0, 1.5, 2.0])
    monkeypatch.setattr(training.time, "perf_counter", lambda: next(walls))
    monkeypatch.setattr(training.time, "process_time", lambda: next(processors))
    clock = training.Clock()
    clock.end_round(100)
    clock.end_round(300)
    assert clock.rates == {training.WALL: [100.0, 150.0], training.PROCESSOR: [200.0, 600.0]}
