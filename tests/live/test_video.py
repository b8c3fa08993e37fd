"""Points of one person come from webcams and videos, stamped when the image was taken."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from numpy.typing import NDArray

from rtof_kin.core.errors import RtofError, SourceError
from rtof_kin.live import video as webcam
from rtof_kin.live.replay import ReplayClock
from rtof_kin.live.samples import Clock, FrameSample
from rtof_kin.live.video import VideoSource
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.keypoints import keypoints_from_detections

av: Any = pytest.importorskip("av")
pytest.importorskip("onnx")
from dot_detector import write_video  # noqa: E402

CAMERA = watching(walking())
WIDE, HIGH = CAMERA.width_px // 10, CAMERA.height_px // 10
FRAMES, RATE = 40, 25.0
DEADLINE = 5.0
INF = float("inf")


class Walker:
    """A detector that knows where the walker is at each time, and takes its time."""

    name = "walker"
    points = 33

    def __init__(self, seconds: float = 0.0, scale: float = 0.1, fails_at: int | None = None):
        uv = points_px("mediapipe33", walking(), CAMERA) * scale
        self.people = np.concatenate([uv, np.full((*uv.shape[:2], 1), 0.9)], axis=-1)
        self.seconds, self.fails_at, self.seen, self.closed = seconds, fails_at, 0, 0

    def find(self, image: NDArray[np.uint8], at: float) -> list[Person]:
        assert image.shape[2] == 3
        assert np.isfinite(at)
        if self.seen == self.fails_at:
            raise ValueError("out of memory")
        time.sleep(self.seconds)
        self.seen += 1
        return [Person(self.people[(self.seen - 1) % len(self.people)])]

    def close(self) -> None:
        self.closed += 1


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dark video of 40 images at 25 Hz."""
    images = [np.zeros((HIGH, WIDE, 3), dtype=np.uint8) for _ in range(FRAMES)]
    return write_video(tmp_path_factory.mktemp("film") / "walk.mp4", images)


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Put FFmpeg's test picture in the place of cameras."""

    def put(picture: str) -> None:
        monkeypatch.setattr(webcam, "device_of", lambda _: (f"{picture},realtime", "lavfi"))

    return put


@contextmanager
def running(source: VideoSource) -> Iterator[VideoSource]:
    source.start()
    try:
        yield source
    finally:
        source.close()
        source.close()


def polled(source: VideoSource, count: float = INF) -> list[FrameSample]:
    """Samples until there are so many, or until the end."""
    found: list[FrameSample] = []
    deadline = time.monotonic() + DEADLINE
    while len(found) < count and not source.finished:
        assert time.monotonic() < deadline
        found += [s for s in source.poll() if isinstance(s, FrameSample)]
        time.sleep(0 if count == INF else 0.002)
    return found


def test_every_image_of_a_file_gives_the_points_that_the_offline_reader_gives(film: Path) -> None:
    walker = Walker()
    size = (CAMERA.width_px, CAMERA.height_px)
    with running(VideoSource(film, lambda: walker, camera_px=size, replay=ReplayClock(INF))) as source:
        samples = polled(source)
        assert source.clock is Clock.COMMON
        assert source.notices() == []
    assert walker.closed == 1
    times = np.array([s.time for s in samples])
    np.testing.assert_allclose(times, np.arange(FRAMES) / RATE, atol=2e-3)
    found = Detections.of_frames({i: [Person(p)] for i, p in enumerate(Walker(scale=1.0).people[:FRAMES])})
    offline = keypoints_from_detections(found, times, CAMERA, "mediapipe33").keypoints
    assert source.landmarks == offline.names
    np.testing.assert_allclose([s.uv_px for s in samples], offline.uv_px, atol=1e-6)
    np.testing.assert_allclose([s.confidence for s in samples], offline.confidence, atol=1e-9)


