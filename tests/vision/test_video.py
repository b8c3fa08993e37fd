"""Videos of all kinds become upright images at the right times, and people in them detections."""

from __future__ import annotations

import logging
import re
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.vision import video
from rtof_kin.vision.detections import Person
from rtof_kin.vision.keypoint_files import read_detector_file

av: Any = pytest.importorskip("av")
cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("onnx")
from dot_detector import people_model, write_video  # noqa: E402

Array = NDArray[np.float64]
WIDTH, HEIGHT, RATE = 640, 480, 25.0


def error_px(found: Array, truth: Array) -> float:
    return float(np.median(np.linalg.norm(found - truth, axis=-1)))


def quarters() -> NDArray[np.uint8]:
    """An image, wider than high, whose quarters are blue, green, red and black, row by row."""
    image = np.zeros((64, 96, 3), dtype=np.uint8)
    image[:32, :48, 0] = image[:32, 48:, 1] = image[32:, :48, 2] = 250
    return image


class Nobody:
    """A detector that finds one point in each image, and counts."""

    name = "nobody"

    def __init__(self) -> None:
        self.times: list[float] = []
        self.closed = 0

    def find(self, image: NDArray[np.uint8], time: float) -> list[Person]:
        self.times.append(time)
        return [Person(np.array([[image.shape[1], image.shape[0], 1.0]]))]

    def close(self) -> None:
        self.closed += 1


