"""OpenSim in its own process, reading a folder of exported files."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

READER = Path(__file__).with_name("opensim_reader.py")


def read_by_opensim(folder: Path, out: Path) -> dict[str, NDArray[np.float64]]:
    """Return the results of `opensim_reader` by name of file and kind; `out` is a temporary file."""
    if importlib.util.find_spec("opensim") is None:
        pytest.skip("OpenSim is not installed")
    done = subprocess.run(
        [sys.executable, str(READER), str(folder), str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(out) as found:
        return dict(found)
