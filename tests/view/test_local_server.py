"""The viewer is of this machine only: loopback, no relay, no other page, no other request."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.view.viewer import address, local_server

viser = pytest.importorskip("viser")
PROTOCOL: Any = [f"viser-v{viser.__version__}"]


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with local_server() as opened:
        opened.scene.add_frame("/secret")
        yield opened


def client(server: Any, **how: Any) -> ClientConnection:
    return connect(address(server).replace("http", "ws"), subprotocols=PROTOCOL, proxy=None, compression=None, **how)


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="Linux's list of sockets")
def test_it_listens_at_the_loopback_address_only(server: Any) -> None:
    assert address(server).startswith(f"http://127.0.0.1:{server.get_port()}/")
    sockets = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = [line[1] for line in sockets if line[3] == "0A"]
    port = f":{server.get_port():04X}"
    assert [place for place in listening if place.endswith(port)] == ["0100007F" + port]


def test_page_of_another_origin_gets_nothing(server: Any) -> None:
    port = server.get_port()
    for origin in ("http://evil.example", f"http://evil.example:{port}", f"http://localhost:{port}", "null"):
        with pytest.raises(InvalidStatus, match="403"), client(server, origin=origin):
            pass
    for origin in (f"http://127.0.0.1:{port}", None):
        with client(server, origin=origin) as socket_:
            assert len(bytes(socket_.recv(timeout=5))) > 50


def test_who_does_not_know_the_token_gets_neither_the_page_nor_the_scene(server: Any) -> None:
    root = f"http://127.0.0.1:{server.get_port()}/"
    for url in (root, f"{root}index.html", f"{root}?{address(server)}"):
        with pytest.raises(HTTPError, match="403"):
            urlopen(url, timeout=5)
        with pytest.raises(InvalidStatus, match="403"):
            connect(url.replace("http", "ws"), subprotocols=PROTOCOL, proxy=None)
    for url in (address(server, once=True), address(server)):
        with urlopen(url, timeout=5) as page:
            assert b"<html" in page.read()[:2000]
    with pytest.raises(HTTPError, match="403"):
        urlopen(address(server, once=True), timeout=5)


def test_what_a_client_sends_wrongly_is_not_printed(server: Any, capfd: pytest.CaptureFixture[str]) -> None:
    for wrong in ("text", b"", b"\xc1", b"\x81\xa4type\xa4evil", b"\x80"):
        with client(server) as socket_:
            socket_.send(wrong)
            with pytest.raises(ConnectionClosed):
                while True:
                    socket_.recv(timeout=5)
    port = server.get_port()
    with socket.create_connection(("127.0.0.1", port)) as raw:
        raw.sendall(b"\x00\xff\r\n\r\n")
        raw.recv(1000)
    with client(server) as socket_:
        assert socket_.recv(timeout=5)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_relay_cannot_be_asked_for(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = pytest.importorskip("viser._messages")
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *a: asked.append(a))
    handlers = server._websock_server._incoming_handlers
    assert messages.ShareUrlRequest not in handlers
    assert messages.ShareUrlDisconnect not in handlers
    assert messages.ViewerCameraMessage.__name__  # the names that are looked for are still viser's
    themes = [
        m
        for m in server._websock_server._broadcast_buffer.message_from_id.values()
        if isinstance(m, messages.ThemeConfigurationMessage)
    ]
    assert [theme.show_share_button for theme in themes] == [False]
    assert asked == []


def test_port_that_is_taken_is_told_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(SourceError, match="taken"), local_server(port):
            pass
    with pytest.raises(SourceError, match="65535"), local_server(70000):
        pass
    with local_server(port) as server:
        assert server.get_port() == port
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_another_viser_whose_names_are_unknown_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("viser.infra._infra.WebsockMessageHandler.unregister_handler")
    with pytest.raises(RtofError, match="cannot be kept to this machine"), local_server():
        pass
