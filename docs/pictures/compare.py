"""``compare.png``: the demo with sensors against the camera alone, two screens of the page."""

from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save, side_by_side
from rtof_kin.core.resources import model_path

WIDTH, HEIGHT = 1000, 1240
ANGLES = [f"{side}_{name}" for side in ("right", "left") for name in ("knee_flexion", "elbow_flexion")]


def make(studio: Studio) -> list[Path]:
    camera, page = studio.folder / "camera_alone", studio.folder / "comparison"
    studio.rtof_kin("reconstruct", model_path("demo"), "--mode", "rto", "-o", camera)
    studio.rtof_kin("compare", studio.demo, camera, "--angles", ",".join((*ANGLES, "pelvis_tilt")), "-o", page)
    picture = studio.folder / "compare.png"
    studio.photograph(page / "comparison.html", picture, WIDTH, 2 * HEIGHT)
    with Image.open(picture) as whole:
        halves = [whole.crop((0, y, WIDTH, y + HEIGHT)) for y in (0, HEIGHT)]
    return [save(side_by_side(halves), "compare.png", 1500)]
