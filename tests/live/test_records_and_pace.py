"""Memory that two processes share, and the clock that steps follow."""

import multiprocessing
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgsim_apps.haptics.pacing import CLASS_WIDTH, TIMING, Pacer, PaceSettings, quantile, timeliness
from surgsim_apps.live.exchange_records import LiveError, RecordedSteps, SharedRecord

PAIR = np.dtype([("one", "f8", (500,)), ("other", "f8", (500,))])


def write_forever(record: SharedRecord) -> None:
    """Ten times as often as the physics; one that never pauses would leave a reader on another core no whole copy."""
    value = 0.0
    while True:
        value += 1.0
        with record.writing() as now:
            now["one"] = value
            now["other"] = value
        time.sleep(50e-6)


@pytest.mark.slow
def test_a_reader_never_sees_half_a_record():
    record = SharedRecord(PAIR)
    writer = multiprocessing.get_context("spawn").Process(target=write_forever, args=(record,), daemon=True)
    writer.start()
    try:
        deadline = time.monotonic() + 600
        while record.read()["one"][0] == 0.0:
            assert time.monotonic() < deadline
        seen = set()
        while len(seen) < 100:
            assert time.monotonic() < deadline
            copy = record.read()
            assert (copy["one"] == copy["other"]).all() and (copy["one"] == copy["one"][0]).all()
            seen.add(float(copy["one"][0]))
    finally:
        writer.kill()
        writer.join()


def test_a_writer_that_died_in_the_middle_is_said_and_a_glance_never_waits():
    record = SharedRecord(PAIR)
    writing = record.writing()
    writing.__enter__()
    assert record.glance() is None
    with pytest.raises(LiveError, match="ended in the middle"):
        record.read()


class Clock:
    """Time that passes when somebody sleeps or looks."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        self.now += 1e-7
        return self.now

    def sleep(self, span):
        assert span > 0.0
        self.now += span


def made_pacer(**settings):
    clock, timing = Clock(), np.zeros((), dtype=TIMING)
    return Pacer(PaceSettings(**settings), timing, clock, clock.sleep), clock, timing


def test_steps_are_due_a_period_apart_whatever_they_take():
    pacer, clock, timing = made_pacer(period=0.001)
    began = []
    for step in range(1000):
        pacer.wait()
        began.append(clock.now)
        clock.now += 0.0002 + 0.0006 * (step % 2)
        pacer.done(0.001)
    assert np.diff(began) == pytest.approx(0.001, abs=2e-5)
    assert timing["steps"] == 1000 and timing["skipped"] == 0
    assert quantile(timing["late"], 0.99) == pytest.approx(CLASS_WIDTH)
    assert 0.0002 <= quantile(timing["spent"], 0.25) <= 0.0002 + 2 * CLASS_WIDTH


def test_a_short_delay_is_caught_up_and_a_long_one_is_skipped_and_counted():
    pacer, clock, timing = made_pacer(period=0.001, behind_most=0.010)
    pacer.wait()
    start = clock.now
    clock.now += 0.005
    for _ in range(20):
        pacer.wait()
        pacer.done(0.001)
    assert timing["skipped"] == 0 and clock.now - start == pytest.approx(0.020, abs=2e-4)
    clock.now += 0.0505
    pacer.wait()
    assert timing["skipped"] == pytest.approx(50, abs=1)
    before = clock.now
    pacer.wait()
    assert clock.now - before <= 0.0011
    assert timing["late_most"] == pytest.approx(0.0505, abs=1.1e-3)


def test_what_was_asked_for_is_not_late():
    pacer, clock, timing = made_pacer(period=0.001)
    pacer.wait()
    clock.now += 3.0
    pacer.start()
    pacer.wait()
    assert timing["skipped"] == 0 and timing["late_most"] < 1e-5


@pytest.mark.parametrize(
    ("period", "behind"), [(0.0, 0.02), (-1.0, 0.02), (0.001, 0.0001), (float("nan"), 0.02), (1.0, 99.0)]
)
def test_a_pace_that_is_none_is_refused(period, behind):
    with pytest.raises(ValueError, match="the rule is 0 < period"):
        PaceSettings(period, behind)


@given(st.lists(st.floats(0.0, 0.019), min_size=1, max_size=200), st.floats(0.01, 1.0))
def test_quantiles_are_those_of_the_values_to_a_class(values, share):
    counts = np.bincount((np.array(values) / CLASS_WIDTH).astype(int), minlength=1001)
    exact = float(np.sort(values)[max(0, int(np.ceil(share * len(values))) - 1)])
    assert exact - 1e-9 <= quantile(counts, share) <= exact + 2.0 * CLASS_WIDTH


def test_timeliness_is_of_what_lies_between():
    before, after = np.zeros((), dtype=TIMING), np.zeros((), dtype=TIMING)
    before["steps"], before["late"][3] = 1000, 1000
    after["steps"], after["late"][3], after["late"][50], after["simulated"] = 3000, 1000, 2000, 1.5
    kept = timeliness(before, after, 2.0)
    assert kept.rate == 1000.0 and kept.real_time == 0.75
    assert kept.late_p50 == kept.late_p99 == pytest.approx(51 * CLASS_WIDTH)


def test_recorded_steps_have_an_end():
    recorded = RecordedSteps(1, most=3)
    for step in range(3):
        assert not recorded.full
        recorded.append(step * 1e-3, np.ones((1, 3)), [1], np.zeros((1, 3)), np.zeros((1, 3)))
    assert recorded.full and recorded.steps["time"].tolist() == [0.0, 0.001, 0.002]
    recorded.clear()
    assert recorded.count == 0
