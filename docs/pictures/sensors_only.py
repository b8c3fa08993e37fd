"""``sensors_only.png``: skeletons of a real recording of 17 sensors, without a camera."""

import subprocess
import sys
from pathlib import Path

from PIL import Image

from docs.pictures.studio import DOCS, Studio, save

TRIAL = "hipose_mtw17"


def make(studio: Studio) -> list[Path]:
    if studio.data is None:
        return []
    example, out = DOCS.parent / "examples" / "sensors_only.py", studio.folder / TRIAL
    (log,) = (studio.data / TRIAL).rglob("example_calibration_xsens")
    subprocess.run([sys.executable, str(example), TRIAL, str(log), str(out)], check=True)
    with Image.open(out / "figures" / "moving.png") as image:
        return [save(image, "sensors_only.png")]
