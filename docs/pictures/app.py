"""``app_*.png``: every page of the application, with the demo that it brings along."""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from typing import Final

from PIL import Image

from docs.pictures.studio import DOCS, Studio, save
from rtof_kin.app.start import add_demo
from rtof_kin.app.store import FILES, Store

sys.path += [str(DOCS.parent / "tests" / folder) for folder in ("support", "app")]
SIZE: Final = 1024, 800
"""[px] of the window."""
HIGHEST: Final = 1500
"""[px] of a whole page; of a higher one the window is shown that begins with its text."""
BEFORE, RUNNING, DONE = range(3)
"""When a picture is taken: before the demo is reconstructed, meanwhile, afterwards."""
PAGES: Final = (
    ("start", BEFORE, "start", "Memory: "),
    ("recording", BEFORE, "DEMO", "Ready: "),
    ("running", RUNNING, "DEMO", "from image to space"),
    ("result", DONE, "DEMO", "3. Result"),
    ("review", DONE, "DEMO/review", "Add"),
    ("compare", DONE, "people/demo/comparisons", "Compare"),
    ("plan", DONE, "people/demo/plans", "Make the plan"),
    ("record", DONE, "record/P07/2026-02-14", "Start"),
    ("people", DONE, "", "P12"),
    ("person", DONE, "people/P07", "2026-02-14"),
    ("trash", DONE, "trash", "Take "),
)
"""Name of the picture, when, address (DEMO: of the demo's recording), and a text that shows that the page is ready."""
_SCROLL: Final = "[...document.querySelectorAll('div')].findLast(one => one.textContent === %r).scrollIntoView()"


def make(studio: Studio) -> list[Path]:
    from app_support import Server, Window  # of the tests

    store = Store(studio.folder / "workspace")
    demo = add_demo(store)
    for person, height in (("P07", 1.73), ("P12", 1.64)):
        store.add_person(person, height)
    for visit, names in (("2026-01-10", ("walk",)), ("2026-02-14", ("walk", "squats", "trial"))):
        store.add_visit("P07", visit)
        for name in names:
            files = store.add_take("P07", visit, name) / FILES
            (files / "keypoints.csv").write_bytes((demo / FILES / "keypoints.csv").read_bytes())
    store.delete("P07", "2026-02-14", "trial")
    server = Server(store.root)
    written = []
    try:
        with Window(studio.folder / "app", *SIZE) as window:
            place = "/".join(("people", *demo.relative_to(store.root).parts))
            for moment in (BEFORE, RUNNING, DONE):
                if moment == RUNNING:
                    window.open(server.address + place)
                    window.click("Reconstruct")
                if moment == DONE:
                    window.says("3. Result", 900)
                for name, when, address, text in PAGES:
                    if when == moment:
                        window.open(server.address + address.replace("DEMO", place))
                        window.says(text, 120)
                        whole = window.value("document.body.scrollHeight") <= HIGHEST
                        if not whole:
                            window.value(_SCROLL % text)
                        time.sleep(2)  # what is drawn by scripts
                        picture = window.picture(studio.folder / f"app_{name}.png", whole)
                        with Image.open(picture) as image:
                            written.append(save(image, picture.name))
    finally:
        server.end(signal.SIGINT)
    return written
