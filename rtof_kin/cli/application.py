"""The command app: everything in a browser on this machine."""

from __future__ import annotations

import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rtof_kin.cli.options import Browser, command
from rtof_kin.cli.terminal import ended_by_signals, line


@command
def app(
    *,
    workspace: Annotated[Path, Parameter(metavar="FOLDER")] = Path("~/rtof-kin"),
    port: Annotated[int, Parameter(metavar="N")] = 0,
    browser: Browser = True,
) -> None:
    """People, visits and recordings in the browser: drop a video, get a report.

    The page is served to this machine only, under an address with a secret token; nothing leaves it. Ctrl-C ends; a
    reconstruction that ran goes on at the next start. Needs the extra: pip install 'rtof-kin[app]'.

    Args:
        workspace: folder for people and recordings, of this user alone; made if it is not there
        port: of the page; 0: a free one
    """
    from rtof_kin.app.server import serve

    def opened(address: str, once: str) -> None:
        line("address", f"{address} (this machine only, to who has this address; Ctrl-C ends)")
        line("files", str(workspace.expanduser().resolve()))
        if browser:
            webbrowser.open(once)

    with ended_by_signals(), suppress(KeyboardInterrupt):
        serve(workspace, port, opened)
