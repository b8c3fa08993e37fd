"""A viser server of this machine only: it listens at the loopback address and lets no other page read."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, Final
from urllib.parse import urlsplit

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.core.packages import install, optional

LOOPBACK: Final = "127.0.0.1"
_REFUSED: Final = 1008
"""Code of WebSocket for a policy that is violated."""


@contextmanager
def local_server(port: int = 0, title: str = "rtof_kin") -> Iterator[Any]:
    """Yield a `viser.ViserServer` at the loopback address that is stopped at the end.

    It cannot be shared over viser's public relay, and a page of another origin, which the same browser may
    show, cannot connect.

    Args:
        port: TCP port; 0: a free one. title: of the panel.

    Raises:
        SourceError: the port is taken. RtofError: the extra is not installed.
    """
    viser = optional("viser", "view")
    if not 0 <= port < 1 << 16:
        raise SourceError(f"port {port}: a port is a number from 1 to 65535, or 0 for a free one")
    with redirect_stdout(io.StringIO()):  # only the command line prints
        server = viser.ViserServer(host=LOOPBACK, port=port, label=title, verbose=False)
    try:
        if port and server.get_port() != port:
            raise SourceError(f"{LOOPBACK}:{port}: taken; end the other program, or give another port")
        try:
            _keep_local(server)
        except (AttributeError, AssertionError, RtofError) as error:  # viser's own names have changed
            raise RtofError(
                f"this version of viser cannot be kept to this machine ({error}): "
                f"{install('view')} viser==1.1.1"
            ) from error
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any) -> str:
    """Return the address of the page.

    Args:
        server: of viser.
    """
    return f"http://{LOOPBACK}:{server.get_port()}/"


def _keep_local(server: Any) -> None:
    """Take away the relay, and refuse clients that belong to another page."""
    messages = optional("viser._messages", "view")
    connections = server._websock_server
    connections._live_connections.copy()  # raises here, not in the first client, if it has another name
    for kind in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        connections.unregister_handler(kind)
    own = {(name, server.get_port()) for name in (LOOPBACK, "localhost")}

    async def refuse_strangers(client: Any) -> None:
        connection = connections._live_connections[client.client_id]
        origins = connection.request.headers.get_all("Origin")
        if not all(_place(origin) in own for origin in origins):
            await connection.close(_REFUSED, "another page may not read here")

    connections._client_connect_cb.insert(0, refuse_strangers)


def _place(origin: str) -> tuple[str, int] | None:
    """Return host and port of a page's origin; None if it has none."""
    try:
        parts = urlsplit(origin)
        return parts.hostname or "", parts.port or 80
    except ValueError:
        return None
