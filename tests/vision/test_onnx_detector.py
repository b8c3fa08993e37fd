"""Detectors of people from ONNX files: here tiny ones that detect coloured dots."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.vision.onnx_detector import OnnxDetector
from rtof_kin.vision.video import detect_video

pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("av")
rtmlib: Any = pytest.importorskip("rtmlib", exc_type=ImportError)
onnx: Any = pytest.importorskip("onnx")
from dot_detector import people_model, pose_model, saved  # noqa: E402

Film = tuple[Path, NDArray[np.float64]]


def error_px(found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    return float(np.median(np.linalg.norm(found - truth, axis=-1)))


def test_a_person_detector_gives_several_people(film: Film, folder: Path) -> None:
    path, uv = film
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    box = [*low, *high, 0.9]
    people_model(folder / "yolox.onnx", [box, [0, 0, 60, 60, 0.8], [5, 5, 50, 50, 0.01]])
    found = detect_video(path, folder)
    assert found.uv_px.shape == (10, 2, 17, 2)
    assert OnnxDetector(folder).points == 17
    assert error_px(found.uv_px[:, 0], uv) < 3.0
    people_model(folder / "yolox.onnx", [[5, 5, 50, 50, 0.01]])
    with pytest.raises(FileFormatError, match="walk.mkv: there is no person"):
        detect_video(path, folder)


def test_invalid_models_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no such folder of models; put an RTMPose"):
        OnnxDetector(tmp_path / "none")
    with pytest.raises(FileFormatError, match="only no .onnx file; put an RTMPose body model"):
        OnnxDetector(tmp_path)
    pose_model(folder / "other.onnx", 26)
    with pytest.raises(FileFormatError, match="several models of poses: other.onnx, pose.onnx"):
        OnnxDetector(folder)
    (folder / "other.onnx").write_bytes(b"no model")
    with pytest.raises(FileFormatError, match="other.onnx: not a readable ONNX model"):
        OnnxDetector(folder)


def test_models_are_recognised_by_inputs_and_outputs(folder: Path) -> None:
    helper = onnx.helper
    odd = [helper.make_node("ReduceMax", ["input"], ["heat"], axes=[1], keepdims=1)]
    saved(folder / "odd.onnx", odd, {}, (64, 48), {"heat": ["N", 1, 64, 48]})
    with pytest.raises(FileFormatError, match=r"odd.onnx: its outputs .* are not RTMPose's"):
        OnnxDetector(folder)
    saved(folder / "odd.onnx", odd, {}, ("H", 48), {"heat": ["N", 1, "H", 48]})  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=r"odd.onnx: its inputs .* are not one image"):
        OnnxDetector(folder)


def test_a_missing_extra_names_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rtmlib", "onnxruntime"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(RtofError, match=rf"{name}, which is not installed: .*rtof-kin\[video\]"):
                OnnxDetector(folder)


def test_rtmlib_is_never_asked_to_download(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*_: Any, **__: Any) -> None:
        raise AssertionError("rtmlib downloads")

    monkeypatch.setattr(sys.modules["rtmlib.tools.base"], "download_checkpoint", asked)
    with pytest.raises(AssertionError, match="downloads"):
        rtmlib.RTMPose("https://localhost/none.onnx", backend="onnxruntime")
    people_model(folder / "yolox.onnx", [[0, 0, 640, 480, 0.9]])
    image = np.full((480, 640, 3), 200, dtype=np.uint8)
    assert OnnxDetector(folder).find(image, 0.0)[0].points.shape == (17, 3)
