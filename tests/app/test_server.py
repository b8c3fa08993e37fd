"""Who may talk to the application: only who knows the token, from its own page."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtof_kin.app.server import HEADERS, Guarded, serve
from rtof_kin.core.errors import MissingPackageError, OutputExistsError, SourceError
from rtof_kin.core.files.folder import only_one
from rtof_kin.core.local_door import Door

HOST = "127.0.0.1:8000"


async def inner(scope: Any, receive: Any, send: Any) -> None:
    """Says what it was asked."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": [(b"referrer-policy", b"own")]})
    await send({"type": "http.response.body", "body": f"{scope['root_path']} {scope['path']}".encode()})


def asked(
    door: Door, path: str, host: str | None = HOST, origins: Sequence[str] = (), kind: str = "http"
) -> list[dict[str, Any]]:
    """Messages that answer a request."""
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": f"{kind}.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [(b"Host", one.encode()) for one in [host] if one is not None] + [
        (b"origin", one.encode()) for one in origins
    ]
    asyncio.run(Guarded(inner, door)({"type": kind, "path": path, "headers": headers}, receive, send))
    return sent


def test_token_leads_in_and_is_the_root_of_the_application() -> None:
    door = Door()
    start, body = asked(door, f"{door.path}people/P07")
    assert start["status"] == 200
    assert body["body"].decode() == f"{door.path[:-1]} {door.path}people/P07"
    headers = dict(start["headers"])
    assert headers[b"referrer-policy"] == b"own"
    assert headers[b"content-security-policy"].decode() == HEADERS["content-security-policy"]
    assert "http" not in HEADERS["content-security-policy"]  # no other site


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("path", "host", "origins", "status"),
    [
        ("/", HOST, [], 403),
        ("/wrong/", HOST, [], 403),
        ("TOKEN", "evil.example:8000", [], 421),
        ("TOKEN", None, [], 421),
        ("TOKEN", HOST, ["http://evil.example"], 403),
        ("TOKEN", HOST, ["http://127.0.0.1:9000"], 403),
        ("TOKEN", HOST, ["null"], 403),
        ("TOKEN", HOST, [f"http://{HOST}", "http://evil.example"], 403),
    ],
)
def test_others_get_nothing(kind: str, path: str, host: str | None, origins: list[str], status: int) -> None:
    door = Door()
    sent = asked(door, path.replace("TOKEN", door.path), host, origins, kind)
    if kind == "websocket":
        assert [message["type"] for message in sent] == ["websocket.close"]
    else:
        assert sent[0]["status"] == status
        assert door.path not in str(sent)


def test_own_page_may_open_its_websocket() -> None:
    door = Door()
    (sent,) = asked(door, f"{door.path}_nicegui_ws/socket.io/", HOST, [f"http://{HOST}"], "websocket")
    assert sent["type"] == "websocket.accept"


def test_ticket_leads_to_the_page_once() -> None:
    door = Door()
    ticket = door.ticket
    assert asked(door, ticket, kind="websocket")[0]["type"] == "websocket.close"
    assert dict(asked(door, ticket)[0]["headers"])[b"location"].decode() == door.path
    assert asked(door, ticket)[0]["status"] == 403


def test_workspace_has_one_server(tmp_path: Path) -> None:
    with only_one(tmp_path / ".app.lock", "other"), pytest.raises(OutputExistsError, match="is at work on it"):
        serve(tmp_path)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "nicegui", None)
    with pytest.raises(MissingPackageError, match=r'pip install "rtof-kin\[app\]"'):
        serve(tmp_path)


def test_port_that_is_taken_is_said(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot serve there"):
        serve(tmp_path, 1 << 17)
