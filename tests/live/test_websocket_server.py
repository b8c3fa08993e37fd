"""The WebSocket server: what clients get, who may read, slow clients, the page."""

from __future__ import annotations

import http.client
import json
import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import planted
import pytest
from report_support import Page
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, RtofError, SourceError
from rtof_kin.live.samples import OnlineEstimate, Sink
from rtof_kin.live.websocket_server import WebSocketServer

BODY = SkeletonModel.default()
POSES = planted.moving(BODY, 40).poses
UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Version": "13",
}
STATUS = {"sensors": [{"name": "S1", "state": "ok", "sentence": ""}], "camera": {}}


@pytest.fixture
def server() -> Iterator[WebSocketServer]:
    server = WebSocketServer(BODY, floor_height=0.02)
    yield server
    server.close()


def estimate(frame: int) -> OnlineEstimate:
    return OnlineEstimate(POSES[frame : frame + 1], 0.05, 0.002)


def client(server: WebSocketServer, **options: Any) -> Any:
    """Connection to the server, for ``with``."""
    return connect(server.url.replace("http", "ws"), compression=None, proxy=None, **options)


def received(connection: Any) -> Any:
    return json.loads(connection.recv(timeout=5))


def until(condition: Any) -> None:
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


class Answer(NamedTuple):
    status: int
    headers: Any
    text: str


def answer(server: WebSocketServer, path: str | None = None, **headers: str) -> Answer:
    """Answer to a request as a browser would make it, by default for the page."""
    address = urlsplit(server.url)
    path = address.path if path is None else path
    connection = http.client.HTTPConnection(str(address.hostname), address.port, timeout=5)
    with closing(connection):
        connection.request("GET", path, headers=headers)
        with connection.getresponse() as response:
            return Answer(response.status, response.headers, response.read().decode())


def test_clients_get_skeleton_estimates_states_and_messages(server: WebSocketServer) -> None:
    sink: Sink = server
    sink.send(estimate(0))  # nobody listens
    with client(server) as first, client(server) as second:
        for connection in (first, second):
            hello = received(connection)
            assert hello["skeleton"]["joints"] == list(BODY.names)
            assert hello["floor_m"] == 0.02
        until(lambda: server.clients == 2)
        sink.send(estimate(3))
        sink.tell("S1: lost")
        server.send_status(STATUS)
        for connection in (first, second):
            found = [received(connection) for _ in range(3)]
            (state,) = [one for one in found if "header" in one]
            assert (state["lag_s"], len(state["position"])) == (0.05, len(BODY.dof_names))
            assert {"message": "S1: lost"} in found
            assert {"status": STATUS} in found
    until(lambda: server.clients == 0)
    assert server.dropped == 0


def test_who_connects_later_gets_the_last_state_and_messages(server: WebSocketServer) -> None:
    server.send_status({"sensors": [], "camera": {}})
    server.send_status(STATUS)
    for i in range(150):
        server.tell(str(i))
    with client(server) as late:
        assert "skeleton" in received(late)
        assert received(late) == {"status": STATUS}
        assert [received(late)["message"] for _ in range(100)] == [str(i) for i in range(50, 150)]


def test_slow_client_misses_estimates_and_delays_nobody(server: WebSocketServer) -> None:
    address = urlsplit(server.url)
    small = socket.socket()
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    small.connect((address.hostname, address.port))
    with client(server) as quick, client(server, sock=small, max_queue=1) as slow:
        until(lambda: server.clients == 2)
        received(quick)
        longest, sent = 0.0, 0
        deadline = time.monotonic() + 8
        while server.dropped < 50 and time.monotonic() < deadline:
            began = time.monotonic()
            server.send(estimate(sent % 40))
            longest = max(longest, time.monotonic() - began)
            sent += 1
            assert "header" in received(quick)  # of each one: the quick client is not held up
        assert server.dropped >= 50
        assert longest < 0.05
        server.tell("still told")
        assert received(quick) == {"message": "still told"}
        got = 0
        while "message" not in received(slow):
            got += 1
        assert got < sent


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]", "localhost:1", "192.168.0.7"])
def test_own_page_may_read(server: WebSocketServer, host: str) -> None:
    assert answer(server, Host=host, Origin=f"http://{host}", **UPGRADE).status == 101


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:1"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Origin": "http://127.0.0.1:{port}.evil.example"},
        {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"},
        {"Host": "evil.example:{port}"},
        {"Host": "127.0.0.1.evil.example", "Origin": "http://127.0.0.1.evil.example"},
        {"Host": "localhost.", "Origin": "http://localhost."},
    ],
)
def test_other_pages_may_not_read(server: WebSocketServer, headers: dict[str, str]) -> None:
    port = urlsplit(server.url).port
    response = answer(server, **UPGRADE, **{k: v.format(port=port) for k, v in headers.items()})
    assert response.status in (403, 421)
    assert "skeleton" not in response.text
    assert server.clients == 0


