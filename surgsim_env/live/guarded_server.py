"""A viser server whose requests pass a gate and whose messages pass a filter, and which opens no public tunnel."""

import hmac
import http
import ipaddress
import logging
import secrets
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from importlib.resources import files
from io import StringIO
from typing import Any
from urllib.parse import urlsplit

import viser
import viser.infra
from viser import _messages
from websockets import Headers
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.frames import CTRL_OPCODES, Frame
from websockets.http11 import Request, Response

from surgsim_env.live.exchange_records import LiveError
from surgsim_env.live.messages import (
    CONTROL_BURST_MOST,
    CONTROL_RATE_MOST,
    HAND_PATH,
    InvalidMessageError,
    MessageFilter,
    RateLimit,
)

LOOPBACK = ("127.0.0.1", "::1", "localhost")
# Headers that forbid the browser to cache the page, to frame it, and to contact other servers from it.
SAFE_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": (
        "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
        "style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob:; worker-src 'self' blob: data:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}

# What one client may send at once [bytes]: a pose, a slider, where its camera stands.
MESSAGE_SIZE_MOST = 16 * 1024
# Sockets that may be open at the same time; a tab has two.
SOCKETS_MOST = 16
# How long a client may be silent to a ping before it is given up [s].
PING_INTERVAL = 10.0
# Bytes that are decoded between two looks at the pace of a client; a read may hold 43 000 empty pings.
BYTES_AT_ONCE = 4096
# How long a refused client may take to close its side [s].
CLOSE_TIMEOUT = 5.0
# A line of the log is not repeated before [s].
LOG_PERIOD = 10.0

# In this order: the second tells the server what the first counts.
SCRIPTS = ("drawing.js", "hand.js")

HandServer = Callable[[ServerConnection], Awaitable[None]]


