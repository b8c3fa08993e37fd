"""``view.png``: the demo in the 3D viewer, from behind the camera, the truth beside the motion."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

from PIL import Image

from docs.pictures.studio import DOCS, Studio, save
from rtof_kin.view.viewer import MotionViewer, address, local_server, motion_files

sys.path.append(str(DOCS.parent / "tests" / "support"))
SIZE = 1400, 800
"""[px] of the window."""
TIME = 3.9
"""[s] of the demo."""
PLACE, TARGET = (4.6, -7.0, 2.3), (1.5, -1.0, 1.0)
"""[m] of the view and what it looks at, in world."""
WARNING = "document.querySelector('.mantine-Notification-closeButton')?.click()"
"""Closes the note that the browser has no graphics card."""


def make(studio: Studio) -> list[Path]:
    from browser_support import SOFTWARE_3D, BrowserPage  # the pages of a server need more than a photograph

    picture = studio.folder / "view.png"
    with (
        motion_files(studio.demo) as files,
        local_server(title="rtof_kin view") as server,
        MotionViewer(server, files) as viewer,
        BrowserPage(studio.folder / "view", *SIZE, flags=SOFTWARE_3D) as page,
    ):
        viewer.scene.stage.following = False
        viewer.scene.put_beside(0.8)
        viewer.playback.seek(TIME, time.monotonic())
        stop = threading.Event()
        player = threading.Thread(target=viewer.run, args=(stop,))
        player.start()
        page.open(address(server))
        while not server.get_clients():
            time.sleep(0.1)
        for client in server.get_clients().values():
            client.camera.position, client.camera.look_at = PLACE, TARGET
        page.until(f"document.body.innerText.includes('{TIME:.3f} s')", 60)
        time.sleep(8)
        page.value(WARNING)
        time.sleep(4)
        page.picture(picture, whole=False)
        stop.set()
        player.join()
    with Image.open(picture) as image:
        return [save(image, "view.png")]
