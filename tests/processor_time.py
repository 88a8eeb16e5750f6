"""A plugin of pytest that prints which tests take the most processor time, their fixtures and processes included.

    make test PYTEST_ARGS="-n 2 --dist loadfile -p tests.processor_time"

Processor time says more than `--durations` where other programs run beside. A process that a fixture has started counts
with the test after which it ends.
"""

import resource
from collections import Counter

import pytest

LONGEST = 20
USED = pytest.StashKey[float]()


def used() -> float:
    """Processor time of this process, its threads, and those of its processes that have ended [s]."""
    parts = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(part.ru_utime + part.ru_stime for part in parts)


def pytest_collection_finish(session: pytest.Session) -> None:
    session.stash[USED] = used()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo):
    report, now = (yield).get_result(), used()
    report.processor_time = now - item.session.stash[USED]
    item.session.stash[USED] = now


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    spent: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            # The controller of several workers takes what its workers report.
            spent[getattr(report, "nodeid", "")] += getattr(report, "processor_time", 0.0)
    terminalreporter.section(f"{LONGEST} longest of {spent.total():.0f} s of processor time")
    for name, seconds in spent.most_common(LONGEST):
        terminalreporter.line(f"{seconds:7.1f} s  {name}")