@dataclass(frozen=True)
class Gate:
    """Accepts requests that name this server, come from its own page, and carry the token of this run.

    The check of Host stops DNS rebinding, the check of Origin stops sockets opened by pages of other sites, and the
    token stops everyone else on the machine or the network. The token is the first part of every path, of the page and
    of its sockets: viser's page opens its socket below its own address. A cookie would also reach every other server on
    the same host, as cookies do not distinguish ports.

    Args:
        port: of this server.
        hosts: accepted names of the server, without the port; with `remote`, IP addresses are accepted too.
        remote: whether other machines may connect.
        token: of this run; random by default.
    """

    port: int
    hosts: Sequence[str] = LOOPBACK
    remote: bool = False
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    def refusal(self, request: Request) -> Response | None:
        """A response that refuses a request with its reason, or None for an accepted one."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_here(hosts[0]):
            return refuse(http.HTTPStatus.MISDIRECTED_REQUEST, "this server is not called by that name (Host)")
        origins = request.headers.get_all("Origin")
        if asks_for_socket(request) and len(origins) != 1:
            return refuse(http.HTTPStatus.FORBIDDEN, "a socket is opened with one Origin")
        if origins and (len(origins) != 1 or origins[0].lower() != f"http://{hosts[0]}".lower()):
            return refuse(http.HTTPStatus.FORBIDDEN, "that page is not this server's own (Origin)")
        if self.path_behind_token(request) is None:
            return refuse(http.HTTPStatus.UNAUTHORIZED, "open the whole address that `surgsim view` printed (token)")
        return None

    def path_behind_token(self, request: Request) -> str | None:
        """The path of a request without its token and its query, "/" for the page; None without the token."""
        first, _, rest = request.path.partition("?")[0].removeprefix("/").partition("/")
        return f"/{rest}" if self._is_token(first) else None

    def _is_here(self, host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname, parts.port or 80
        except ValueError:
            return False
        if name is None or port != self.port or parts.path or parts.query or parts.fragment or "@" in host:
            return False
        return name in self.hosts or (self.remote and _is_address(name))

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "surrogateescape"), self.token.encode())


class GuardedServer:
    """A viser server whose every request passes a `Gate`, and whose every message passes a `MessageFilter`.

    viser 1.1 binds all interfaces, accepts any Origin, and lets any client request a public tunnel, and has no option
    for any of them. It opens its port with `websockets.asyncio.server.serve`, once, in its constructor; a subclass
    stands in for it there. If a later viser opens its port in another way, the constructor raises and nothing is
    served.

    Fields:
        viser: the server whose scene and panel are filled
        gate: who may connect
        message_filter: which messages are let through
        address: what to open, token included
    """

    def __init__(
        self, host: str, port: int, *, remote: bool, message_filter: MessageFilter, serve_hand: HandServer
    ) -> None:
        """Listen.

        Args:
            host: address to listen on.
            port: 0 takes a free one.
            remote: whether other machines may connect.
            message_filter: of messages.
            serve_hand: takes over the sockets that keyboards and gamepads steer through.

        Raises:
            ValueError: an address that is not to be had, or reaches beyond this machine without `remote`.
            LiveError: a version of viser that would answer beside the gate.
        """
        self._listening = listening_socket(host, port, remote=remote)
        bound_port = self._listening.getsockname()[1]
        self.gate = Gate(bound_port, names_of(host, remote=remote), remote)
        self.message_filter, self._serve_hand = message_filter, serve_hand
        self._guards = 0
        with self._taking_over_serve():
            self.viser = viser.ViserServer(host=host, port=bound_port, label="surgsim", verbose=False)
        if self._guards != 1:
            self.viser.stop()
            self._listening.close()
            raise LiveError(
                f"viser {viser.__version__} serves in a way that surgsim cannot guard: install viser>=1.1,<1.2"
            )
        self._forget_tunnels()
        shown = "127.0.0.1" if host in ("0.0.0.0", "localhost") else host
        shown = f"[{shown}]" if ":" in shown else shown
        self.address = f"http://{shown}:{bound_port}/{self.gate.token}"

    def stop(self) -> None:
        """Close all sockets and the port."""
        self.viser.stop()
        self._listening.close()

    @contextmanager
    def _taking_over_serve(self):
        guarded = self

        class GuardedServe(websocket_server.serve):
            """What viser 1.1 opens its port with: on our socket, with our limits, behind the gate and the filter."""

            def __init__(self, handler: Any, host: str, port: int, **given: Any) -> None:
                guarded._guards += 1
                super().__init__(
                    guarded._dispatch(handler),
                    **given
                    | {
                        "sock": guarded._listening,
                        "max_size": MESSAGE_SIZE_MOST,
                        "ping_interval": PING_INTERVAL,
                        "ping_timeout": PING_INTERVAL,
                        "open_timeout": PING_INTERVAL,
                        "logger": _log,
                        "create_connection": guarded._connection_type(),
                        "process_request": guarded._answer(given["process_request"]),
                    },
                )

        # viser has no parameter for any of these, and looks `serve` up in its own thread while its constructor waits.
        with _SERVING:
            serve = websocket_server.serve
            websocket_server.serve = GuardedServe
            try:
                # viser prints an address without the token; the caller prints ours.
                with redirect_stdout(StringIO()):
                    yield
            finally:
                websocket_server.serve = serve

    def _answer(self, viser_answer: Callable[..., Response | None]) -> Callable[..., Response | None]:
        """What is answered to a request: a refusal, viser's page, or None to open a socket."""

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            refusal = self.gate.refusal(request)
            if refusal is not None:
                return refusal
            if asks_for_socket(request):
                # This one is not among them yet.
                if len(connection.server.connections) >= SOCKETS_MOST:
                    return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{SOCKETS_MOST} sockets are open already")
                return None
            # Not packed: there is a script to put in.
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]
            path = self.gate.path_behind_token(request)
            assert path is not None
            request.path = path
            response = viser_answer(connection, request)
            if response is None:
                return refuse(http.HTTPStatus.BAD_REQUEST, "no request for a page or a socket")
            if response.status_code == http.HTTPStatus.OK and path == "/":
                response = _with_script(response)
            for name, value in SAFE_HEADERS.items():
                response.headers[name] = value
            return response

        return answer

    def _dispatch(self, viser_handler: Callable[..., Awaitable[None]]) -> Callable[[ServerConnection], Awaitable[None]]:
        async def handle(connection: ServerConnection) -> None:
            assert connection.request is not None
            if self.gate.path_behind_token(connection.request) == HAND_PATH:
                await self._serve_hand(connection)
            else:
                await viser_handler(connection)

        return handle

    def _connection_type(self) -> type[ServerConnection]:
        gate, message_filter = self.gate, self.message_filter

        class FilteredConnection(ServerConnection):
            """A connection whose frames are counted, and whose messages are filtered before viser decodes them.

            A client that sends too much or an invalid message is refused: it is closed with the reason, and what it
            sends after that is not decoded.
            """

            def __init__(self, *given: Any, **named: Any) -> None:
                super().__init__(*given, **named)
                self._messages = RateLimit()
                self._control = RateLimit(CONTROL_RATE_MOST, CONTROL_BURST_MOST, "pings and pongs")
                self._refused = False

            def connection_made(self, transport: Any) -> None:
                opened: Any = _OpenTransport(transport)
                super().connection_made(opened)

            def data_received(self, data: bytes) -> None:
                for start in range(0, len(data), BYTES_AT_ONCE):
                    if not self._refused:
                        super().data_received(data[start : start + BYTES_AT_ONCE])

            def process_event(self, event: Any) -> None:
                if self._refused:
                    return
                if isinstance(event, Frame):
                    try:
                        # Fragments count as messages: a message may have any number of empty ones.
                        (self._control if event.opcode in CTRL_OPCODES else self._messages).count()
                    except InvalidMessageError as error:
                        self._refuse(error)
                        return
                super().process_event(event)

            async def recv(self, decode: bool | None = None) -> Any:
                while True:
                    message = await super().recv(decode)
                    # Messages that were received before the client was refused.
                    if self._refused:
                        continue
                    if self.request is not None and gate.path_behind_token(self.request) == HAND_PATH:
                        return message
                    try:
                        if message_filter.accepts(message):
                            return message
                    except InvalidMessageError as error:
                        self._refuse(error)

            def _refuse(self, error: InvalidMessageError) -> None:
                self._refused = True
                message_filter.dropped += 1
                # The error may quote the client, and a closing frame has room for 123 bytes.
                reason = str(error).encode("unicode_escape").decode("ascii")[:100]
                _log.warning("surgsim: a client of the live page was disconnected: %s", reason)
                # Unlike close(), this reads no more messages, and it does not wait for a client that does not answer.
                self.protocol.fail(1008, reason)
                self.send_data()
                self.loop.call_later(CLOSE_TIMEOUT, self.transport.abort)

        return FilteredConnection

    def _forget_tunnels(self) -> None:
        """Take away viser's handlers that open a public tunnel when a client asks; and the way to open one."""
        handlers = self.viser._websock_server._incoming_handlers
        for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            handlers.pop(kind, None)

        def no_tunnel(*_: Any, **__: Any) -> None:
            raise RuntimeError("surgsim never opens a public tunnel: use SSH to reach the page from elsewhere")

        self.viser.request_share_url = no_tunnel  # type: ignore[method-assign]


