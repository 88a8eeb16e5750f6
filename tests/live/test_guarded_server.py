"""The server itself, at the protocol's level: what is answered, what is refused, and who survives whom."""

import asyncio
import contextlib
import http.client
import time

import msgspec.msgpack
import pytest
import viser
from viser import _messages
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from surgsim_env.live.exchange_records import LiveError
from surgsim_env.live.guarded_server import MESSAGE_SIZE_MOST, SOCKETS_MOST, GuardedServer
from surgsim_env.live.messages import MessageFilter
from surgsim_env.live.protocol_client import CAMERA
from tests.live.served import SECONDS

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def server():
    async def serve_hand(connection):
        with contextlib.suppress(ConnectionClosed):
            while True:
                await connection.send(await connection.recv())

    made = GuardedServer("127.0.0.1", 0, remote=False, message_filter=MessageFilter(), serve_hand=serve_hand)
    yield made
    made.stop()


def get(server, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.gate.port, timeout=SECONDS)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), answer.headers


def own(server) -> str:
    return f"http://127.0.0.1:{server.gate.port}"


def joined(server, path="/", **options):
    given = {
        "origin": own(server),
        "additional_headers": {"Cookie": f"{server.gate.cookie}={server.gate.token}"},
        "subprotocols": [PROTOCOL] if path == "/" else None,
        "max_size": None,
        "compression": None,
        "open_timeout": SECONDS,
        "ping_interval": None,
    }
    return connect(f"ws://127.0.0.1:{server.gate.port}{path}", **{**given, **options})


async def replayed(socket) -> None:
    """Say where the camera is, and take what a new page is sent."""
    await socket.send(msgspec.msgpack.encode(CAMERA))
    await asyncio.wait_for(socket.recv(), SECONDS)


async def is_dropped(socket, message) -> int:
    """The code that the server closes with after a message."""
    await socket.send(message)
    with pytest.raises(ConnectionClosed) as closed:
        for _ in range(1000):
            await asyncio.wait_for(socket.recv(), SECONDS)
    return closed.value.rcvd.code


def test_the_page_comes_with_the_token_alone(server):
    assert get(server, "/")[0] == 401
    status, body, headers = get(server, f"/?token={server.gate.token}")
    assert status == 200 and b"getGamepads" in body and int(headers["Content-Length"]) == len(body)
    cookie = headers["Set-Cookie"].split(";")[0]
    assert get(server, "/", Cookie=cookie)[0] == 200
    assert get(server, "/", Cookie=cookie, Host="evil.example")[0] == 421
    assert get(server, "/", Cookie=cookie, Origin="http://evil.example")[0] == 403
    assert get(server, "/../../etc/passwd", Cookie=cookie)[0] == 404
    assert get(server, "/%2e%2e/%2e%2e/infra/_infra.py", Cookie=cookie)[0] == 404


def test_a_request_that_takes_no_packing_is_answered(server):
    """As plain curl asks: without Accept-Encoding."""
    connection = http.client.HTTPConnection("127.0.0.1", server.gate.port, timeout=SECONDS)
    connection.putrequest("GET", f"/?token={server.gate.token}", skip_accept_encoding=True)
    connection.endheaders()
    assert connection.getresponse().status == 200


@pytest.mark.parametrize("path", ["/", "/hand", "/elsewhere"])
@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"origin": None}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"additional_headers": {}}, 401),
        ({"additional_headers": {"Cookie": "surgsim_1=x"}}, 401),
    ],
)
def test_no_socket_is_accepted_without_all_three(server, path, options, status):
    async def attempt():
        async with joined(server, path, **options):
            pass

    with pytest.raises(InvalidStatus) as refused:
        asyncio.run(attempt())
    assert refused.value.response.status_code == status


