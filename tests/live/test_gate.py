"""Who is let in: names, origins and tokens, in all the ways that they are got wrong."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets import Headers
from websockets.http11 import Request

from surgsim_env.live.guarded_server import Gate, listening_socket, names_of

TOKEN = "a-token-of-this-run"
# What a header may hold.
WORDS = st.text(st.characters(min_codepoint=33, max_codepoint=255, exclude_categories=["Cc"]), max_size=80)
OWN = "http://127.0.0.1:8080"


def request(path=f"/{TOKEN}", *, host="127.0.0.1:8080", **headers) -> Request:
    found = Headers()
    if host is not None:
        found["Host"] = host
    for name, value in headers.items():
        found[name.replace("_", "-")] = value
    return Request(path, found)


def socket_request(**given) -> Request:
    return request(**{"Origin": OWN, "Upgrade": "websocket", "Connection": "Upgrade", **given})


@pytest.fixture
def gate() -> Gate:
    return Gate(8080, token=TOKEN)


@pytest.mark.parametrize(
    ("path", "behind"),
    [
        (f"/{TOKEN}", "/"),
        (f"/{TOKEN}/", "/"),
        (f"/{TOKEN}/?websocket=ws://127.0.0.1:8080/{TOKEN}", "/"),
        (f"/{TOKEN}/hand", "/hand"),
        (f"/{TOKEN}/a/b?c=d", "/a/b"),
    ],
)
def test_page_and_sockets_lie_below_the_token(gate, path, behind):
    for made in (request(path), socket_request(path=path)):
        assert gate.refusal(made) is None
        assert gate.path_behind_token(made) == behind


@pytest.mark.parametrize("host", ["localhost:8080", "LOCALHOST:8080", "[::1]:8080", "127.0.0.1:8080"])
def test_this_machines_names(gate, host):
    assert gate.refusal(socket_request(host=host, Origin=f"http://{host}")) is None


@pytest.mark.parametrize(
    "host",
    [
        *(None, "", "evil.example:8080", "127.0.0.1", "127.0.0.1:8081", "127.0.0.1.evil.example:8080", "127.0.0.1:x"),
        *(
            "a@127.0.0.1:8080",
            "127.0.0.1:8080@evil",
            "192.168.0.7:8080",
            "[::1:8080",
            "127.0.0.1:8080/x",
            "0.0.0.0:8080",
        ),
    ],
)
def test_other_names_are_refused(gate, host):
    for made in (request(host=host), socket_request(host=host)):
        assert gate.refusal(made).status_code == 421


def test_two_hosts_or_origins_are_refused(gate):
    made = request()
    made.headers["Host"] = "127.0.0.1:8080"
    assert gate.refusal(made).status_code == 421
    made = socket_request()
    made.headers["Origin"] = OWN
    assert gate.refusal(made).status_code == 403


@pytest.mark.parametrize(
    "origin",
    ["null", "", "https://127.0.0.1:8080", "http://127.0.0.1:8081", "http://evil.example", "http://localhost:8080"],
)
def test_other_origins_are_refused(gate, origin):
    assert gate.refusal(socket_request(Origin=origin)).status_code == 403
    assert gate.refusal(request(Origin=origin)).status_code == 403


@pytest.mark.parametrize("words", [{"Upgrade": "WebSocket"}, {"Upgrade": "h2c"}, {"Sec_WebSocket_Key": "x"}])
def test_a_socket_needs_an_origin_whatever_it_is_called(gate, words):
    assert gate.refusal(request(**words)).status_code == 403


@pytest.mark.parametrize(
    "made",
    [
        request("/"),
        request("//"),
        request(""),
        request("/wrong"),
        request(f"/{TOKEN}x"),
        request(f"/{TOKEN[:-1]}"),
        request(f"//{TOKEN}"),
        request(f"/x/{TOKEN}"),
        request(f"/?token={TOKEN}"),
        request(f"/?/{TOKEN}"),
        request(f"http://127.0.0.1:8080/{TOKEN}"),
        request("/%ff%00é"),
        # No cookie opens anything: the browser sends it to every port of the host.
        request("/", Cookie=f"surgsim_8080={TOKEN}"),
        socket_request(path="/", Cookie=f"surgsim_8080={TOKEN}"),
        socket_request(path="/"),
    ],
)
def test_without_the_token_there_is_nothing(gate, made):
    assert gate.refusal(made).status_code == 401


@given(WORDS, WORDS, WORDS)
def test_no_words_get_in_without_the_token(host, path, cookie):
    gate = Gate(8080, token=TOKEN)
    found = Headers()
    found["Host"], found["Cookie"], found["Origin"] = host, cookie, OWN
    assert gate.refusal(Request("/" + path, found)) is not None
    found = Headers()
    found["Host"], found["Cookie"] = "127.0.0.1:8080", cookie
    assert gate.refusal(Request("/" + path, found)).status_code == 401


def test_a_remote_gate_knows_addresses_but_no_strange_names():
    """An address in numbers is in nobody's hands; a name may be pointed here by whoever owns it."""
    gate = Gate(8080, names_of("0.0.0.0", remote=True), remote=True, token=TOKEN)
    assert gate.refusal(request(host="192.168.0.7:8080")) is None
    assert gate.refusal(request(host="evil.example:8080")).status_code == 421


def test_tokens_are_new_each_time_and_not_in_the_representation():
    one, other = Gate(8080), Gate(8080)
    assert one.token != other.token and len(one.token) >= 40
    assert one.token not in repr(one)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_wider_binding_takes_a_word(host):
    with pytest.raises(ValueError, match="--allow-remote"):
        listening_socket(host, 0, remote=False)


def test_addresses_that_are_not_to_be_had():
    with pytest.raises(ValueError, match="no address of this machine"):
        listening_socket("no such host.invalid", 0, remote=False)
    with listening_socket("127.0.0.1", 0, remote=False) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"--port {port} cannot be listened on"):
            listening_socket("127.0.0.1", port, remote=False)
