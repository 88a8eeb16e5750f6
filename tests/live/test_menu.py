"""A page after another on the same server, as the panel's menu asks for."""

import asyncio

import pytest

from surgsim_apps.live.messages import HandMotion
from surgsim_apps.live.page import Page, Tabs
from surgsim_apps.live.session import Session
from surgsim_env.scene.load import make_scene
from tests.live.packets import write_hand
from tests.live.protocol_client import ProtocolClient
from tests.live.served import PACE, Served, on_a_fast_machine, wait_until


def test_another_scene_is_shown_in_the_same_tabs(tmp_path):
    tabs = Tabs(0)
    client, pages = ProtocolClient(tabs.server.address), []
    try:
        client.start()
        for scene, then in (("phantom_small", ("phantom_small", "psm_palpator")), ("phantom_small", None)):
            session = Session(on_a_fast_machine(make_scene(scene)), pace=PACE)
            try:
                session.wait()
                page = Page(session, tabs, tmp_path, (scene, None))
                pages.append(page)
                updates = client.updates
                page.run(lambda updates=updates: client.updates > updates + 10)
                heard = []
                session.push = heard.append
                asyncio.run(_send(tabs, write_hand(HandMotion((1.0, 0.0, 0.0), 0))))
                wait_until(lambda heard=heard: heard)
                if then is not None:
                    page._panel._calls["open"](*then)
                    page.run(lambda: False)
                    (opened, chosen) = page.wanted
                    assert opened == then and chosen.instrument != session.scene.instrument
                    page.clear()
            finally:
                session.close()
    finally:
        client.stop()
        tabs.server.stop()
    assert not client.errors and len(pages) == 2


async def _send(tabs: Tabs, packet: bytes) -> None:
    async with Served.hand_socket_of(tabs.server.address) as socket:
        await socket.send(packet)
        await asyncio.sleep(0.2)


@pytest.mark.usefixtures("fresh")
def test_a_scene_that_cannot_be_opened_is_refused_in_words(served):
    page = served.page
    page._open("phantom_smal", None)
    assert page.wanted is None and "phantom_small" in page._message
