"""The server itself, at the protocol's level: what is answered, what is refused, and who survives whom."""

import asyncio
import base64
import contextlib
import http.client
import logging
import socket
import struct
import threading
import time

import msgspec.msgpack
import pytest
import viser
from viser import _messages
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, InvalidMessage, InvalidStatus

from surgsim_env.live import guarded_server
from surgsim_env.live.exchange_records import LiveError
from surgsim_env.live.guarded_server import LOG_PERIOD, MESSAGE_SIZE_MOST, SOCKETS_MOST, CalmLog, GuardedServer
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


def joined(server, path="/", *, token=None, **options):
    given = {
        "origin": own(server),
        "subprotocols": [PROTOCOL] if path == "/" else None,
        "max_size": None,
        "compression": None,
        "open_timeout": SECONDS,
        "ping_interval": None,
    }
    address = f"ws://127.0.0.1:{server.gate.port}/{token or server.gate.token}{path}"
    return connect(address, **{**given, **options})


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
    page = f"/{server.gate.token}"
    assert get(server, "/")[0] == 401
    status, body, headers = get(server, page)
    assert status == 200 and b"getGamepads" in body and int(headers["Content-Length"]) == len(body)
    assert get(server, f"{page}/?websocket=ws://x")[0] == 200
    assert get(server, page, Host="evil.example")[0] == 421
    assert get(server, page, Origin="http://evil.example")[0] == 403
    assert get(server, f"{page}/../../etc/passwd")[0] == 404
    assert get(server, f"{page}/%2e%2e/%2e%2e/infra/_infra.py")[0] == 404


def test_the_page_is_kept_from_frames_and_other_sites_and_sets_no_cookie(server):
    _, _, headers = get(server, f"/{server.gate.token}")
    assert headers["X-Frame-Options"] == "DENY" and headers["Referrer-Policy"] == "no-referrer"
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    # A browser sends a cookie to every port of 127.0.0.1, whoever listens there.
    assert "Set-Cookie" not in headers


def test_a_request_that_takes_no_packing_is_answered(server):
    """As plain curl asks: without Accept-Encoding."""
    connection = http.client.HTTPConnection("127.0.0.1", server.gate.port, timeout=SECONDS)
    connection.putrequest("GET", f"/{server.gate.token}", skip_accept_encoding=True)
    connection.endheaders()
    assert connection.getresponse().status == 200


@pytest.mark.parametrize("path", ["/", "/hand", "/elsewhere"])
@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"origin": None}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"token": "wrong"}, 401),
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
    "an unknown type in many bytes": (msgspec.msgpack.encode({"type": 99 * "\u20ac"}), 1008),
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


def raw_socket(server):
    """A bare socket after its handshake as a hand's websocket."""
    made = socket.create_connection(("127.0.0.1", server.gate.port), timeout=60.0)
    made.sendall(
        f"GET /{server.gate.token}/hand HTTP/1.1\r\nHost: 127.0.0.1:{server.gate.port}\r\nOrigin: {own(server)}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}\r\n\r\n".encode()
    )
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += made.recv(1)
    assert answer.startswith(b"HTTP/1.1 101")
    return made


# As a client sends them: masked, with a mask of zeros.
EMPTY_PING, EMPTY_PONG, EMPTY_FRAGMENT = b"\x89\x80\0\0\0\0", b"\x8a\x80\0\0\0\0", b"\x00\x80\0\0\0\0"
FIRST_FRAGMENT = b"\x02\x80\0\0\0\0"


def received(raw) -> bytes:
    """All that comes until the server closes."""
    parts = []
    with contextlib.suppress(ConnectionResetError):
        while part := raw.recv(65536):
            parts.append(part)
    return b"".join(parts)


@pytest.mark.parametrize(
    ("flood", "reason", "answers"),
    [
        (20_000 * EMPTY_PING, b"more than 5 pings and pongs a second", True),
        (20_000 * EMPTY_PONG, b"more than 5 pings and pongs a second", False),
        (FIRST_FRAGMENT + 20_000 * EMPTY_FRAGMENT, b"more than 300 messages a second", False),
    ],
    ids=["pings", "pongs", "empty fragments of one message"],
)
def test_a_flood_of_small_frames_is_closed_with_its_reason_and_one_line(server, caplog, flood, reason, answers):
    """The pace of a dragged mouse is nothing to do with it: pings and pongs have one of their own."""
    calm(server)
    dropped = server.message_filter.dropped
    with raw_socket(server) as raw:
        raw.sendall(flood)
        got = received(raw)
    assert reason in got
    # At most those of the 4096 bytes that are decoded at once.
    assert got.count(b"\x8a\0") <= (700 if answers else 0)
    assert server.message_filter.dropped == dropped + 1
    assert [record.getMessage() for record in caplog.records] == [
        f"surgsim: a client of the live page was disconnected: {reason.decode()}"
    ]


def test_pings_at_an_ordinary_pace_are_answered_and_the_session_goes_on(server):
    async def attempt():
        async with joined(server, "/hand") as socket:
            for _ in range(40):
                await asyncio.wait_for(await socket.ping(), SECONDS)
            await socket.send(b"still here")
            return await asyncio.wait_for(socket.recv(), SECONDS)

    assert asyncio.run(attempt()) == b"still here"


def test_a_client_that_leaves_in_the_middle_leaves_no_line(server, caplog):
    """Gone before its pings are answered, within a message, within a request, before a word."""
    loop, held = server.viser._websock_server._background_event_loop, threading.Event()
    calm(server)
    with raw_socket(server) as raw:
        # The server reads when all is sent and the client is gone: each answer is a write to a closed socket.
        loop.call_soon_threadsafe(held.wait, SECONDS)
        raw.sendall(500 * EMPTY_PING)
    held.set()
    with raw_socket(server) as raw:
        raw.sendall(b"\x82\xfe\x10\x00")
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    for words in (b"", b"GET / HT", b"\x16\x03\x01\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", server.gate.port), timeout=SECONDS) as raw:
            raw.sendall(words)
    asyncio.run(wait_until(lambda: not any("conn_handler" in repr(task) for task in asyncio.all_tasks(loop))))
    told = [record.getMessage() for record in caplog.records]
    assert told == ["surgsim: a client of the live page was disconnected: more than 5 pings and pongs a second"]


def calm(server) -> None:
    """Forget what was logged a moment ago."""
    for one in guarded_server._log.filters:
        if isinstance(one, CalmLog):
            one._logged.clear()
            one._dropped.clear()


def test_the_log_repeats_nothing_and_hides_no_error_of_the_server():
    now = [100.0]
    log = CalmLog(lambda: now[0])

    def record(text, error=None):
        told = (type(error), error, None) if error else None
        return logging.LogRecord("x", logging.ERROR, "", 0, text, (), told)

    for error in (ConnectionResetError(), EOFError(), ConnectionClosedError(None, None), InvalidMessage("no HTTP")):
        assert not log.filter(record("connection handler failed", error))
    assert log.filter(record("connection handler failed", ValueError("ours")))
    assert not log.filter(record("connection handler failed", ValueError("ours")))
    assert log.filter(record("another"))
    now[0] += LOG_PERIOD
    last = record("connection handler failed", ValueError("ours"))
    assert log.filter(last)
    assert last.getMessage() == "connection handler failed (and 1 more like it since the last line)"


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
    assert server.address == f"http://127.0.0.1:{server.gate.port}/{server.gate.token}"


def test_a_viser_that_serves_beside_the_gate_is_refused(monkeypatch):
    """Where the call that is guarded is not made, nothing is served."""

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