def test_a_file_without_pace_waits_for_the_frames_that_are_due(film: Path) -> None:
    clock, newest = ReplayClock(INF), -1.0
    with running(VideoSource(film, lambda: Walker(0.002), replay=clock)) as source:
        for reached in np.arange(20) / 60:
            newest = max([newest, *(sample.time for sample in source.poll())])
            assert reached - 1 / RATE < newest <= reached + 1e-9


def test_a_file_at_its_speed_comes_when_it_is_due_and_shows_its_latency(film: Path) -> None:
    clock = ReplayClock(4.0)
    with running(VideoSource(film, lambda: Walker(0.004), replay=clock)) as source:
        begun = time.monotonic()
        assert np.isnan(source.latency_s)
        samples = polled(source)
        took = time.monotonic() - begun
        assert len(samples) == FRAMES
        assert took > (FRAMES - 1) / RATE / 4.0
        assert source.latency_s >= 0.004
        assert source.examination.detection_s >= 0.004


def test_a_detector_that_is_too_slow_for_a_file_is_told_of(film: Path) -> None:
    with running(VideoSource(film, lambda: Walker(0.05), replay=ReplayClock(100.0))) as source:
        told: list[str] = []
        deadline = time.monotonic() + DEADLINE
        while not told and time.monotonic() < deadline:
            source.poll()
            told = source.notices()
        assert any("late" in sentence and "ms" in sentence for sentence in told)


def test_of_a_webcam_the_newest_image_is_examined_and_the_others_are_counted(stage: Callable[[str], None]) -> None:
    stage(f"testsrc=size={WIDE}x{HIGH}:rate=200")
    told: list[str] = []
    samples: list[Any] = []
    with running(VideoSource(0, lambda: Walker(0.03))) as source:
        began = time.monotonic()
        while not told and time.monotonic() < began + DEADLINE:
            samples += polled(source, 1)
            told += source.notices()
        now = time.monotonic()
        assert source.examination.dropped >= 30
        assert 0.03 <= source.latency_s < DEADLINE
    (sentence,) = told
    assert "not examined" in sentence
    times = np.array([s.time for s in samples])
    assert np.all(np.diff(times) > 0)
    assert times[0] > began - DEADLINE
    assert times[-1] <= now - 0.03  # taken before it was detected
    assert source.finished


def test_images_of_the_calibrated_camera_in_another_size_are_scaled_and_others_refused(
    stage: Callable[[str], None],
) -> None:
    stage("testsrc=size=96x64:rate=100")
    with running(VideoSource(0, lambda: Walker(scale=0.05), camera_px=(192, 128))) as source:
        (first, *_) = polled(source, 1)
        expected = Walker(scale=0.1).people[0, :, :2]
        np.testing.assert_allclose(first.uv_px[-33:], expected, atol=1e-9)
    walker = Walker()
    with pytest.raises(SourceError, match=r"96 x 64.*128 x 192"):
        VideoSource(0, lambda: walker, camera_px=(128, 192)).start()
    assert walker.closed == 1


def test_a_detector_that_fails_ends_the_stream_with_a_sentence(film: Path) -> None:
    with running(VideoSource(film, lambda: Walker(fails_at=5), replay=ReplayClock(INF))) as source:
        assert len(polled(source)) == 5
        (sentence,) = source.notices()
        assert "out of memory" in sentence


def test_points_that_are_no_person_are_told_of(film: Path) -> None:
    walker = Walker()
    walker.people[:, :, :2] = np.random.default_rng(0).uniform(0, HIGH, (33, 2))
    with running(VideoSource(film, lambda: walker, replay=ReplayClock(INF))) as source:
        polled(source)
        assert any("doubtful" in sentence for sentence in source.notices())


