"""The command app: everything in a browser on this machine."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rtof_kin.cli.options import Browser, command
from rtof_kin.cli.terminal import ended_by_signals, line
from rtof_kin.core.local_door import LOOPBACK


@command
def app(
    *,
    workspace: Annotated[Path, Parameter(metavar="FOLDER")] = Path("~/rtof-kin"),
    port: Annotated[int, Parameter(metavar="N")] = 0,
    browser: Browser = True,
    behind: Annotated[str, Parameter(metavar="URL")] = "",
    host: Annotated[str, Parameter(metavar="ADDRESS")] = LOOPBACK,
) -> None:
    """People, visits and recordings in the browser: drop a video, get a report.

    The page is served to this machine only, under an address with a secret token; nothing leaves it. Ctrl-C ends; a
    reconstruction that ran goes on at the next start. Needs the extra: pip install 'rtof-kin[app]'.

    Args:
        workspace: folder for people and recordings, of this user alone; made if it is not there
        port: of the page; 0: a free one
        behind: address of a proxy with a certificate, as https://kin.clinic.example: pages come by this name alone, and
            the token is kept in the workspace
        host: that it listens on; others than this machine only with --behind
    """
    from rtof_kin.app.server import serve

    def opened(address: str, once: str) -> None:
        seen = f"by the proxy on {host}" if behind else "this machine only"
        line("address", f"{address} ({seen}, to who has this address; Ctrl-C ends)")
        line("files", str(workspace.expanduser().resolve()))
        if browser and not behind:
            webbrowser.open(once)

    with ended_by_signals(), suppress(KeyboardInterrupt):
        serve(workspace, port, opened, behind, host)
