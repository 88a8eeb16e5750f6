"""A viser server on 127.0.0.1, protected by the random token of a run."""

import hmac
import http
import re
import secrets
from collections.abc import Awaitable, Callable
from contextlib import redirect_stdout
from importlib.resources import files
from io import StringIO
from typing import Any

import viser
from websockets import Headers
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from surgsim_apps.live.exchange_records import LiveError

LOOPBACK = "127.0.0.1"
# Of this machine, with any port: an SSH tunnel may begin at another one. No name that a stranger's DNS answers.
OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
# Sockets of keyboards, gamepads and frame rates: `hand.js` opens them.
HAND_PATH = "/hand"
# In this order: later ones use what the first makes.
SCRIPTS = ("drawing.js", "hand.js", "overlay.js")

HandServer = Callable[[ServerConnection], Awaitable[None]]
Answer = Callable[[ServerConnection, Request], Response | None]


class GuardedServer:
    """A viser server on 127.0.0.1 with checks of Host, Origin and token in each request.

    The check of Host stops DNS rebinding, the check of Origin stops sockets opened by pages of other sites, and the
    token stops other accounts of the machine. The token is the first part of every path, of the page and of its
    sockets: viser's page opens its socket below its own address. A cookie would also reach every other server on the
    same host, as cookies do not distinguish ports.

    viser has no parameter for websockets' check of requests (`process_request`), so its function for opening a port,
    `websockets.asyncio.server.serve`, is replaced while viser starts. If a later viser opens its port in another way,
    the constructor raises and nothing is served.

    Fields:
        viser: the server with scene and panel
        token: of this run, random
        address: of the page, token included
    """

    def __init__(self, port: int, serve_hand: HandServer) -> None:
        """Listen.

        Args:
            port: the next free one is taken if it is in use; 0 takes any free one.
            serve_hand: takes over the sockets of `hand.js`.

        Raises:
            LiveError: a version of viser without these checks.
        """
        self.token = secrets.token_urlsafe(32)
        self._serve_hand = serve_hand
        serve: Any = websocket_server.serve
        calls = []

        def guarded(handler: HandServer, *place: Any, process_request: Answer, **options: Any) -> Any:
            calls.append(place)
            return serve(self._dispatch(handler), *place, process_request=self._answer(process_request), **options)

        websocket_server.serve = guarded  # type: ignore[assignment]
        try:
            # viser prints an address without the token; the caller prints ours.
            with redirect_stdout(StringIO()):
                self.viser = viser.ViserServer(host=LOOPBACK, port=port, label="surgsim", verbose=False)
        finally:
            websocket_server.serve = serve
        if not calls:
            self.viser.stop()
            raise LiveError(
                f"viser {viser.__version__} opens its port in a way that surgsim cannot guard: install viser>=1.1,<1.2"
            )
        self.address = f"http://{LOOPBACK}:{self.viser.get_port()}/{self.token}"

    def stop(self) -> None:
        """Close all sockets and the port."""
        self.viser.stop()

    def _dispatch(self, viser_handler: HandServer) -> HandServer:
        async def handle(connection: ServerConnection) -> None:
            assert connection.request is not None
            is_hand = self._path_behind_token(connection.request) == HAND_PATH
            await (self._serve_hand if is_hand else viser_handler)(connection)

        return handle

    def _answer(self, viser_answer: Answer) -> Answer:
        """The response to a request: a refusal, viser's page with our scripts, or None to open a socket."""

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            refusal = self._refusal(connection.local_address[1], request)
            if refusal is not None or "Upgrade" in request.headers:
                return refusal
            # Not compressed, so that the scripts can be inserted.
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]
            request.path = self._path_behind_token(request) or ""
            response = viser_answer(connection, request)
            return _with_scripts(response) if response is not None and request.path == "/" else response

        return answer

    def _refusal(self, port: int, request: Request) -> Response | None:
        """The refusal of a request to a port, with its reason, or None for an accepted one."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not OWN_HOST.fullmatch(hosts[0]):
            return _refuse(
                http.HTTPStatus.MISDIRECTED_REQUEST,
                f"this server answers to {LOOPBACK} and localhost alone (Host): from another machine open a tunnel, "
                f"ssh -L {port}:{LOOPBACK}:{port} HOST, and then the printed address",
            )
        # A browser sends the origin of the page with each socket that the page opens.
        if origins != [f"http://{hosts[0]}"] and (origins or "Upgrade" in request.headers):
            return _refuse(http.HTTPStatus.FORBIDDEN, "the request comes from another site's page (Origin)")
        if self._path_behind_token(request) is None:
            return _refuse(http.HTTPStatus.UNAUTHORIZED, "open the whole address that `surgsim view` printed (token)")
        return None

    def _path_behind_token(self, request: Request) -> str | None:
        """The path of a request without its token and its query, "/" for the page; None without the token."""
        token, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
        has_token = hmac.compare_digest(token.encode("utf-8", "surrogateescape"), self.token.encode())
        return f"/{path}" if has_token else None


def _with_scripts(response: Response) -> Response:
    """The page with our scripts, before its own."""
    folder = files("surgsim_apps.live")
    scripts = b"".join(b"<script>" + folder.joinpath(name).read_bytes() + b"</script>" for name in SCRIPTS)
    body = response.body.replace(b"</head>", scripts + b"</head>", 1)
    headers = Headers({"Content-Type": response.headers["Content-Type"], "Content-Length": str(len(body))})
    return Response(response.status_code, response.reason_phrase, headers, body)


def _refuse(status: http.HTTPStatus, reason: str) -> Response:
    """A short response in plain text; closes the connection."""
    body = f"surgsim: {reason}\n".encode()
    headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
    headers["Connection"] = "close"
    return Response(int(status), status.phrase, headers, body)
