"""A whole session behind a page, at the protocol's level: hands, tabs that close, slow clients, recordings."""

import asyncio
import os

import numpy as np
import pytest

from surgsim_apps.live.exchange_records import Record, Reset
from surgsim_apps.live.messages import HandMotion
from surgsim_apps.live.session import HAND_SPEED, HELD
from tests.live.packets import write_hand
from tests.live.protocol_client import ProtocolClient, press_path
from tests.live.served import SECONDS, wait_until

pytestmark = pytest.mark.usefixtures("fresh")


def test_a_client_presses_and_is_sent_a_moving_organ(served):
    path = press_path(served.session.anatomy)
    rest = served.session.anatomy.mesh.points
    client = ProtocolClient(served.address, path, rate=30.0)
    client.start()
    try:
        wait_until(lambda: served.force > 0.08)
        moved = np.linalg.norm(served.session.frame()["node"] - rest, axis=1).max()
        assert moved > 0.0005
        wait_until(lambda: client.updates > 30 and client.bytes > 30 * 4000)
        assert (served.session.trace()["peak"] > 0.02).any()
        wait_until(lambda: served.page.felt.felt.any())
    finally:
        client.stop()
    assert not client.errors


def test_a_client_that_takes_nothing_is_not_waited_for(served):
    """The other one's pictures and the physics go on as without it."""
    stuck, quick = ProtocolClient(served.address, pause=SECONDS), ProtocolClient(served.address)
    stuck.start()
    quick.start()
    try:
        wait_until(lambda: stuck.updates >= 1 and quick.updates >= 5)
        steps, pictures, updates = served.session.timing()[0]["steps"], served.page.pictures, quick.updates
        wait_until(lambda: served.session.timing()[0]["steps"] > steps + 500)
        wait_until(lambda: served.page.pictures > pictures + 60 and quick.updates > updates + 60)
        assert stuck.updates == 1
        assert len(served.page.server.viser.get_clients()) == 2
    finally:
        quick.stop()
        stuck.stop()
    assert not quick.errors


def beats(served, count):
    """Until the hands have been moved some times, by keys that are held."""
    before = int(served.session.exchange.hand.peek["beat"])
    wait_until(lambda: int(served.session.exchange.hand.peek["beat"]) > before + count)


def test_keys_move_the_hand_and_let_go_with_the_tab(served, monkeypatch):
    session, clock, heard = served.session, served.hand_clock, []
    push = session.push
    monkeypatch.setattr(session, "push", lambda motion: (push(motion), heard.append(motion)))

    async def hold():
        async with served.hand_socket() as socket:
            await socket.send(write_hand(HandMotion((0.0, 0.0, 1.0), 0)))
            await asyncio.to_thread(wait_until, lambda: heard)
            clock.now += 0.1
            await asyncio.to_thread(beats, served, 2)

    before = session.targets[0].copy()
    asyncio.run(hold())
    np.testing.assert_allclose(session.targets[0] - before, 0.1 * HAND_SPEED * session.directions[2], atol=1e-12)
    still = session.targets[0]
    clock.now += HELD
    beats(served, 2)
    clock.now += 1.0
    beats(served, 2)
    assert np.array_equal(session.targets[0], still)


def test_the_other_arm_of_one_is_the_same(served):
    """Keys go on moving the only tip after X was pressed, which a page of one arm does not know to leave alone."""
    session = served.session
    before = session.targets
    session.push(HandMotion((0.0, 0.0, 1.0), 1))
    served.hand_clock.now += 0.1
    beats(served, 2)
    np.testing.assert_allclose((session.targets - before)[0], 0.1 * HAND_SPEED * session.directions[2], atol=1e-12)
    session.push(HandMotion((0.0, 0.0, 0.0), 1))


def test_two_tabs_share_one_organ_and_one_may_go(served):
    path = press_path(served.session.anatomy)
    first, second = ProtocolClient(served.address, path), ProtocolClient(served.address)
    first.start()
    second.start()
    try:
        wait_until(lambda: first.updates > 10 and second.updates > 10)
        first.stop()
        updates = second.updates
        wait_until(lambda: second.updates > updates + 10)
        wait_until(lambda: len(served.page.server.viser.get_clients()) == 1)
    finally:
        first.stop()
        second.stop()
    assert not second.errors


def test_a_client_that_is_not_let_in_or_sends_no_more_says_so(served):
    stranger = ProtocolClient(served.address + "x")
    stranger.start()
    wait_until(lambda: stranger.errors)
    assert "401" in stranger.errors[0]

    def path(time):
        raise ValueError("no such place")

    lame = ProtocolClient(served.address, path)
    lame.start()
    try:
        wait_until(lambda: lame.errors)
    finally:
        lame.stop()
    assert "no such place" in lame.errors[0]


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
