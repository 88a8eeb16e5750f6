"""`surgsim haptics`: a trajectory and a bridge in real time, what it writes, and what it refuses."""

import csv
import re
import signal
import socket
import threading
from functools import partial

import numpy as np
import pytest

from surgsim_apps.cli.haptics import _packets_text
from surgsim_apps.cli.main import main
from surgsim_apps.haptics.pacing import SPIN, Pacer
from surgsim_apps.haptics.udp import UdpCounts
from tests.haptics.bench_hand import save_trajectory
from tests.haptics.test_docs import BRIDGE
from tests.haptics.udp_link import SharedTime


def test_trajectory_runs_to_its_end_and_is_written(tmp_path, capsys):
    way = np.outer([0, 0, 1, 1], [0.0, 0.0, -0.014])
    save_trajectory(tmp_path / "press.csv", np.array([0.0, 0.05, 0.45, 0.6]), way)
    out = tmp_path / "out"
    arguments = ["haptics", "--scene", "phantom_small", "--trajectory", str(tmp_path / "press.csv"), "--out", str(out)]
    assert main(arguments) == 0
    output = capsys.readouterr().out
    assert "coupling 500 N/m" in output and "haptic steps a second" in output
    with (out / "telemetry.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 601
    rate, late = re.search(
        r"([\d.]+) haptic steps a second; half began at most [\d.]+ ms late, 99 % at most ([\d.]+) ms", output
    ).groups()
    assert 0.0 < float(rate) < 1010.0
    assert 0.0 < float(late) <= 20.02
    assert float(rows[-1]["depth"]) > 1e-3
    assert float(rows[-1]["contact_force_z"]) > 0.02
    assert sorted(path.name for path in out.iterdir()) == ["telemetry.csv"]


def test_bridge_feels_the_organ(monkeypatch, capsys):
    """The documented client beside the command, in a time of their own: it is answered with the press's force."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared, clients, felt = SharedTime(), [], []
    names: dict = {}
    exec(compile(BRIDGE, "docs/haptics.md", "exec"), names)
    names["time"] = shared

    def client() -> None:
        way = iter(np.linspace(0.0, 0.020, 1000))
        names["bridge"](lambda: (0.0, 0.0, -next(way, 0.020)), lambda force: felt.append(force[2]), port, 2.0)
        shared.leave()

    class Paced(Pacer):
        """Begins together with the client."""

        def __init__(self, settings, timing) -> None:
            super().__init__(settings, timing, shared.monotonic, lambda span: shared.sleep(span + SPIN))
            clients.append(threading.Thread(target=client))
            clients[0].start()

    monkeypatch.setattr("surgsim_apps.cli.haptics.Pacer", Paced)
    assert main(["haptics", "--scene", "phantom_small", "--port", str(port), "--seconds", "2.0"]) == 0
    shared.leave()
    clients[0].join()
    assert max(felt) > 0.2
    assert int(re.search(r"(\d+) poses were received", capsys.readouterr().out)[1]) > 1900


def test_without_a_client_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr("surgsim_apps.cli.haptics.SILENCE", 0.02)
    assert main(["haptics", "--scene", "phantom_small", "--port", "0", "--seconds", "0.05"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines.count("nothing has connected yet") == 2 and lines[-1] == "Nothing has connected."


@pytest.mark.parametrize(
    ("counts", "numbers"),
    [
        ({"accepted": 5, "answered": 4, "unsent": 1}, ["5", "4", "1"]),
        ({"accepted": 5, "answered": 5, "malformed": 7, "stale": 8, "stranger": 9}, ["5", "7", "8", "9", "5"]),
        ({"malformed": 7}, ["7"]),
        ({}, []),
    ],
)
def test_the_end_gives_every_count_in_a_sentence(counts, numbers):
    assert re.findall(r"\d+", _packets_text(UdpCounts(**counts))) == numbers


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--scene", "phantom_smal"], "'phantom_small'"),
        (["--motion", "fre"], "'free'"),
        (["--apnoea"], "--apnoea"),
        (["--seconds", "nan"], "nan"),
        (["--device-damping", "-1"], "device damping is -1"),
        (["--device-damping", "1", "--trajectory", "nowhere.csv"], "--device-damping"),
        (["--trajectory", "nowhere.csv"], "nowhere.csv"),
        (["--port", "70000"], "70000"),
        (["--device-mass", "0.1"], "--device-damping"),
        (["--device-delay", "0"], "--device-damping"),
    ],
)
def test_bad_input_is_one_line(more, named, capsys):
    # Input that is accepted runs for ten steps.
    arguments = ["haptics", "--scene", "phantom_small", "--port", "0", "--seconds", "0.01", *more]
    assert main(arguments) == 2
    output = capsys.readouterr().err
    assert named in output and output.count("\n") == 1


def failing() -> None:
    """An error within a step."""
    raise ValueError


@pytest.mark.parametrize(
    ("end", "code"),
    [
        (partial(signal.raise_signal, signal.SIGINT), 0),
        (partial(signal.raise_signal, signal.SIGTERM), 0),
        (partial(signal.raise_signal, signal.SIGHUP), 0),
        (failing, 2),
    ],
)
def test_the_steps_until_an_end_are_kept_whole(tmp_path, monkeypatch, end, code):
    """Ctrl-C is how a run ends that has no end of its own."""
    # A shell's background jobs ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    class Interrupted(Pacer):
        def done(self, period) -> None:
            super().done(period)
            if self.steps == 25:
                end()
            self.steps += 1

        steps = 1

    monkeypatch.setattr("surgsim_apps.cli.haptics.Pacer", Interrupted)
    out = tmp_path / "out"
    try:
        assert main(["haptics", "--scene", "phantom_small", "--port", "0", "--out", str(out)]) == code
    finally:
        signal.signal(signal.SIGINT, before)
    assert [path.name for path in out.iterdir()] == ["telemetry.csv"]
    with (out / "telemetry.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert len(rows) == 26 and {len(row) for row in rows} == {len(rows[0])}
