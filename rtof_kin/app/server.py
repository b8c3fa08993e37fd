"""The server of the application: for this machine only, behind `rtof_kin.core.local_door`."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Awaitable, Callable, MutableMapping
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.people import PeoplePages
from rtof_kin.app.record import RecordPages
from rtof_kin.app.review import ReviewPages
from rtof_kin.app.start import StartPages
from rtof_kin.app.store import Store
from rtof_kin.app.studies import StudyPages
from rtof_kin.app.take import TakePages
from rtof_kin.app.texts import TEXTS, speak
from rtof_kin.app.work import Work
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import only_one
from rtof_kin.core.files.manifest import make_folders
from rtof_kin.core.files.text import write_text
from rtof_kin.core.local_door import LOOPBACK, Door, listening
from rtof_kin.core.packages import optional

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]
HEADERS: Final = {
    "content-security-policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; object-src 'none'; "
    "base-uri 'none'; form-action 'self'; frame-ancestors 'self'",
    "referrer-policy": "same-origin",
    "x-content-type-options": "nosniff",
}
"""Of every answer that has none of its own: nothing is fetched from, and shown in, another site."""
_LOCK, _UPLOADS, _SETTINGS, _TOKEN = ".app.lock", ".uploads", ".nicegui", ".token"


class Guarded:
    """An ASGI application behind a door: it sees what comes with the token, which is its root path."""

    def __init__(self, inner: Application, door: Door):
        """Take the application and its door."""
        self._inner, self._door = inner, door

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._inner(scope, receive, send)
            return
        upgrade, values = scope["type"] == "websocket", dict[str, list[str]]()
        for name, value in scope["headers"]:
            values.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        found = self._door.judged(scope["path"], values.get("host", []), values.get("origin", []), upgrade)
        if found is None:
            root = self._door.path.rstrip("/")
            await self._inner({**scope, "root_path": root}, receive, _with_headers(send))
        elif upgrade:
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": found[1]})  # before it is open: HTTP 403
        else:
            status, text = found
            moved = status is HTTPStatus.FOUND
            headers = [(b"location", text.encode())] if moved else [(b"content-type", b"text/plain; charset=utf-8")]
            headers.append((b"cache-control", b"no-store"))
            await send({"type": "http.response.start", "status": status.value, "headers": headers})
            await send({"type": "http.response.body", "body": b"" if moved else text.encode()})


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = {name.lower() for name, _ in message["headers"]}
            more = [(name.encode(), text.encode()) for name, text in HEADERS.items() if name.encode() not in own]
            message = {**message, "headers": [*message["headers"], *more]}
        await send(message)

    return sent


def serve(
    workspace: str | Path,
    port: int = 0,
    opened: Callable[[str, str], None] | None = None,
    behind: str = "",
    host: str = LOOPBACK,
) -> None:
    """Serve the application until the process is interrupted or told to end.

    Args:
        workspace: folder for people, visits and recordings; made if it is not there.
        port: of the page; 0: a free one.
        opened: called with the address, and with the one that leads there once, to start a browser with.
        behind: address of a proxy with a certificate, as https://kin.clinic.example, by which alone it is reached; the
            token is then kept in the workspace.
        host: that it listens on; another one than this machine alone only behind a proxy.

    Raises:
        MissingPackageError: the extra is not installed. SourceError: the port is taken.
        OutputExistsError: another process serves this workspace. RtofError: it cannot be made.
        InvalidInputError: `behind` is no such address, or is missing where others reach `host`.
    """
    if host != LOOPBACK and not behind:
        raise InvalidInputError(f"--host {host}: others would see all that is sent; give --behind, the proxy's address")
    store = Store(workspace)
    speak(store.settings.language)
    with only_one(store.root / _LOCK, str(store.root)), listening(port, host) as opening:
        door = Door(behind, _kept_token(store.root / _TOKEN) if behind else "")
        uploads = store.root / _UPLOADS
        shutil.rmtree(uploads, ignore_errors=True)  # of a server that was killed
        make_folders(uploads)
        tempfile.tempdir = str(uploads)  # large files wait here until they are complete
        os.environ["NICEGUI_STORAGE_PATH"] = str(store.root / _SETTINGS)  # else in the present folder
        nicegui, fastapi, uvicorn = (optional(name, "app", "app") for name in ("nicegui", "fastapi", "uvicorn"))
        nicegui.run.process_pool_start_method = "spawn"  # this process has threads
        app, work = fastapi.FastAPI(docs_url=None, redoc_url=None, openapi_url=None), Work(store)
        try:
            for pages in (PeoplePages, StudyPages, TakePages, ReviewPages, RecordPages, StartPages):
                pages(nicegui, store, work, door.path.rstrip("/"))
            nicegui.ui.run_with(app, title=TEXTS.title, dark=None, language=TEXTS.code, show_welcome_message=False)
            root = behind or f"http://{LOOPBACK}:{opening.getsockname()[1]}"
            if opened is not None:
                opened(root + door.path, root + door.ticket)
            quiet: dict[str, Any] = {"log_level": "error", "server_header": False, "timeout_graceful_shutdown": 1}
            config = uvicorn.Config(Guarded(app, door), proxy_headers=False, ws="websockets-sansio", **quiet)
            uvicorn.Server(config).run(sockets=[opening])
        finally:
            work.close()


def _kept_token(path: Path) -> str:
    """Return the token of a workspace behind a proxy, which is the same after a new start."""
    kept = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    if not re.fullmatch(r"[\w-]{22,}", kept, re.ASCII):
        kept = secrets.token_urlsafe(24)
        write_text(path, kept, overwrite=True)
    return kept