_SERVING = threading.Lock()


class _OpenTransport:
    """A transport that drops what is written once it is closing; asyncio's own logs a line for each of these writes."""

    def __init__(self, transport: Any) -> None:
        self._transport = transport

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(data)


class CalmLog(logging.Filter):
    """Drops errors that say only that a client left or spoke no HTTP, and repeats no message within LOG_PERIOD."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with nothing logged."""
        super().__init__()
        self._clock = clock
        self._logged: dict[str, float] = {}
        self._dropped: dict[str, int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is logged; one that follows dropped ones says how many."""
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, ConnectionClosed | InvalidHandshake | ConnectionError | EOFError):
            return False
        if record.levelno < logging.WARNING:
            return True
        kind, now = str(record.msg), self._clock()
        if now - self._logged.get(kind, -LOG_PERIOD) < LOG_PERIOD:
            self._dropped[kind] = self._dropped.get(kind, 0) + 1
            return False
        self._logged[kind] = now
        if count := self._dropped.pop(kind, 0):
            record.msg = f"{kind} (and {count} more like it since the last line)"
        return True


_log = logging.getLogger(__name__)
_log.addFilter(CalmLog())


def _with_script(response: Response) -> Response:
    """The page with our scripts, before its own."""
    folder = files("surgsim_env.live")
    script = b"".join(b"<script>" + folder.joinpath(name).read_bytes() + b"</script>" for name in SCRIPTS)
    head, mark, rest = response.body.partition(b"</head>")
    if not mark:
        raise RuntimeError(f"viser {viser.__version__} has a page without a head: install viser>=1.1,<1.2")
    body = head + script + mark + rest
    headers = Headers(response.headers)
    for name in ("Content-Length", "Content-Encoding"):
        if name in headers:
            del headers[name]
    headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)


def asks_for_socket(request: Request) -> bool:
    """Whether a request asks for a websocket, by any of its headers."""
    return any(name in request.headers for name in ("Upgrade", "Sec-WebSocket-Key", "Sec-WebSocket-Version"))


def refuse(status: http.HTTPStatus, reason: str) -> Response:
    """A short response in plain text that closes the connection."""
    body = f"surgsim: {reason}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
    headers["Connection"] = "close"
    headers["X-Content-Type-Options"] = "nosniff"
    return Response(int(status), status.phrase, headers, body)


def listening_socket(host: str, port: int, *, remote: bool) -> socket.socket:
    """A socket that listens on a loopback address, or with `remote` on any address.

    Raises:
        ValueError: an address that other machines reach, without `remote`; an address or port that cannot be bound.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (socket.gaierror, OverflowError, UnicodeError) as error:
        raise ValueError(f"--host {host!r} with --port {port} is no address of this machine: {error}") from None
    if not remote and not ipaddress.ip_address(address[0]).is_loopback:
        raise ValueError(
            f"--host {host} would let other machines connect: give --allow-remote as well if you mean that (the page "
            "still asks for its token, but nothing is encrypted), or leave --host away and use an SSH tunnel"
        )
    listening = socket.socket(family, kind, protocol)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(32)
    except OSError as error:
        listening.close()
        raise ValueError(
            f"--host {host} --port {port} cannot be listened on ({error}); --port 0 takes a free one"
        ) from None
    return listening


def names_of(host: str, *, remote: bool) -> tuple[str, ...]:
    """Accepted names of a server on this host."""
    own = (host.lower(), socket.gethostname().lower(), socket.getfqdn().lower()) if remote else ()
    return tuple(dict.fromkeys((*LOOPBACK, *own)))


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
