"""A viser server whose requests pass a gate and whose messages pass a filter, and which opens no public tunnel."""

import http
import threading
from collections.abc import Awaitable, Callable
from contextlib import contextmanager, redirect_stdout
from importlib.resources import files
from io import StringIO
from typing import Any

import viser
import viser.infra
from viser import _messages
from websockets import Headers
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from surgsim_env.live.exchange_records import LiveError
from surgsim_env.live.gate import Gate, asks_for_socket, listening_socket, names_of, refuse
from surgsim_env.live.messages import HAND_PATH, InvalidMessageError, MessageFilter, RateLimit

# What one client may send at once [bytes]: a pose, a slider, where its camera stands.
MESSAGE_SIZE_MOST = 16 * 1024
# Sockets that may be open at the same time; a tab has two.
SOCKETS_MOST = 16
# How long a client may be silent to a ping before it is given up [s].
PING_INTERVAL = 10.0

# In this order: the second tells the server what the first counts.
SCRIPTS = ("drawing.js", "hand.js")

HandServer = Callable[[ServerConnection], Awaitable[None]]


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
        self.address = f"http://{shown}:{bound_port}/?token={self.gate.token}"

    def stop(self) -> None:
        """Close every socket and the door."""
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
                    **{
                        **given,
                        "sock": guarded._listening,
                        "max_size": MESSAGE_SIZE_MOST,
                        "ping_interval": PING_INTERVAL,
                        "ping_timeout": PING_INTERVAL,
                        "open_timeout": PING_INTERVAL,
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
            response = viser_answer(connection, request)
            if response is None:
                return refuse(http.HTTPStatus.BAD_REQUEST, "no request for a page or a socket")
            if response.status_code == http.HTTPStatus.OK and request.path.partition("?")[0] == "/":
                response = _with_script(response)
            self.gate.welcome(request, response)
            return response

        return answer

    def _dispatch(self, viser_handler: Callable[..., Awaitable[None]]) -> Callable[[ServerConnection], Awaitable[None]]:
        async def handle(connection: ServerConnection) -> None:
            assert connection.request is not None
            if connection.request.path.partition("?")[0] == HAND_PATH:
                await self._serve_hand(connection)
            else:
                await viser_handler(connection)

        return handle

    def _connection_type(self) -> type[ServerConnection]:
        message_filter = self.message_filter

        class FilteredConnection(ServerConnection):
            """A connection whose messages are filtered before viser decodes them; an invalid one closes it."""

            def __init__(self, *given: Any, **named: Any) -> None:
                super().__init__(*given, **named)
                self._rate = RateLimit()

            async def recv(self, decode: bool | None = None) -> Any:
                while True:
                    message = await super().recv(decode)
                    try:
                        self._rate.count()
                        if self.request is not None and self.request.path.partition("?")[0] == HAND_PATH:
                            return message
                        if message_filter.accepts(message):
                            return message
                    except InvalidMessageError as error:
                        message_filter.dropped += 1
                        await self.close(1008, str(error)[:100])

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
