"""`Door`: who may talk to a server of this machine: its own page, and programs that know its address.

The address has a secret token, so that other users of the machine get nothing. A browser names the host that
it asked for, and the page that asks: only addresses of numbers or ``localhost``, and only the server's own
page, so that no other page in the same browser can read, also not one whose name points to this machine.

Behind a proxy that has the name and the certificate, only that name and pages of it are let in; the token stays.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.core.packages import optional

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

LOOPBACK: Final = "127.0.0.1"
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:[0-9]{1,5})?")
_BEHIND: Final = re.compile(rf"https://{_HOST.pattern}", re.IGNORECASE)


class Door:
    """Lets in who has the token; for servers of the package ``websockets``."""

    def __init__(self, behind: str = "", token: str = "") -> None:
        """Make a token, unless there is one.

        `behind`: address of a proxy, as https://kin.clinic.example; `InvalidInputError` if it is not https and a name.
        """
        if behind and not _BEHIND.fullmatch(behind):
            raise InvalidInputError(f"{behind}: give https:// and a name alone, as https://kin.clinic.example")
        self._behind = behind.lower()
        self._token, self._ticket = token or secrets.token_urlsafe(16), secrets.token_urlsafe(16)

    @property
    def path(self) -> str:
        """Path of the page, with the token."""
        return f"/{self._token}/"

    @property
    def ticket(self) -> str:
        """Path that leads to the page once: other users see what a browser is started with."""
        return f"/{self._ticket}/"

    def answer(self, request: Request) -> Response | None:
        """Return what answers a request at the door; None lets it in, with a path that lacks the token."""
        headers, path = request.headers, request.path.partition("?")[0]
        upgrade = bool(headers.get_all("Upgrade"))
        found = self.judged(path, headers.get_all("Host"), headers.get_all("Origin") if upgrade else [], upgrade)
        if found is None:
            request.path = f"/{path[len(self.path) :]}"
            return None
        status, text = found
        if status is HTTPStatus.FOUND:
            return response(status, "", {"Location": text, "Cache-Control": "no-store"})
        return response(status, text)

    def judged(
        self, path: str, hosts: Sequence[str], origins: Sequence[str], upgrade: bool = False
    ) -> tuple[HTTPStatus, str] | None:
        """Return the status and the sentence of a refusal, or of a redirection and where it leads; None lets in.

        `path`: with the token, without a query. `hosts`, `origins`: values of the headers Host and Origin. `upgrade`:
        to a WebSocket, which the ticket does not open.
        """
        if len(hosts) != 1 or not self._trusts(hosts[0]):
            return HTTPStatus.MISDIRECTED_REQUEST, "use the address as numbers, or localhost"
        key = path.removeprefix("/").partition("/")[0]
        if self._ticket and _same(key, self._ticket) and not upgrade:
            self._ticket = ""
            return HTTPStatus.FOUND, self.path
        if not _same(key, self._token):
            return HTTPStatus.FORBIDDEN, "use the whole address that was printed"
        own = self._behind or f"http://{hosts[0]}".lower()
        if origins and [origin.lower() for origin in origins] != [own]:
            return HTTPStatus.FORBIDDEN, "another page may not read here"
        return None

    def _trusts(self, host: str) -> bool:
        """Return whether a name cannot be that of a foreign page which points to this machine."""
        if self._behind:
            return f"https://{host}".lower() == self._behind
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name = found[1].strip("[]").lower()
        if name == "localhost":
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def _same(key: str, secret: str) -> bool:
    return secrets.compare_digest(key.encode(errors="replace"), secret.encode())


def listening(port: int, host: str = LOOPBACK) -> socket.socket:
    """Return a socket that listens, by default on this machine alone, at a free port if `port` is 0; `SourceError` if
    taken.
    """
    try:
        if not 0 <= port < 1 << 16:
            raise OSError("a port is a number up to 65535")
        return socket.create_server((host, port))
    except OSError as error:
        raise SourceError(
            f"{host}:{port}: cannot serve there ({error}); end the other program, or give another port"
        ) from error


def response(status: HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return an answer that closes the connection; headers: None for those of plain text."""
    http, structures = (optional(f"websockets.{name}", "live") for name in ("http11", "datastructures"))
    body = text.encode()
    own: Mapping[str, Any] = {"Content-Type": "text/plain; charset=utf-8"} if headers is None else headers
    whole = structures.Headers({**own, "Content-Length": str(len(body)), "Connection": "close"})
    answer: Response = http.Response(status.value, status.phrase, whole, body)
    return answer
