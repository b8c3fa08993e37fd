"""Make ``docs/report.png`` by the commands in ``docs/report.md``: ``python docs/report_picture.py``.

Runs ``rtof-kin demo`` and ``rtof-kin report``, photographs the top of the page in a headless Chromium,
and sets its first two screens side by side. Needs ``chromium`` (or ``google-chrome``); Pillow comes with
matplotlib.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

PICTURE = Path(__file__).parent / "report.png"
LABELS = [
    "--subject", "P07", "--operator", "A. Analyst", "--date", "2026-01-31", "--weight", "70",
]  # fmt: skip
SCREEN = 1240, 1786
"""[px] of the page, width and height, that make one half of the picture."""
HALF = 750, 1080
"""[px] of that half."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def rtof_kin(*arguments: str) -> None:
    """Run one command of the package."""
    subprocess.run([sys.executable, "-m", "rtof_kin.cli", *arguments], check=True)


def photograph(page: Path, picture: Path) -> None:
    """Write the first two screens of a page as they are after its script has run."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"no browser: install one of {', '.join(BROWSERS)}")
    width, height = SCREEN
    subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
         f"--user-data-dir={picture.parent / 'profile'}", f"--window-size={width},{2 * height}",
         "--virtual-time-budget=4000", f"--screenshot={picture}", page.as_uri()],
        check=True, timeout=120, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def main() -> None:
    with TemporaryDirectory() as name:
        folder = Path(name) / "demo"
        rtof_kin("demo", "-o", str(folder), "--no-figures")
        rtof_kin("report", str(folder), *LABELS)
        photograph(folder / "report.html", Path(name) / "page.png")
        width, height = SCREEN
        with Image.open(Path(name) / "page.png") as page:
            whole = Image.new("RGB", (2 * HALF[0], HALF[1]))
            for i in range(2):
                half = page.convert("RGB").crop((0, i * height, width, (i + 1) * height))
                whole.paste(half.resize(HALF, Image.Resampling.LANCZOS), (i * HALF[0], 0))
        whole.quantize(256, Image.Quantize.MAXCOVERAGE).save(PICTURE, optimize=True)
    print(f"wrote {PICTURE}")


if __name__ == "__main__":
    main()