def test_the_share_handler_is_gone(server):
    handlers = server.viser._websock_server._incoming_handlers
    assert _messages.ShareUrlRequest not in handlers and _messages.ShareUrlDisconnect not in handlers
    with pytest.raises(RuntimeError, match="never opens a public tunnel"):
        server.viser.request_share_url()

    async def attempt():
        async with joined(server) as socket:
            await replayed(socket)
            return await is_dropped(socket, msgspec.msgpack.encode({"type": "ShareUrlRequest"}))

    assert asyncio.run(attempt()) == 1008
    assert server.viser._share_tunnel is None


NONSENSE = {
    "no messagepack": (b"\xc1\xc1", 1008),
    "text": ("hello", 1008),
    "a map without a type": (msgspec.msgpack.encode({"a": 1}), 1008),
    "an unknown type": (msgspec.msgpack.encode({"type": "NoSuchMessage"}), 1008),
    "a server's own message": (msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "1"}), 1008),
    "nan": (msgspec.msgpack.encode({**CAMERA, "fov": float("nan")}), 1008),
    "huge": (b"\xc4" + bytes(MESSAGE_SIZE_MOST + 1), 1009),
}


@pytest.mark.parametrize("kind", NONSENSE)
def test_a_tab_that_sends_nonsense_is_dropped_and_the_other_lives(server, kind):
    message, code = NONSENSE[kind]

    async def attempt():
        async with joined(server) as good, joined(server) as bad:
            await replayed(good)
            await replayed(bad)
            assert await is_dropped(bad, message) == code
            server.viser.scene.add_frame(f"/{kind.replace(' ', '_')}")
            assert await asyncio.wait_for(good.recv(), SECONDS)

    asyncio.run(attempt())


def test_a_flood_is_dropped(server):
    async def attempt():
        async with joined(server) as socket:
            message = msgspec.msgpack.encode(CAMERA)
            with pytest.raises(ConnectionClosed) as closed:
                for _ in range(20_000):
                    await socket.send(message)
                await asyncio.wait_for(socket.wait_closed(), SECONDS)
                await socket.send(message)
            return closed.value.rcvd.code

    assert asyncio.run(attempt()) == 1008


def test_hands_have_a_path_of_their_own(server):
    async def attempt():
        async with joined(server, "/hand") as socket:
            await socket.send(b"0123456789abcdef")
            return await asyncio.wait_for(socket.recv(), SECONDS)

    assert asyncio.run(attempt()) == b"0123456789abcdef"


def test_tabs_come_and_go(server):
    """Closed with and without a goodbye; the list of clients is empty again in the end."""

    async def attempt():
        async with joined(server) as one, joined(server) as other:
            for socket in (one, other):
                await replayed(socket)
            await wait_until(lambda: len(server.viser.get_clients()) == 2)
            one.transport.abort()
        await wait_until(lambda: not server.viser.get_clients())

    asyncio.run(attempt())


def test_there_is_an_end_to_sockets(server):
    async def attempt():
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(SOCKETS_MOST):
                await stack.enter_async_context(joined(server, "/hand"))
            with pytest.raises(InvalidStatus) as refused:
                await stack.enter_async_context(joined(server, "/hand"))
            assert refused.value.response.status_code == 503

    asyncio.run(attempt())


def test_it_listens_on_loopback_alone(server):
    assert server._listening.getsockname()[0] == "127.0.0.1"
    assert server.address == f"http://127.0.0.1:{server.gate.port}/?token={server.gate.token}"


def test_a_viser_that_serves_beside_the_gate_is_refused(monkeypatch):
    """Where the call that is guarded is not made, nothing is served."""
    from surgsim_env.live import guarded_server

    class OtherViser:
        def __init__(self, **_):
            self.stopped = False

        def stop(self):
            self.stopped = True

    monkeypatch.setattr(guarded_server.viser, "ViserServer", OtherViser)
    with pytest.raises(LiveError, match="cannot guard"):
        GuardedServer("127.0.0.1", 0, remote=False, message_filter=MessageFilter(), serve_hand=None)


async def wait_until(condition, seconds=SECONDS):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)
