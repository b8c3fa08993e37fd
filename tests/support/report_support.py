"""Folders of reconstructions, pages and a browser, for the tests of `rtof_kin.reporting`."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.data.confidence import Confidence
from rtof_kin.reporting.plot_data import MISSING

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_VOID = {"meta", "input", "br", "img"}


def folder_of(motion: Motion, folder: Path, **fields: Any) -> Path:
    """Folder of a reconstruction with fields of its summary."""
    folder.mkdir(parents=True)
    write_motion(folder / "motion.h5", motion, mode="rtof")
    summary = {"recording": "walk", "mode": "rtof", "acknowledgement": "", "inputs": {}, "audit": []}
    (folder / "summary.json").write_text(json.dumps(summary | fields))
    return folder


def certain_to(degrees: float, motion: Motion) -> Confidence:
    """A confidence with the same standard deviation of all relative rotations."""
    T, names = len(motion.times), motion.skeleton.names
    pairs = tuple((j.parent, j.child) for j in angle_table(motion.skeleton.table).joints)
    pairs = tuple(dict.fromkeys(pairs))
    position = np.tile(1e-4 * np.eye(3), (T, len(names), 1, 1))
    turn = np.tile(np.radians(degrees) ** 2 * np.eye(3), (T, len(pairs), 1, 1))
    return Confidence(motion.times, names, position, position, pairs, turn)


class Page(HTMLParser):
    """Parsed page: text by the id of the section, attributes, and tags that are not closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text: dict[str, str] = {}
        self.attributes: list[tuple[str, str, str]] = []
        self.wrong: list[str] = []
        self._open: list[str] = []
        self._section = ""
        self.feed(html)
        self.close()
        self.wrong += self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "section":
            self._section = dict(attrs).get("id") or ""
        if tag not in _VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open.pop() != tag:
            self.wrong.append(tag)
        self.handle_data(" ")
        if tag == "section":
            self._section = ""

    def handle_data(self, data: str) -> None:
        within = next((tag for tag in ("script", "style") if tag in self._open), self._section)
        self.text[within] = self.text.get(within, "") + data


def unpacked(text: str, scale: int, shape: tuple[int, ...] = (-1,)) -> NDArray[np.float64]:
    """Inverse of `plot_data.packed`."""
    numbers = np.frombuffer(base64.b64decode(text), dtype="<i2").astype(float)
    return np.where(numbers == MISSING, np.nan, numbers / scale).reshape(shape)


def plotted_data(html: str) -> Any:
    """Data for the script of the page."""
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', html, re.DOTALL)
    assert found is not None
    return json.loads(found.group(1))


def rendered(page: Path, profile: Path) -> str:
    """DOM in a headless browser after the script has run."""
    assert BROWSER is not None
    done = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={profile}",
            "--virtual-time-budget=2000",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return done.stdout
