"""``overlay.png``: one picture of the demo drawn on a plain background, since the demo has no video."""

from pathlib import Path

import av

from docs.pictures.studio import Studio, save

OPTIONS = ("--no-video", "--bands", "--width", "1200", "--start", "13.5", "--stop", "14")


def make(studio: Studio) -> list[Path]:
    film = studio.folder / "demo.mp4"
    studio.rtof_kin("overlay", studio.demo, "-o", film, *OPTIONS)
    with av.open(str(film)) as container:
        return [save(next(container.decode(video=0)).to_image(), "overlay.png")]