def test_two_hosts_or_origins_are_refused(server: WebSocketServer) -> None:
    for name in ("Host", "Origin"):
        own = {"Host": "localhost", "Origin": "http://localhost"}[name]
        twice = [("Origin", own), (name, own)]
        with pytest.raises(InvalidStatus), client(server, additional_headers=twice):
            pass


def test_page_runs_its_own_script_only_and_needs_no_other_server(server: WebSocketServer) -> None:
    response = answer(server)
    html = response.text
    policy = str(response.headers["Content-Security-Policy"])
    address = urlsplit(server.url)
    assert response.status == 200
    assert "unsafe" not in policy
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert f"connect-src ws://{address.netloc} wss://{address.netloc};" in policy
    assert response.headers["Cache-Control"] == "no-store"
    page = Page(html)
    assert page.wrong == []
    assert not [a for a in page.attributes if a[1] in ("src", "srcset", "action", "style") or a[1][:2] == "on"]
    assert [a[2] for a in page.attributes if a[1] == "href"] == ["data:,"]
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(|innerHTML|eval\(", html)
    assert "{{" not in html


def test_other_requests_are_refused(server: WebSocketServer) -> None:
    path = urlsplit(server.url).path
    assert answer(server, f"{path}live.js").status == 404
    assert answer(server, f"{path}?again").status == 200
    assert answer(server, Host="evil.example").status == 421


def test_who_does_not_know_the_token_gets_nothing(server: WebSocketServer) -> None:
    path = urlsplit(server.url).path
    assert len(path) > 20
    assert path != urlsplit(WebSocketServer(BODY).url).path
    for wrong in ("/", "//", path[:-2], path.upper(), f"/x{path}", "/%C3%A9/", f"/?{path}"):
        for headers in ({}, UPGRADE):
            refused = answer(server, wrong, **headers)
            assert (refused.status, "skeleton" in refused.text) == (403, False), wrong


def test_a_browser_is_started_with_an_address_that_leads_to_the_page_once(server: WebSocketServer) -> None:
    path = urlsplit(server.url_once).path
    assert answer(server, path, **UPGRADE).status == 403
    first = answer(server, path)
    assert (first.status, first.headers["Location"]) == (302, urlsplit(server.url).path)
    assert answer(server, path).status == 403


def test_broken_requests_are_survived(server: WebSocketServer) -> None:
    address = urlsplit(server.url)
    for garbage in (b"\x00\xff" * 500, b"POST / HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", b""):
        with socket.create_connection((str(address.hostname), address.port or 0), timeout=5) as raw:
            raw.sendall(garbage)
    with client(server) as talker:
        talker.send("x" * 100_000)
        with pytest.raises(ConnectionClosed):
            while True:
                talker.recv(timeout=5)
    assert answer(server).status == 200


def test_what_is_not_plain_or_of_another_skeleton_is_refused(server: WebSocketServer) -> None:
    with pytest.raises(InvalidInputError, match="NaN"):
        server.send_status({"rate_hz": float("nan")})
    with pytest.raises(InvalidInputError):
        server.send_status({"rate_hz": object()})
    other = planted.moving(SkeletonModel.human36m(), 1).poses
    with pytest.raises(RtofError):
        server.send(OnlineEstimate(other, 0.0, 0.0))


def test_taken_port_names_the_remedy(server: WebSocketServer) -> None:
    port = urlsplit(server.url).port
    assert port is not None
    with pytest.raises(SourceError, match=f"{port}.*another port"):
        WebSocketServer(BODY, port)
    with pytest.raises(SourceError, match="serve"):
        WebSocketServer(BODY, 70_000)


def test_close_ends_connections_and_may_be_repeated() -> None:
    server = WebSocketServer(BODY)
    with client(server) as connection:
        received(connection)
        server.close()
        with pytest.raises(ConnectionClosed):
            received(connection)
    server.close()
    server.send(estimate(0))
    server.tell("nobody hears")
    WebSocketServer(BODY, urlsplit(server.url).port or 0).close()
