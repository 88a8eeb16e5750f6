"""No more pictures are made than the slowest browser draws."""

import struct

import pytest

from surgsim_env.live.messages import DrawingReport, InvalidMessageError, read_report
from surgsim_env.live.page import RATE_LEAST, RATE_MOST, REPORT_AGE_MOST, PictureRate
from tests.live.packets import write_report


def test_the_slowest_browser_sets_the_rate_and_its_closing_frees_it():
    now = [0.0]
    rate = PictureRate(lambda: now[0])
    assert rate.rate == RATE_MOST and rate.slowest is None
    for _ in range(40):
        now[0] += 1.0
        rate.report(1, 60.0)
        rate.report(2, 12.0)
    assert rate.slowest == 12.0 and 8.0 < rate.rate <= 12.0
    rate.report(2, 0.0)
    for _ in range(20):
        rate.report(2, 0.0)
    assert rate.rate == RATE_LEAST
    rate.forget(2)
    for _ in range(40):
        rate.report(1, 60.0)
    assert rate.rate == RATE_MOST


def test_a_tab_that_sleeps_counts_no_more():
    now = [0.0]
    rate = PictureRate(lambda: now[0])
    rate.report(1, 1.0)
    now[0] += REPORT_AGE_MOST + 0.1
    assert rate.slowest is None
    rate.forget(1)
    assert rate.rate == RATE_MOST


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), -1.0, 1e9])
def test_a_rate_that_is_none_is_nonsense(rate):
    with pytest.raises(InvalidMessageError, match="frames a second"):
        read_report(write_report(DrawingReport(rate, False)))


@pytest.mark.parametrize("flags", [(2, 0), (0, 2), (1, 0xFFFF)])
def test_a_flag_that_is_none_is_nonsense(flags):
    with pytest.raises(InvalidMessageError, match="counted"):
        read_report(struct.pack("<fHH", 30.0, *flags))


@pytest.mark.parametrize("report", [DrawingReport(30.0, False), DrawingReport(0.0, True), DrawingReport(None, True)])
def test_a_report_arrives_as_it_was_sent(report):
    assert read_report(write_report(report)) == report
    assert read_report(b"0" * 16) is None and read_report("text") is None
