"""Who may talk to the application: only who knows the token, from its own page."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtof_kin.app.server import HEADERS, Guarded, _kept_token, serve
from rtof_kin.cli import main
from rtof_kin.core.errors import InvalidInputError, MissingPackageError, OutputExistsError, SourceError
from rtof_kin.core.files.folder import only_one
from rtof_kin.core.local_door import Door

HOST = "127.0.0.1:8000"
ROOT = Path(__file__).parents[2]


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


NAME = "kin.clinic.example"


@pytest.mark.parametrize(
    ("path", "host", "origins", "status"),
    [
        ("TOKEN", NAME, [f"https://{NAME}"], 200),
        ("TOKEN", NAME.upper(), [], 200),
        ("/wrong/", NAME, [], 403),
        ("TOKEN", HOST, [f"http://{HOST}"], 421),
        ("TOKEN", "localhost", [], 421),
        ("TOKEN", f"{NAME}:8443", [], 421),
        ("TOKEN", f"{NAME}.evil.example", [], 421),
        ("TOKEN", NAME, [f"http://{NAME}"], 403),
        ("TOKEN", NAME, ["https://evil.example"], 403),
        ("TOKEN", NAME, [f"http://{HOST}"], 403),
    ],
)
def test_behind_a_proxy_only_its_name_is_let_in_and_the_token_is_asked(
    path: str, host: str, origins: list[str], status: int
) -> None:
    door = Door(f"https://{NAME}")
    path = path.replace("TOKEN", door.path)
    assert asked(door, path, host, origins)[0]["status"] == status
    (sent,) = asked(door, path, host, origins, "websocket")
    assert sent["type"] == ("websocket.accept" if status == 200 else "websocket.close")


@pytest.mark.parametrize(
    "behind", ["http://x.example", "https://x.example/kin", "https://", "x.example", "https://a b"]
)
def test_address_of_a_proxy_is_https_and_a_name(behind: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="https:// and a name alone"):
        serve(tmp_path, behind=behind)


def test_others_reach_it_only_behind_a_proxy(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="give --behind"):
        serve(tmp_path, host="0.0.0.0")
    assert not list(tmp_path.iterdir())


def test_token_behind_a_proxy_is_kept_and_a_damaged_one_is_made_anew(tmp_path: Path) -> None:
    file = tmp_path / ".token"
    first = _kept_token(file)
    assert _kept_token(file) == first
    assert Door(f"https://{NAME}", first).path == f"/{first}/"
    for damage in ("", "short", "a/" * 20, "\N{COMBINING ACUTE ACCENT}" * 30):
        file.write_text(damage, encoding="utf-8")
        made = _kept_token(file)
        assert len(made) == len(first)
        assert made not in (first, damage)


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


def test_container_starts_nothing_that_others_could_reach_without_a_proxy(capsys: pytest.CaptureFixture[str]) -> None:
    lines = (ROOT / "Containerfile").read_text("utf-8").splitlines()
    (begin,) = (json.loads(line.split(maxsplit=1)[1]) for line in lines if line.startswith("ENTRYPOINT"))
    assert begin[:2] == ["rtof-kin", "app"]
    assert main(begin[1:]) == 2
    assert "--host 0.0.0.0: others would see all that is sent; give --behind" in capsys.readouterr().err.replace(
        "\n", " "
    )
    copied = [name for line in lines if line.startswith("COPY") for name in line.split()[1:-1]]
    assert not [name for name in copied if not (ROOT / name).exists()]
