"""The detector on MediaPipe's interface; `tests/check_real_video.py` runs the real one."""

from __future__ import annotations

import importlib.machinery
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.vision.mediapipe_detector import MediaPipeDetector, contained_models


class Landmarker:
    """Stands for MediaPipe's: one person at the brightest red pixel, and its extrapolated foot."""

    made: list[Landmarker] = []

    def __init__(self, options: Any):
        self.options, self.stamps, self.closed = options, list[int](), False
        self.more: list[Any] = []
        if options.base_options.buffer == b"damaged":
            raise RuntimeError("Unable to parse the bundle\nand more")
        Landmarker.made.append(self)

    create_from_options = classmethod(lambda cls, options: cls(options))

    def detect_for_video(self, picture: Any, stamp_ms: int) -> Any:
        assert not self.stamps or stamp_ms > self.stamps[-1]
        self.stamps.append(stamp_ms)
        red = picture.data[..., 0]
        if not red.any():
            return SimpleNamespace(pose_landmarks=[])
        v, u = np.unravel_index(red.argmax(), red.shape)
        at = SimpleNamespace(x=u / red.shape[1], y=v / red.shape[0], visibility=0.9)
        foot = SimpleNamespace(x=at.x, y=1.2, visibility=0.8)
        return SimpleNamespace(pose_landmarks=[[at, foot], *self.more])

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that stands for the installed package; without models inside."""
    Landmarker.made.clear()
    folder = tmp_path / "mediapipe"
    folder.mkdir()
    names = ("mediapipe", "mediapipe.tasks", "mediapipe.tasks.python", "mediapipe.tasks.python.vision")
    modules: dict[str, Any] = {name: ModuleType(name) for name in names}
    spec = importlib.machinery.ModuleSpec("mediapipe", None, is_package=True)
    spec.submodule_search_locations = [str(folder)]
    modules["mediapipe"].__spec__ = spec
    modules["mediapipe"].ImageFormat = SimpleNamespace(SRGB="rgb")
    modules["mediapipe"].Image = lambda image_format, data: SimpleNamespace(format=image_format, data=data)
    modules["mediapipe.tasks.python"].BaseOptions = lambda model_asset_buffer: SimpleNamespace(
        buffer=model_asset_buffer
    )
    vision = modules["mediapipe.tasks.python.vision"]
    vision.PoseLandmarkerOptions = SimpleNamespace
    vision.RunningMode = SimpleNamespace(VIDEO="video")
    vision.PoseLandmarker = Landmarker
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return folder


def test_points_are_pixels_of_a_colour_image(package: Path) -> None:
    (package / "pose.task").write_bytes(b"bundle")
    detector = MediaPipeDetector(package / "pose.task")
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    assert detector.find(image, 0.0) == []
    image[30, 150] = [0, 0, 255]  # red of BGR
    image[60, 20] = [255, 0, 0]
    (person,) = detector.find(image, 0.04)
    np.testing.assert_allclose(person.points, [[150, 30, 0.9], [150, 120, 0.0]])  # the foot is not seen
    (made,) = Landmarker.made
    assert made.options.base_options.buffer == b"bundle"
    assert (made.options.running_mode, made.options.num_poses) == ("video", 4)
    detector.close()
    assert made.closed


def test_two_findings_of_one_person_are_one(package: Path) -> None:
    (package / "pose.task").write_bytes(b"bundle")
    detector = MediaPipeDetector(package / "pose.task")
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    image[30, 150, 2] = 255  # from (150, 30) to (150, 120)
    (made,) = Landmarker.made
    points = [SimpleNamespace(x=0.75, y=0.4, visibility=1.0), SimpleNamespace(x=0.75, y=0.95, visibility=1.0)]
    made.more = [points]
    (person,) = detector.find(image, 0.0)
    np.testing.assert_allclose(person.points, [[150, 40, 1], [150, 95, 1]])  # the surer one
    made.more = [[SimpleNamespace(x=p.x - 0.25, y=p.y, visibility=1.0) for p in points], points]
    assert len(detector.find(image, 0.1)) == 2


def test_times_increase_for_mediapipe_whatever_the_video_has(package: Path) -> None:
    (package / "pose.task").write_bytes(b"bundle")
    detector = MediaPipeDetector(package / "pose.task")
    for time in (0.0, 0.0001, 0.0002, 0.04):
        detector.find(np.zeros((4, 4, 3), dtype=np.uint8), time)
    assert Landmarker.made[0].stamps == [0, 1, 2, 40]


def test_a_model_that_cannot_be_used_is_named(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileFormatError, match="none.task: there is no such model"):
        MediaPipeDetector(package / "none.task")
    (package / "pose.task").write_bytes(b"damaged")
    with pytest.raises(FileFormatError, match="pose.task: not loaded: Unable to parse the bundle$"):
        MediaPipeDetector(package / "pose.task")
    assert contained_models() is None
    with pytest.raises(RtofError, match="contains no model: give a .task file, or fetch one"):
        MediaPipeDetector()
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(RtofError, match=r"mediapipe, which is not installed: .*rtof-kin\[mediapipe\]"):
        MediaPipeDetector()


def test_native_messages_are_hidden_and_the_error_stream_comes_back(
    package: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import os

    (package / "pose.task").write_bytes(b"bundle")
    loud = Landmarker.__init__

    def init(self: Landmarker, options: Any) -> None:
        os.write(2, b"I0000 native note\n")
        loud(self, options)

    monkeypatch.setattr(Landmarker, "__init__", init)
    MediaPipeDetector(package / "pose.task")
    (package / "pose.task").write_bytes(b"damaged")
    with pytest.raises(FileFormatError):
        MediaPipeDetector(package / "pose.task")
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n"
