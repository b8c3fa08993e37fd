"""``live.png``: the live page while the demo's streams are replayed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image

from docs.pictures.studio import DOCS, Studio, save
from rtof_kin.core.resources import model_path

sys.path.append(str(DOCS.parent / "tests" / "support"))
SIZE = 1180, 1060
"""[px] of the window."""
SECONDS = 8
"""[s] of the motion before the picture."""


def make(studio: Studio) -> list[Path]:
    from browser_support import BrowserPage  # a page that lives needs more than a photograph

    demo, port, picture = model_path("demo"), free_port(), studio.folder / "live.png"
    session = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "rtof_kin.cli",
            "live",
            str(demo),
            "--camera",
            str(demo),
            "--imus",
            str(demo),
            "--send",
            f"ws:{port}",
            "--seconds",
            "60",
        ],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        wait_for(port, 60)
        with BrowserPage(studio.folder / "live", *SIZE) as page:
            page.open(f"http://127.0.0.1:{port}/")
            page.until(r"/\d\s*Hz/.test(document.body.innerText)", 90)  # poses arrive
            time.sleep(SECONDS)
            page.picture(picture, whole=False)
    finally:
        session.send_signal(signal.SIGINT)
        session.wait(30)
    with Image.open(picture) as image:
        return [save(image, "live.png")]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(port: int, seconds: float) -> None:
    """Wait until something listens at a port."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    sys.exit(f"nothing listens at port {port} after {seconds:g} s")
