"""Make ``docs/overlay.png`` by the commands in ``docs/overlay.md``: ``python docs/overlay_picture.py``.

Runs ``rtof-kin demo`` and ``rtof-kin overlay`` without a video, since the demo has none, and takes one
picture of the film. Needs PyAV (extra ``view``).
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import av

PICTURE = Path(__file__).parent / "overlay.png"
OPTIONS = ["--no-video", "--bands", "--width", "1200", "--from", "13.5", "--to", "14"]


def rtof_kin(*arguments: str) -> None:
    """Run one command of the package."""
    subprocess.run([sys.executable, "-m", "rtof_kin.cli", *arguments], check=True)


def main() -> None:
    with TemporaryDirectory() as name:
        folder, film = Path(name) / "demo", Path(name) / "demo.mp4"
        rtof_kin("demo", "-o", str(folder), "--no-figures")
        rtof_kin("overlay", str(folder), "-o", str(film), *OPTIONS)
        with av.open(str(film)) as container:
            frame = next(container.decode(video=0))
            frame.to_image().quantize(128).save(PICTURE, optimize=True)
    print(f"wrote {PICTURE}: {PICTURE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
