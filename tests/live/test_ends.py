"""End of a session: with its page, without its physics, or before it begins."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from surgsim_apps.live.exchange_records import LiveError
from surgsim_apps.live.organ_choice import HIDDEN, OrganChoice
from surgsim_apps.live.page import Page, Tabs
from surgsim_apps.live.session import Session
from surgsim_env.scene.load import make_scene
from tests.live.served import PACE, on_a_fast_machine, wait_until

REPOSITORY = Path(__file__).resolve().parents[2]


CHILD = """
import sys, time
from surgsim_apps.live.session import Session
from surgsim_apps.haptics.pacing import PaceSettings
from surgsim_env.scene.load import make_scene
if __name__ == "__main__":
    session = Session(on_a_fast_machine(make_scene("phantom_small")), pace=PaceSettings(period=0.01))
    session.wait()
    print(session._process.pid, flush=True)
    time.sleep(600)
"""


@pytest.mark.slow
def test_the_physics_ends_with_a_page_that_was_killed(tmp_path):
    script = tmp_path / "page.py"
    script.write_text(CHILD)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert _lives(child)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until(lambda: not _lives(child))


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.slow
def test_a_physics_that_dies_is_said(tmp_path):
    session = Session(on_a_fast_machine(make_scene("phantom_small")), pace=PACE)
    page = None
    try:
        session.wait()
        page = Page(session, Tabs(0), tmp_path)
        session._process.kill()
        with pytest.raises(LiveError, match="physics' process died"):
            page.run(lambda: False)
    finally:
        if page is not None:
            page.server.stop()
        session.close()


def test_why_the_physics_refused_is_said(monkeypatch):
    """A fault only the child finds."""
    monkeypatch.setattr(
        "surgsim_apps.live.session.OrganChoice", lambda lesions: OrganChoice(lesions=HIDDEN, lesion_ratio=1e6)
    )
    session = Session(on_a_fast_machine(make_scene("phantom_small")), pace=PACE)
    try:
        with pytest.raises(LiveError, match=r"physics' process died: .*step"):
            session.wait()
    finally:
        session.close()
