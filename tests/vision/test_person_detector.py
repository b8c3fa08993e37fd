"""The detector at hand is chosen, and where none is, one message says how to get one."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.vision import person_detector
from rtof_kin.vision.model_download import ModelFile, ModelSet, model_sets, models_folder
from rtof_kin.vision.person_detector import choose_detector


class Loaded:
    """Stands for a detector; remembers its models."""

    def __init__(self, models: Path | None = None):
        self.name = "own" if models is None else models.name


@pytest.fixture(autouse=True)
def offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No detector loads, there is an empty cache, and every connection fails the test."""

    def connected(*_: Any) -> None:
        raise AssertionError("a connection was made")

    monkeypatch.setattr(socket.socket, "connect", connected)
    monkeypatch.setenv("RTOF_KIN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(person_detector, "OnnxDetector", Loaded)
    monkeypatch.setattr(person_detector, "MediaPipeDetector", Loaded)
    monkeypatch.setattr(person_detector, "contained_models", lambda: None)
    monkeypatch.setattr(ModelSet, "missing", property(lambda wanted: {"mediapipe"} & set(wanted.needs)))


def cached(monkeypatch: pytest.MonkeyPatch) -> ModelSet:
    """Put a set of one tiny model into the cache."""
    sha256 = "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"  # of b"x"
    tiny = ModelSet("tiny", "Tiny", "none", ("onnxruntime",), "", (ModelFile("a.onnx", "", sha256, 1),))
    monkeypatch.setattr(person_detector, "model_sets", lambda: (tiny,))
    models_folder(tiny).mkdir(parents=True)
    (models_folder(tiny) / "a.onnx").write_bytes(b"x")
    return tiny


def test_given_models_are_used_before_all_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cached(monkeypatch)
    (tmp_path / "pose.task").touch()
    assert choose_detector(tmp_path / "pose.task").name == "pose.task"
    assert choose_detector(tmp_path).name == "pose.task"
    (tmp_path / "more.task").touch()
    with pytest.raises(FileFormatError, match="several models: more.task, pose.task; leave one"):
        choose_detector(tmp_path)
    (tmp_path / "pose.onnx").touch()
    assert choose_detector(tmp_path).name == tmp_path.name


def test_downloaded_models_are_used_before_mediapipes_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(person_detector, "contained_models", lambda: {})
    assert choose_detector().name == "own"
    tiny = cached(monkeypatch)
    assert choose_detector().name == "tiny"
    monkeypatch.setattr(ModelSet, "missing", property(lambda wanted: wanted.needs))
    assert choose_detector().name == "own"
    monkeypatch.undo()
    assert tiny.name not in [each.name for each in model_sets()]


def test_a_changed_model_in_the_cache_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = cached(monkeypatch)
    (models_folder(tiny) / "a.onnx").write_bytes(b"y")
    with pytest.raises(FileFormatError, match="a.onnx: its SHA-256 .* is not the published 2d711642b726"):
        choose_detector()


def test_without_a_detector_one_message_has_every_way_to_one(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RtofError) as caught:
        choose_detector()
    said = str(caught.value)
    assert "nothing is downloaded unasked" in said
    assert "1. add --fetch-models rtmpose: downloads RTMPose-m" in said
    assert '2. pip install "rtof-kin[mediapipe]", then add --fetch-models mediapipe' in said
    assert "licence Apache-2.0" in said
    assert "--model-dir DIR" in said
    assert "keypoints of another program" in said
    monkeypatch.setattr(ModelSet, "missing", property(lambda wanted: wanted.needs))
    with pytest.raises(RtofError, match=r'1. pip install "rtof-kin\[video\]", then add'):
        choose_detector()
