"""``skeletons.png``: the demo's figure of every stage over the truth."""

from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save


def make(studio: Studio) -> list[Path]:
    with Image.open(studio.demo / "figures" / "skeletons.png") as image:
        return [save(image, "skeletons.png")]
