"""A viser server of this machine only: it listens at the loopback and lets in who knows the address."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, Final
from weakref import WeakKeyDictionary

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.core.local_door import LOOPBACK, Door
from rtof_kin.core.packages import install, optional

_DOORS: Final = WeakKeyDictionary[Any, Door]()
_LOG: Final = logging.getLogger("rtof_kin.view.local_server")
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False  # else what a client sends wrongly is printed with a traceback


@contextmanager
def local_server(port: int = 0, title: str = "rtof_kin") -> Iterator[Any]:
    """Yield a `viser.ViserServer` at the loopback address that is stopped at the end.

    It cannot be shared over viser's public relay, and answers only who knows its `address`, see
    `rtof_kin.core.local_door`.

    `port`: TCP port; 0: a free one.

    Raises:
        SourceError: the port is taken. RtofError: the extra is not installed.
    """
    viser = optional("viser", "view")
    if not 0 <= port < 1 << 16:
        raise SourceError(f"port {port}: a port is a number from 1 to 65535, or 0 for a free one")
    door = Door()
    with redirect_stdout(io.StringIO()), _guarded(door) as guarded:  # only the command line prints
        server = viser.ViserServer(host=LOOPBACK, port=port, label=title, verbose=False)
    try:
        if port and server.get_port() != port:
            raise SourceError(f"{LOOPBACK}:{port}: taken; end the other program, or give another port")
        try:
            assert guarded, "it is served in another way"
            _keep_local(server)
        except (AttributeError, AssertionError, RtofError) as error:  # viser's own names have changed
            raise RtofError(
                f"this version of viser cannot be kept to this machine ({error}): {install('view')} viser==1.1.1"
            ) from error
        _DOORS[server] = door
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any, once: bool = False) -> str:
    """Return the address of the page, with its secret token.

    `server`: of `local_server`. once: the one that leads there once, to start a browser with.
    """
    door = _DOORS[server]
    return f"http://{LOOPBACK}:{server.get_port()}{door.ticket if once else door.path}"


@contextmanager
def _guarded(door: Door) -> Iterator[list[int]]:
    """Have viser, which offers no way to do so, serve behind a door; yields the ports of servers."""
    websockets = optional("websockets.asyncio.server", "view")
    serve, ports = websockets.serve, list[int]()

    def behind(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            refused = door.answer(request)
            return process_request(connection, request) if refused is None else refused

        ports.append(port)
        return serve(handler, host, port, process_request=answer, logger=_LOG, **options)

    websockets.serve = behind
    try:
        yield ports
    finally:
        websockets.serve = serve


def _keep_local(server: Any) -> None:
    """Take away the relay, and let no error of a client reach the terminal."""
    messages = optional("viser._messages", "view")
    connections = server._websock_server
    for kind in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        connections.unregister_handler(kind)
    loop = connections._background_event_loop
    loop.call_soon_threadsafe(loop.set_exception_handler, lambda *_: None)
