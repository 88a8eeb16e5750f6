"""`surgsim view` as a process: how it ends, what it leaves behind, what it says."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from surgsim_apps.cli import main as cli
from surgsim_apps.live.exchange_records import LiveError

REPOSITORY = Path(__file__).resolve().parents[2]
# A recording begins by itself once the page is served; time begins to pass for `--seconds` when it has some steps.
CHILD = """
import math
import sys
import time
from types import SimpleNamespace
from surgsim_apps.cli import view
from surgsim_apps.cli.main import main
from surgsim_apps.live.page import Page
from surgsim_apps.live.exchange_records import Record

class Recording(Page):
    begun, begin = False, math.inf

    def _attend(self, frame):
        if not self.begun:
            self.begun = True
            self.session.ask(Record(True))
        super()._attend(frame)
        if self.session.exchange.recorded.count > 100:
            Recording.begin = min(Recording.begin, time.monotonic())
            print("recording", flush=True)

if __name__ == "__main__":
    import surgsim_apps.live.page
    surgsim_apps.live.page.Page = Recording
    view.time = SimpleNamespace(monotonic=lambda: max(0.0, time.monotonic() - Recording.begin))
    sys.exit(main(["view", "--scene", "phantom_small", "--port", "0", *sys.argv[1:]]))
"""


def hear_signals() -> None:
    """Restore the defaults of SIGINT, which a shell's background jobs ignore, and of SIGHUP, which nohup ignores."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, None])
def test_a_recording_that_runs_is_written_however_it_ends(tmp_path, how):
    script, out = tmp_path / "view.py", tmp_path / "out"
    script.write_text(CHILD)
    given = [sys.executable, script, "--out", out, *(["--seconds", "0.2"] if how is None else [])]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    run = subprocess.Popen(given, stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=hear_signals)
    assert run.stdout is not None
    if how is not None:
        assert any(line == "recording\n" for line in run.stdout)
        run.send_signal(how)
    output, _ = run.communicate(timeout=600)
    assert run.returncode == (0 if how is None else 130)
    assert [path.name for path in out.iterdir()] == ["recording-1.csv"]
    assert "out: " in output and "steps written to recording-1.csv" in output
    table = np.genfromtxt(out / "recording-1.csv", delimiter=",", names=True)
    assert len(table) > 100 and np.allclose(np.diff(table["time"]), 1e-3, atol=1e-6)


def test_a_session_that_fails_is_said_in_one_line(monkeypatch, capsys):
    def fail(*_):
        raise LiveError("the physics' process died: why")

    monkeypatch.setattr("surgsim_apps.cli.view.View.run", fail)
    assert cli.main(["view"]) == 2
    assert capsys.readouterr().err == "surgsim: error: the physics' process died: why\n"


def test_a_motion_that_is_unknown_is_said_in_one_line(capsys):
    assert cli.main(["view", "--scene", "phantom_small", "--motion", "clam"]) == 2
    words = "motion 'clam' is unknown; the motions are none, calm, free; did you mean 'calm'?"
    assert capsys.readouterr().err == f"surgsim: error: {words}\n"
