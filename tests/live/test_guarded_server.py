"""The server at the protocol's level: which requests for its page and its sockets are answered."""

import asyncio
import contextlib
import http.client

import msgspec.msgpack
import pytest
import viser
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from surgsim_apps.live import guarded_server
from surgsim_apps.live.exchange_records import LiveError
from surgsim_apps.live.guarded_server import GuardedServer
from tests.live.protocol_client import CAMERA
from tests.live.served import SECONDS


@pytest.fixture(scope="module")
def server():
    async def serve_hand(connection):
        with contextlib.suppress(ConnectionClosed):
            while True:
                await connection.send(await connection.recv())

    made = GuardedServer(0, serve_hand)
    yield made
    made.stop()


@pytest.fixture(scope="module")
def own(server) -> str:
    """The name that the server is reached by."""
    return f"127.0.0.1:{server.viser.get_port()}"


def get(server, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.viser.get_port(), timeout=SECONDS)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), answer.headers


def test_the_page_comes_with_the_token_alone(server):
    page = f"/{server.token}"
    for path in ("/", "/wrong", page[:-1], f"{page}x", f"/x{page}", f"/?token={server.token}"):
        assert get(server, path, Cookie=f"token={server.token}")[0] == 401
    for path in (page, f"{page}/", f"{page}/?websocket=ws://x"):
        status, body, headers = get(server, path, **{"Accept-Encoding": "gzip"})
        assert status == 200 and int(headers["Content-Length"]) == len(body)
        # Our scripts stand before viser's.
        assert body.index(b"getGamepads") < body.index(b"</head>")


@pytest.mark.parametrize(
    ("host", "status"),
    [
        *(("127.0.0.1:{}", 200), ("localhost:{}", 200), ("[::1]:{}", 200)),
        # Tunnels that begin at another port, or at 80.
        *(("127.0.0.1:1", 200), ("localhost:9090", 200), ("127.0.0.1", 200), ("localhost", 200)),
        *(("evil.example:{}", 421), ("127.0.0.1.evil.example:{}", 421), ("192.168.0.7:{}", 421)),
        *(("x@127.0.0.1:{}", 421), ("localhost:9090:1", 421), ("localhost:", 421), ("127.0.0.1.:80", 421)),
        *(("127x0.0.1:80", 421), ("localhost.evil.example", 421), ("", 421)),
    ],
)
def test_a_name_of_another_machine_is_refused(server, host, status):
    port = server.viser.get_port()
    answered, body, _ = get(server, f"/{server.token}", Host=host.format(port))
    assert answered == status and (status == 200) != (f"ssh -L {port}:127.0.0.1:{port}".encode() in body)


def test_a_page_of_another_site_is_refused(server, own):
    assert get(server, f"/{server.token}", Origin=f"http://{own}")[0] == 200
    for origin in ("http://evil.example", "null", f"https://{own}", "http://localhost:9090", "http://127.0.0.1"):
        assert get(server, f"/{server.token}", Origin=origin)[0] == 403


@pytest.mark.parametrize("path", ["/", "/hand", "/elsewhere"])
@pytest.mark.parametrize(
    ("origin", "token", "status"),
    [(None, None, 403), ("http://evil.example", None, 403), ("", "wrong", 401)],
)
def test_no_socket_is_opened_without_origin_and_token(server, own, path, origin, token, status):
    async def attempt():
        address = f"ws://{own}/{token or server.token}{path}"
        async with connect(address, origin=f"http://{own}" if origin == "" else origin, open_timeout=SECONDS):
            pass

    with pytest.raises(InvalidStatus) as refused:
        asyncio.run(attempt())
    assert refused.value.response.status_code == status


@pytest.mark.parametrize("named", ["{}", "localhost:9090"])
def test_viser_and_the_hands_have_sockets_below_the_token(server, own, named):
    """Also through a tunnel that begins at another port, which the browser names."""
    address = ("127.0.0.1", server.viser.get_port())
    own = named.format(own)

    async def attempt():
        options = {"origin": f"http://{own}", "max_size": None, "compression": None, "open_timeout": SECONDS}
        options |= dict(zip(("host", "port"), address))
        protocol = f"viser-v{viser.__version__}"
        async with (
            connect(f"ws://{own}/{server.token}/", subprotocols=[protocol], **options) as tab,
            connect(f"ws://{own}/{server.token}/hand", **options) as hand,
        ):
            await tab.send(msgspec.msgpack.encode(CAMERA))
            assert await asyncio.wait_for(tab.recv(), SECONDS)
            await hand.send(b"0123456789abcdef")
            return await asyncio.wait_for(hand.recv(), SECONDS)

    assert asyncio.run(attempt()) == b"0123456789abcdef"


def test_it_listens_on_this_machine_alone(server, own):
    assert server.viser.get_host() == "127.0.0.1"
    assert server.address == f"http://{own}/{server.token}"


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch):
    class OtherViser:
        stopped = False

        def __init__(self, **_):
            pass

        def stop(self):
            OtherViser.stopped = True

    monkeypatch.setattr(guarded_server.viser, "ViserServer", OtherViser)
    with pytest.raises(LiveError, match="cannot guard"):
        GuardedServer(0, None)
    assert OtherViser.stopped
