"""``study.png``: contribution of each sensor to the first ten seconds of the demo."""

from dataclasses import replace
from pathlib import Path

from PIL import Image

from docs.pictures.studio import Studio, save
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording

SECONDS = 10


def make(studio: Studio) -> list[Path]:
    recording = Recording.load(model_path("demo"))
    video = recording.video
    frames = slice(0, int((video.times < video.times[0] + SECONDS).sum()))
    replace(recording, keypoints=video[frames]).save(studio.folder / "ten_seconds")
    studio.rtof_kin("study", studio.folder / "ten_seconds", "-o", studio.folder / "study")
    with Image.open(studio.folder / "study" / "figures" / "sensors.png") as image:
        return [save(image, "study.png", 930)]
