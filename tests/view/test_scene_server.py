"""The viewer is of this machine only: loopback, no relay, no other page, no other request."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.view.scene.local_server import address, local_server

viser = pytest.importorskip("viser")
PROTOCOL: Any = [f"viser-v{viser.__version__}"]


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with local_server() as opened:
        opened.scene.add_frame("/secret")
        yield opened


def client(server: Any, **how: Any) -> ClientConnection:
    return connect(
        address(server).replace("http", "ws"), subprotocols=PROTOCOL, proxy=None, compression=None, **how
    )


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="Linux's list of sockets")
def test_it_listens_at_the_loopback_address_only(server: Any) -> None:
    assert address(server) == f"http://127.0.0.1:{server.get_port()}/"
    sockets = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = [line[1] for line in sockets if line[3] == "0A"]
    port = f":{server.get_port():04X}"
    assert [place for place in listening if place.endswith(port)] == ["0100007F" + port]


def test_page_of_another_origin_gets_nothing(server: Any) -> None:
    port = server.get_port()
    for origin in ("http://evil.example", f"http://evil.example:{port}", "http://127.0.0.1:1", "null"):
        with client(server, origin=origin) as socket_, pytest.raises(ConnectionClosed) as closed:
            assert b"secret" not in bytes(socket_.recv(timeout=5))
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008
    for origin in (f"http://127.0.0.1:{port}", f"http://localhost:{port}", None):
        with client(server, origin=origin) as socket_:
            assert len(bytes(socket_.recv(timeout=5))) > 50


def test_relay_cannot_be_asked_for(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = pytest.importorskip("viser._messages")
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *a: asked.append(a))
    handlers = server._websock_server._incoming_handlers
    assert messages.ShareUrlRequest not in handlers
    assert messages.ShareUrlDisconnect not in handlers
    assert messages.ViewerCameraMessage.__name__  # the names that are looked for are still viser's
    themes = [
        m for m in server._websock_server._broadcast_buffer.message_from_id.values()
        if isinstance(m, messages.ThemeConfigurationMessage)
    ]  # fmt: skip
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
