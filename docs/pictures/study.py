"""``study.png``: change of each angle of the demo without each sensor."""

from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save
from rtof_kin.core.resources import model_path


def make(studio: Studio) -> list[Path]:
    studio.rtof_kin("study", model_path("demo"), "-o", studio.folder / "study")
    with Image.open(studio.folder / "study" / "figures" / "sensors.png") as image:
        return [save(image, "study.png", 930)]
