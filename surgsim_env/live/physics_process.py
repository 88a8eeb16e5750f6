"""The process that a live session's physics runs in: first in line for the processor, and gone with its page."""

import contextlib
import ctypes
import gc
import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path

from surgsim_env.live.exchange_records import Exchange
from surgsim_env.live.physics import Physics, Setup

# Unix's measure of how gladly a process lets others go first: below 0 is for administrators.
NICENESS = -10


def run_physics(setup: Setup, exchange: Exchange, requests: Connection, parent: int) -> None:
    """The child's whole life; it ends on request, or when the process with the id `parent` is gone.

    What refuses to begin is told through `requests` as a text, and the process ends with status 1.
    """
    # Ctrl-C is the page's to answer; it ends the physics in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _sleep_sharply()
    _go_first()
    try:
        physics = Physics(setup, exchange, requests)
    except (ValueError, OSError) as error:
        with contextlib.suppress(OSError):
            requests.send(str(error))
        sys.exit(1)
    # What is there by now stays; nothing that is made in a step lies in a cycle.
    gc.collect()
    gc.freeze()
    gc.disable()
    physics.run(lambda: os.getppid() == parent)


def _go_first() -> None:
    """Ask for the processor before pictures and browsers; where that is not allowed, all wait in line.

    Linux shares it first between sessions and then within each, by niceness: so the physics is a session of its own.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setsid()
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICENESS))


def _sleep_sharply() -> None:
    """Ask Linux to end sleeps when they are over, not up to 50 us later; elsewhere nothing is done."""
    if sys.platform == "linux":
        set_timer_slack = 29
        ctypes.CDLL(None).prctl(set_timer_slack, 1, 0, 0, 0)
