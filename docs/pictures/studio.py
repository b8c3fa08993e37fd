"""What the pictures share: commands of the package, their outputs, a headless browser, small PNG files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from functools import cached_property
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent.parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--hide-scrollbars",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


class Studio:
    """A temporary folder with the outputs that the pictures show, each made when it is first used."""

    def __init__(self, folder: Path, data: Path | None = None):
        """Take an empty folder, and that of real recordings."""
        self.folder, self.data = folder, data

    def rtof_kin(self, *arguments: str | Path) -> None:
        """Run one command of the package."""
        subprocess.run([sys.executable, "-m", "rtof_kin.cli", *map(str, arguments)], check=True)

    def printed(self, *arguments: str | Path) -> str:
        """Return what one command prints on a terminal 100 columns wide."""
        command = [sys.executable, "-m", "rtof_kin.cli", *map(str, arguments)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | {"COLUMNS": "100"})
        return done.stdout

    @cached_property
    def demo(self) -> Path:
        """Output of the demo: camera and eight sensors."""
        self.rtof_kin("run", "--demo", "-o", self.folder / "demo")
        return self.folder / "demo"

    def photograph(
        self,
        page: Path | str,
        picture: Path,
        width: int,
        height: int,
        milliseconds: int = 4000,
        flags: tuple[str, ...] = ("--disable-gpu",),
        scale: float = 1.0,
    ) -> None:
        """Write what a browser shows of a page, width x height in CSS pixels, as a PNG."""
        browser = next(filter(None, map(shutil.which, BROWSERS)), None)
        if browser is None:
            sys.exit(f"no browser: install one of {', '.join(BROWSERS)}")
        address = page if isinstance(page, str) else page.as_uri()
        subprocess.run(
            [
                browser,
                *FLAGS,
                *flags,
                f"--user-data-dir={self.folder / 'profile'}",
                f"--window-size={width},{height}",
                f"--force-device-scale-factor={scale}",
                f"--virtual-time-budget={milliseconds}",
                f"--screenshot={picture}",
                address,
            ],
            check=True,
            timeout=180,
            stderr=subprocess.DEVNULL,
        )


def save(image: Image.Image, name: str, width: int | None = None) -> Path:
    """Write a picture of 256 colours to the docs, at most `width` px wide."""
    if width is not None and image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    path = DOCS / name
    image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE).save(path, optimize=True)
    return path


def side_by_side(images: list[Image.Image], gap: int = 12) -> Image.Image:
    """Return pictures next to each other on white, as high as the highest."""
    width = sum(image.width for image in images) + gap * (len(images) - 1)
    whole = Image.new("RGB", (width, max(image.height for image in images)), "white")
    x = 0
    for image in images:
        whole.paste(image.convert("RGB"), (x, 0))
        x += image.width + gap
    return whole