def test_a_source_without_anybody_gives_frames_without_points(film: Path) -> None:
    walker = Walker()
    walker.people[:, :, 2] = 0.0
    with running(VideoSource(film, lambda: walker, replay=ReplayClock(INF))) as source:
        samples = polled(source)
    assert len(samples) == FRAMES
    assert np.isnan([s.uv_px for s in samples]).all()
    assert not np.any([s.confidence for s in samples])


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (errno.EBUSY, "another program"),
        (errno.EACCES, "group video"),
        (errno.ENOENT, "no such camera"),
        (errno.EIO, "cannot be opened"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_named_with_the_remedy(
    number: int, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **how: Any) -> None:
        raise OSError(number, "no")

    monkeypatch.setattr(webcam, "device_of", lambda _: ("/dev/video3", "v4l2"))
    monkeypatch.setattr(av, "open", refuse)
    with pytest.raises(SourceError, match=f"camera 3.*{says}"):
        VideoSource(3, lambda: Walker()).start()


def test_devices_are_named_as_each_system_names_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert webcam.device_of(2, "linux") == ("/dev/video2", "v4l2")
    assert webcam.device_of("/dev/video1", "linux") == ("/dev/video1", "v4l2")
    assert webcam.device_of(0, "darwin") == ("0", "avfoundation")
    monkeypatch.setattr(webcam, "cameras_of", lambda _: ["Front", "Back"])
    assert webcam.device_of(1, "win32") == ("video=Back", "dshow")
    with pytest.raises(SourceError, match="Front, Back"):
        webcam.device_of(2, "win32")
    with pytest.raises(SourceError, match="beos"):
        webcam.device_of(0, "beos")


def test_what_is_no_video_and_a_missing_detector_are_source_errors(film: Path, tmp_path: Path) -> None:
    text = tmp_path / "notes.mp4"
    text.write_text("no video")
    for path in (text, tmp_path / "absent.mp4"):
        with pytest.raises(SourceError, match=path.name):
            VideoSource(path, lambda: Walker()).start()

    def none() -> Walker:
        raise RtofError("no detector of people is at hand: --fetch-models")

    with pytest.raises(SourceError, match="--fetch-models"):
        VideoSource(film, none).start()
    strange = Walker()
    strange.points = 42
    with pytest.raises(SourceError, match=r"42.*33"):
        VideoSource(film, lambda: strange).start()


def test_times_of_capture_are_the_drivers_where_they_are_of_the_systems_clock() -> None:
    kernel = webcam.CaptureTimes()
    assert kernel(100.0, 100.04) == 100.0
    assert kernel(100.03, 100.2) == 100.03
    assert kernel(None, 100.5) == 100.5


def test_times_of_capture_on_another_clock_follow_the_earliest_arrivals() -> None:
    rng = np.random.default_rng(0)
    stamps = np.arange(300) / 30
    now = 5000.0 + stamps * (1 + 2e-5) + rng.exponential(0.01, len(stamps))
    own = webcam.CaptureTimes()
    taken = np.array([own(*pair) for pair in zip(stamps, now, strict=True)])
    assert np.all(np.diff(taken) > 0)
    assert np.all(taken <= now)
    late = taken - (5000.0 + stamps * (1 + 2e-5))
    assert np.abs(late[50:]).max() < 0.005


def test_a_webcam_that_stops_says_so_and_may_be_started_again(
    stage: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage("testsrc=size=96x64:rate=100:duration=0.05")
    source = VideoSource(0, Walker)
    for _ in range(2):
        with running(source):
            assert len(polled(source, 2)) >= 2
            deadline = time.monotonic() + DEADLINE
            with pytest.raises(SourceError, match="camera 0: stopped"):
                while time.monotonic() < deadline:
                    source.poll()
            assert not source.finished
        assert source.finished


def test_a_missing_camera_is_found_once_it_is_there(stage: Callable[[str], None]) -> None:
    source = VideoSource("/dev/video97", Walker)
    with pytest.raises(SourceError, match="no such camera"):
        source.start()
    source.close()
    stage("testsrc=size=96x64:rate=100")
    with running(source):
        assert polled(source, 1)
