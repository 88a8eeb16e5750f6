"""What the panel and the browser ask of a page, as their own messages: settings, recordings, plain pictures."""

import asyncio
import os

import numpy as np
import pytest

from surgsim_env.live.exchange_records import Pause, Phase, Record, Reset
from surgsim_env.live.messages import DrawingReport, HandMotion
from surgsim_env.live.protocol_client import ProtocolClient, press_path
from tests.live.packets import write_hand, write_report
from tests.live.served import send, setting, wait_until

pytestmark = pytest.mark.usefixtures("fresh")


def has_place(session) -> bool:
    """Whether some recorded step has a hand's place."""
    return bool(np.isfinite(session.exchange.recorded.steps["hand"]).all(axis=2).any())


def test_panel_settings_reach_the_physics(served):
    """A slider's own message, as a browser sends it; one beyond its range changes nothing."""
    panel, session = served.page._panel, served.session

    organ = int(session.frame()["organ"])
    asyncio.run(send(served, setting(panel._modulus, 9.0), until=lambda: int(session.frame()["organ"]) > organ))
    assert session.choice.modulus_factor == pytest.approx(9.0 / (session.scene.material.youngs_modulus / 1e3))
    ignored = served.page._message_filter.ignored
    beyond = (setting(panel._modulus, 1e9), setting(panel._lesions, "all of them"))
    asyncio.run(send(served, *beyond, until=lambda: served.page._message_filter.ignored >= ignored + 2))
    assert served.page._message_filter.ignored == ignored + 2 and panel._modulus.value == 9.0
    asyncio.run(send(served, setting(panel._pause, True), until=lambda: session.frame()["phase"] == Phase.PAUSED))
    session.ask(Pause(False))
    wait_until(lambda: session.frame()["phase"] == Phase.RUNNING)


def test_a_click_means_what_the_physics_is_doing(served, monkeypatch, tmp_path):
    """Whatever the button's name says: names are never renewed here."""
    panel, session = served.page._panel, served.session
    monkeypatch.setattr(served.page, "_out", tmp_path)
    monkeypatch.setattr("surgsim_env.live.panel._set", lambda *_: None)
    for phase in (Phase.PAUSED, Phase.RUNNING):
        clicked = setting(panel._pause, True)
        asyncio.run(send(served, clicked, until=lambda phase=phase: session.frame()["phase"] == phase))
    clicked = setting(panel._record, True)
    # A recording without a hand's place is not written.
    asyncio.run(send(served, clicked, until=lambda: session.frame()["recording"] and has_place(session)))
    asyncio.run(send(served, clicked, until=lambda: not session.frame()["recording"]))
    wait_until((tmp_path / "recording-1.csv").is_file)


def test_buttons_are_renamed_with_the_next_picture(served, monkeypatch):
    panel, session = served.page._panel, served.session
    # They do not wait for the words that are said twice a second.
    monkeypatch.setattr(served.page, "_say", lambda _: None)
    session.ask(Pause(True))
    wait_until(lambda: panel._pause.label == "Continue")
    session.ask(Pause(False))
    wait_until(lambda: panel._pause.label == "Pause")


def test_a_recording_shorter_than_a_picture_is_written(served, monkeypatch, tmp_path):
    session = served.session
    monkeypatch.setattr(served.page, "_out", tmp_path)
    with monkeypatch.context() as patch:
        # The page does not look while it runs.
        patch.setattr(served.page, "_attend", lambda _: None)
        session.ask(Record(True))
        wait_until(lambda: session.frame()["recording"] and has_place(session))
        session.ask(Record(False))
        wait_until(lambda: not session.frame()["recording"])
    wait_until((tmp_path / "recording-1.csv").is_file)


def test_a_recording_is_written_to_its_folder_alone(served):
    session = served.session
    session.ask(Record(True))
    wait_until(lambda: session.frame()["recording"])
    wait_until(lambda: session.exchange.recorded.count > 100)
    session.ask(Record(False))
    # While it is written, a part of it lies beside it.
    wait_until(lambda: served.out.is_dir() and os.listdir(served.out) == ["recording-1.csv"])
    stopped = session.frame()["time"]
    session.ask(Reset())
    wait_until(lambda: session.frame()["time"] < stopped)


def test_plain_pictures_have_fewer_triangles_and_keep_the_paint(served):
    """Whoever changes it, and whatever is painted meanwhile; lesions that are shown stay so."""
    organ = served.page._organ
    fine = len(organ._organ.faces)
    client = ProtocolClient(served.address, press_path(served.session.anatomy), rate=30.0)
    client.start()
    try:
        wait_until(lambda: served.page.felt.felt.any())
        served.page._show_lesions(True)
        for plain in (True, False, True, False):
            served.page.show_plain(plain)
            made = served.page.pictures
            wait_until(lambda made=made: served.page.pictures > made + 3)
            assert (len(organ._organ.faces) < fine) == plain and len(organ._organ.vertices) > organ._organ.faces.max()
            assert served.page._panel._plain.value == plain
            for paint in organ._paint:
                assert not len(paint._used) or paint._used.max() < len(organ._organ.vertices)
            wait_until(lambda: any(len(paint._used) for paint in organ._paint))
        served.page._show_lesions(False)
    finally:
        client.stop()
    assert not client.errors


def report_of(served, monkeypatch, software, rate=None):
    """What a tab says of its drawing, until the page has attended to it."""
    heard, attended = [], []
    push, attend = served.session.push, served.page._attend

    async def attempt():
        async with served.socket("/hand") as socket:
            await socket.send(write_report(DrawingReport(rate, software)))
            await socket.send(write_hand(HandMotion((0.0, 0.0, 0.0), 0)))
            await asyncio.to_thread(wait_until, lambda: heard)

    with monkeypatch.context() as patched:
        patched.setattr(served.session, "push", lambda motion: (push(motion), heard.append(motion)))
        asyncio.run(attempt())
        patched.setattr(served.page, "_attend", lambda frame: (attend(frame), attended.append(frame)))
        wait_until(lambda: len(attended) > 1)


@pytest.mark.slow
def test_a_browser_without_a_graphics_card_is_drawn_for_plainly_until_its_user_says_otherwise(served, monkeypatch):
    page = served.page
    page._plain, page._tabs.software = None, False
    report_of(served, monkeypatch, False, 60.0)
    assert page._plain is None
    report_of(served, monkeypatch, True)
    assert page._plain
    asyncio.run(send(served, setting(page._panel._plain, False), until=lambda: page._plain is False))
    report_of(served, monkeypatch, True)
    assert page._plain is False and not page._panel._plain.value
