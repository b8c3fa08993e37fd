"""Make pictures of README and docs: ``python -m docs.pictures [NAME ...]``, all of them by default.

Needs the extras ``dev`` and a Chromium. `sensors_only` needs ``--data DIR``, a folder with the recordings of
docs/real_recordings.md; without it that picture is left as it is.
"""

from __future__ import annotations

import argparse
import time
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from docs.pictures.studio import Studio

PICTURES = (
    "placement",
    "report",
    "certificate",
    "view",
    "overlay",
    "compare",
    "follow",
    "live",
    "app",
    "skeletons",
    "study",
    "sensors_only",
    "gallery",
)
"""Modules of this folder, each with ``make(studio) -> paths``."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m docs.pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}")
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    options = parser.parse_args()
    if unknown := set(options.names) - set(PICTURES):
        parser.error(f"{', '.join(sorted(unknown))}: no such picture; there are {', '.join(PICTURES)}")
    with TemporaryDirectory() as folder:
        studio = Studio(Path(folder), options.data)
        for name in options.names or PICTURES:
            started = time.monotonic()
            for path in import_module(f"docs.pictures.{name}").make(studio):
                seconds = time.monotonic() - started
                print(f"wrote {path.name}: {path.stat().st_size / 1e3:.0f} kB in {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
