"""Asks OpenSim, in a process of its own, what it makes of a folder of files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

READER = Path(__file__).with_name("opensim_reader.py")


def read_by_opensim(folder: Path, out: Path) -> dict[str, NDArray[np.float64]]:
    """What `opensim_reader` found in a folder, by name of file and kind, passed in the file `out`."""
    done = subprocess.run(
        [sys.executable, str(READER), str(folder), str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(out) as found:
        return dict(found)
