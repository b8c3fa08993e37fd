"""Images of a video at any time, upright, in the order in which they are asked for."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from overlay_support import write_film

from rtof_kin.core.errors import FileFormatError
from rtof_kin.view.camera_layer import HEIGHT, Image, VideoFrames

av = pytest.importorskip("av")
RATE, FRAMES, SIZE = 25, 200, (320, 180)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds; the grey level of an image is its number, the left half is black."""
    path = tmp_path_factory.mktemp("video") / "grey.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"g": "50", "crf": "10"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for number in range(FRAMES):
            image = np.full((SIZE[1], SIZE[0], 3), 20 + number, dtype=np.uint8)
            image[:, : SIZE[0] // 2] = 0
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


class Screen:
    def __init__(self) -> None:
        self.images: list[Image] = []
        self.came = threading.Event()

    def __call__(self, image: Image) -> None:
        self.images.append(image)
        self.came.set()

    def next(self) -> Image:
        assert self.came.wait(20.0)
        self.came.clear()
        return self.images[-1]


def test_image_is_that_of_the_time(video: Path) -> None:
    screen = Screen()
    with VideoFrames(video, screen) as frames:
        assert frames.size == SIZE
        for number in (0, 1, 2, 10, 180, 60, 59, 199, 3):
            frames.request(number / RATE)
            image = screen.next()
            assert image.shape == (SIZE[1], SIZE[0], 3)
            assert np.median(image[:, -100:]) == pytest.approx(20 + number, abs=2.5)
            assert np.median(image[:, :100]) < 10
        frames.request(3 / RATE)  # the same one is not sent again
        frames.request(99.0)  # after the end: the last one
        assert np.median(screen.next()[:, -100:]) == pytest.approx(219, abs=2.5)
        assert frames.problem is None


def test_only_the_last_of_many_requests_is_decoded(video: Path) -> None:
    screen = Screen()
    with VideoFrames(video, screen) as frames:
        for number in range(FRAMES):
            frames.request(number / RATE)
        deadline = time.monotonic() + 20
        while not (screen.images and np.median(screen.images[-1][:, -100:]) > 216):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert len(screen.images) < FRAMES


def test_large_images_are_made_smaller(tmp_path: Path) -> None:
    image = np.zeros((720, 1280, 3), dtype=np.uint8)
    image[:, 640:, 2] = 200
    path = write_film(tmp_path / "large.mp4", [image], [0])
    screen = Screen()
    with VideoFrames(path, screen) as frames:
        frames.request(0.0)
        image = screen.next()
    assert image.shape == (HEIGHT, 640, 3)
    assert image[180, 600, 0] > 150 > 60 > image[180, 600, 2]  # red stays red


def test_what_is_no_video_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video")
    with pytest.raises(FileFormatError, match="not a readable video"):
        VideoFrames(path, Screen())
    with pytest.raises(FileFormatError, match="no such video"):
        VideoFrames(tmp_path / "b.mp4", Screen())
