"""Access control of the page: checks Host, Origin and token of every request before anything is answered."""

import hmac
import http
import ipaddress
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from websockets import Headers
from websockets.http11 import Request, Response

LOOPBACK = ("127.0.0.1", "::1", "localhost")
TOKEN_FIELD = "token"
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


@dataclass(frozen=True)
class Gate:
    """Accepts requests that name this server, come from its own page, and carry the token of this run.

    The check of Host stops DNS rebinding, the check of Origin stops sockets opened by pages of other sites, and the
    token stops everyone else on the machine or the network. The address that is opened first contains the token; a
    cookie keeps it, which scripts cannot read and requests of other sites do not carry.

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

    @property
    def cookie(self) -> str:
        """Name of the cookie, with the port: cookies are shared between ports."""
        return f"surgsim_{self.port}"

    def refusal(self, request: Request) -> Response | None:
        """A response that refuses a request with its reason, or None for an accepted one."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_here(hosts[0]):
            return refuse(http.HTTPStatus.MISDIRECTED_REQUEST, "this server is not called by that name (Host)")
        origins = request.headers.get_all("Origin")
        if asks_for_socket(request) and len(origins) != 1:
            return refuse(http.HTTPStatus.FORBIDDEN, "a socket is opened with one Origin")
        if origins and (len(origins) != 1 or not self._is_own(origins[0], hosts[0])):
            return refuse(http.HTTPStatus.FORBIDDEN, "that page is not this server's own (Origin)")
        if not self._has_token(request):
            return refuse(http.HTTPStatus.UNAUTHORIZED, "open the whole address that `surgsim view` printed (token)")
        return None

    def welcome(self, request: Request, response: Response) -> None:
        """Add the security headers and the cookie to the page's response."""
        for name, value in SAFE_HEADERS.items():
            response.headers[name] = value
        if self._is_token(_query_token(request)):
            response.headers["Set-Cookie"] = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_here(self, host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname, parts.port or 80
        except ValueError:
            return False
        if name is None or port != self.port or parts.path or parts.query or parts.fragment or "@" in host:
            return False
        return name in self.hosts or (self.remote and _is_address(name))

    @staticmethod
    def _is_own(origin: str, host: str) -> bool:
        return origin.lower() == f"http://{host}".lower()

    def _has_token(self, request: Request) -> bool:
        if self._is_token(_query_token(request)):
            return True
        for header in request.headers.get_all("Cookie"):
            try:
                found = SimpleCookie(header).get(self.cookie)
            except CookieError:
                continue
            if found is not None and self._is_token(found.value):
                return True
        return False

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "surrogateescape"), self.token.encode())


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


def _query_token(request: Request) -> str:
    try:
        values = parse_qs(request.path.partition("?")[2], max_num_fields=16).get(TOKEN_FIELD, [])
    except ValueError:
        return ""
    return values[0] if len(values) == 1 else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
