"""`Door`: who may talk to a server of this machine: its own page, and programs that know its address.

The address has a secret token, so that other users of the machine get nothing. A browser names the host that
it asked for, and the page that asks: only addresses of numbers or ``localhost``, and only the server's own
page, so that no other page in the same browser can read, also not one whose name points to this machine.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
from collections.abc import Mapping
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from rtof_kin.core.packages import optional

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

LOOPBACK: Final = "127.0.0.1"
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:[0-9]{1,5})?")


class Door:
    """Lets in who has the token; for servers of the package ``websockets``."""

    def __init__(self) -> None:
        """Make a token."""
        self._token, self._ticket = secrets.token_urlsafe(16), secrets.token_urlsafe(16)

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
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._trusts(hosts[0]):
            return response(HTTPStatus.MISDIRECTED_REQUEST, "use the address as numbers, or localhost")
        _, _, path = request.path.partition("?")[0].partition("/")
        key, _, rest = path.partition("/")
        upgrade = bool(request.headers.get_all("Upgrade"))
        if self._ticket and _same(key, self._ticket) and not upgrade:
            self._ticket = ""
            return response(HTTPStatus.FOUND, "", {"Location": self.path, "Cache-Control": "no-store"})
        if not _same(key, self._token):
            return response(HTTPStatus.FORBIDDEN, "use the whole address that was printed")
        if upgrade and origins and [origin.lower() for origin in origins] != [f"http://{hosts[0]}".lower()]:
            return response(HTTPStatus.FORBIDDEN, "another page may not read here")
        request.path = f"/{rest}"
        return None

    def _trusts(self, host: str) -> bool:
        """Return whether a name cannot be that of a foreign page which points to this machine."""
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


def response(status: HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return an answer that closes the connection; headers: None for those of plain text."""
    http, structures = (optional(f"websockets.{name}", "live") for name in ("http11", "datastructures"))
    body = text.encode()
    own: Mapping[str, Any] = {"Content-Type": "text/plain; charset=utf-8"} if headers is None else headers
    whole = structures.Headers({**own, "Content-Length": str(len(body)), "Connection": "close"})
    answer: Response = http.Response(status.value, status.phrase, whole, body)
    return answer