def test_a_video_gives_points_with_its_times(film: tuple[Path, Array], folder: Path) -> None:
    path, uv = film
    told: list[tuple[str, int, int]] = []
    found = video.detect_video(path, folder, progress=lambda *args: told.append(args))
    assert found.uv_px.shape == (10, 1, 17, 2)
    assert error_px(found.uv_px[:, 0], uv) < 5.0  # dots of 4 px, hidden by each other, on a grid
    np.testing.assert_allclose(found.times, np.arange(10) / RATE, atol=2e-3)
    assert told == [("detect", i + 1, 10) for i in range(10)]
    assert len(video.detect_video(path, folder, seconds=0.1)) == 3
    told.clear()
    third = video.detect_video(path, folder, every=3, progress=lambda *args: told.append(args))
    assert told == [("detect", done, 10) for done in (3, 6, 9, 10)]
    np.testing.assert_array_equal(third.uv_px, found.uv_px[::3])
    np.testing.assert_array_equal(third.times, found.times[::3])
    with pytest.raises(InvalidInputError, match="every: 0"):
        video.detect_video(path, folder, every=0)
    video.write_detections(folder / "k.npz", found)
    again = read_detector_file(folder / "k.npz")
    for name in ("uv_px", "confidence", "times"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    assert re.fullmatch(r"pose.onnx on cpu, \d[\d.]* frames per second", found.detector)
    assert again.detector == found.detector
    with pytest.raises(RtofError, match="cannot be written"):
        video.write_detections(folder / "k.npz" / "k.npz", found)


def test_the_command_writes_keypoints_and_their_recording_toml(
    film: tuple[Path, Array], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, uv = film
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    people_model(folder / "yolox.onnx", [[*low, *high, 0.9]])
    out = tmp_path / "keypoints.npz"
    order = ["detect", str(path), "--model-dir", str(folder), "-o", str(out)]
    assert main(order) == 0
    said = capsys.readouterr().out
    assert "10 frames of up to 1 people, 10 frames with at least one" in said
    assert 'layout = "coco17"' in said
    assert "detector: pose.onnx and yolox.onnx on cpu" in said
    assert re.search(r"detected by pose.onnx and yolox.onnx on cpu, \d[\d.]* frames per second", said)
    assert "load " not in said  # rtmlib prints when it loads a model
    assert read_detector_file(out).uv_px.shape == (10, 1, 17, 2)
    assert main(order) == 2
    assert "is there already" in capsys.readouterr().err
    assert main([*order, "--overwrite"]) == 0
    assert main([*order, "--overwrite", "--provider", "coreml"]) == (0 if sys.platform == "darwin" else 2)


def test_the_rate_is_that_of_the_detector_without_its_first_image(
    film: tuple[Path, Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, steps = [0.0], iter([7.0, *[0.04] * 9])

    class Slow(Nobody):
        def find(self, image: NDArray[np.uint8], time: float) -> list[Person]:
            clock[0] += next(steps)
            return super().find(image, time)

    monkeypatch.setattr(video.time, "perf_counter", lambda: clock[0])
    assert video.detect_video(film[0], Slow()).detector == "nobody, 25 frames per second"


class Webcam:
    """OpenCV's capture of a camera that is stopped with Ctrl-C, or unplugged."""

    def __init__(self, source: int, images: int, ends: type[BaseException] | None = None):
        self.source, self.left, self.ends, self.released = source, images, ends, False

    def isOpened(self) -> bool:
        return self.left > 0

    def read(self) -> tuple[bool, Any]:
        self.left -= 1
        if self.left < 0 and self.ends is not None:
            raise self.ends
        return self.left >= 0, np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)

    def get(self, _: int) -> float:
        return 0.0

    def release(self) -> None:
        self.released = True


def test_a_webcam_may_be_interrupted_and_has_clock_times(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras: list[Webcam] = []

    def opened(source: int) -> Webcam:
        cameras.append(Webcam(source, 4, KeyboardInterrupt))
        return cameras[-1]

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    found = video.detect_video(1, folder, seconds=60.0)
    assert (cameras[0].source, cameras[0].released) == (1, True)
    assert len(found) == 4
    assert found.times is not None
    assert found.times[0] == pytest.approx(0.0, abs=0.05)
    assert np.all(np.diff(found.times) > 0)
    with pytest.raises(InvalidInputError, match="webcam 1: give seconds"):
        video.detect_video(1, folder)
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: Webcam(source, 0))
    with pytest.raises(FileFormatError, match="webcam 3: not a camera"):
        video.detect_video(3, folder, seconds=1.0)


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_a_turned_video_is_upright(rotation: int, tmp_path: Path) -> None:
    path = write_video(tmp_path / "turned.mp4", [quarters()] * 3, rotation=rotation)
    frame = next(iter(video.read_video(path)))
    np.testing.assert_allclose(frame.image, np.rot90(quarters(), rotation // 90), atol=40)
    _, of_opencv = cv2.VideoCapture(str(path)).read()
    assert frame.image.shape == of_opencv.shape
    np.testing.assert_allclose(frame.image.astype(float), of_opencv, atol=2)
    assert frame.image.flags.c_contiguous


def test_times_are_those_of_the_frames_where_the_rate_varies(tmp_path: Path) -> None:
    stamps = [70, 110, 111, 300, 333, 1333]
    path = write_video(tmp_path / "varying.mp4", [quarters()] * 6, times_ms=stamps)
    times = [frame.time for frame in video.read_video(path)]
    np.testing.assert_allclose(times, (np.array(stamps) - 70) / 1000, atol=1e-9)


def test_slow_motion_has_real_times(tmp_path: Path) -> None:
    tags = {"com.android.capture.fps": "240.000000"}
    path = write_video(tmp_path / "slow.mp4", [quarters()] * 5, metadata=tags)  # plays at 25 Hz
    np.testing.assert_allclose([f.time for f in video.read_video(path)], np.arange(5) / 240, atol=1e-4)


def test_pixels_that_are_not_square_become_square(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.mp4", [quarters()] * 2, aspect=Fraction(4, 3))
    frame = next(iter(video.read_video(path)))
    assert frame.image.shape == (64, 128, 3)
    np.testing.assert_allclose(frame.image[10, [30, 90]], [[250, 0, 0], [0, 250, 0]], atol=40)


def test_damaged_parts_are_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 64, 96, 3), dtype=np.uint8)
    path = write_video(tmp_path / "damaged.mkv", list(noise), codec="ffv1")
    data = bytearray(path.read_bytes())
    whole = [frame.time for frame in video.read_video(path)]
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        left = [frame.time for frame in video.read_video(path)]
    assert 6 <= len(left) <= 12
    assert np.all(np.diff(left) > 0)
    assert set(np.round(left, 3)) <= set(np.round(whole, 3))
    path.write_bytes(data[: 2 * middle // 3])  # as of a phone whose battery went flat
    assert 1 <= len(list(video.read_video(path))) < 12


def test_a_playlist_that_names_other_files_is_refused(film: tuple[Path, Array], tmp_path: Path) -> None:
    lists = {
        "hls.m3u8": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{film[0]}\n#EXT-X-ENDLIST\n",
        "concat.mp4": f"ffconcat version 1.0\nfile '{film[0]}'\n",
        "empty.mp4": "",
        "text.mp4": "no video",
    }
    for name, text in lists.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(FileFormatError, match=rf"{name}: not a readable video .*convert it to MP4"):
            list(video.read_video(tmp_path / name))
    for path in (tmp_path / "none.mp4", tmp_path):
        with pytest.raises(FileFormatError, match="there is no such video"):
            list(video.read_video(path))
    with av.open(str(tmp_path / "sound.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), dtype=np.int16), layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
    (tmp_path / "sound.wav").rename(tmp_path / "sound.mp4")
    with pytest.raises(FileFormatError, match="sound.mp4: not a readable video"):
        list(video.read_video(tmp_path / "sound.mp4"))


def test_any_bytes_give_frames_or_an_error_of_the_package(tmp_path: Path) -> None:
    path = write_video(tmp_path / "film.mp4", [quarters()] * 8, rotation=90)
    data, rng = path.read_bytes(), np.random.default_rng(1)
    read = 0
    for _ in range(30):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 8):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(data) // 2, len(data))])
        try:
            read += len(list(video.read_video(path)))
        except FileFormatError as error:
            assert "film.mp4" in str(error)  # noqa: PT017
    path.write_bytes(data)
    assert len(list(video.read_video(path))) == 8


def test_a_detector_gets_images_and_times_and_is_closed(tmp_path: Path) -> None:
    path = write_video(tmp_path / "turned.mp4", [quarters()] * 4, rotation=90)
    nobody = Nobody()
    found = video.detect_video(path, nobody)
    np.testing.assert_allclose(nobody.times, [0, 0.04, 0.08, 0.12])
    np.testing.assert_array_equal(found.uv_px[:, 0, 0], [[64, 96]] * 4)
    assert nobody.closed == 1
    nobody = Nobody()
    with pytest.raises(FileFormatError, match="there is no such video"):
        video.detect_video(tmp_path / "none.mp4", nobody)
    assert nobody.closed == 1


def test_nothing_of_a_video_is_kept(film: tuple[Path, Array], folder: Path, tmp_path: Path) -> None:
    before = set(tmp_path.rglob("*")) | set(film[0].parent.rglob("*"))
    video.write_detections(tmp_path / "k.npz", video.detect_video(film[0], folder))
    after = set(tmp_path.rglob("*")) | set(film[0].parent.rglob("*"))
    assert after - before == {tmp_path / "k.npz"}
    assert (tmp_path / "k.npz").stat().st_size < 10 * 17 * 100


def test_times_follow_from_the_rate_where_a_file_has_none() -> None:
    times = [-np.inf]
    for stamp in (None, None, 0.01, 0.5):
        times.append(video._next_time("film.mp4", times[-1], stamp, 30.0))
    np.testing.assert_allclose(times[1:], [0, 1 / 30, 2 / 30, 0.5])
    with pytest.raises(FileFormatError, match="neither times nor a frame rate"):
        video._next_time("film.mp4", 0.0, 0.0, None)
