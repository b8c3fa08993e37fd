"""Keypoints from a video by the user's models: here, tiny ones that detect coloured dots."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from numpy.typing import NDArray

from rtof_kin.cli import main
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.vision import video
from rtof_kin.vision.keypoint_files import read_detector_file

# OpenCV's wheel needs a system library that machines without a screen may lack.
cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("rtmlib", exc_type=ImportError)
onnx: Any = pytest.importorskip("onnx")
Array = NDArray[np.float64]
WIDTH, HEIGHT, RATE = 640, 480, 25.0
MEAN, STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])


def colours(count: int) -> Array:
    """(K, 3) colours that are all as bright and far from each other."""
    i = np.arange(count) + 0.5
    height = i / count
    turn = np.pi / 2 * ((i * 0.618034) % 1)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=-1)


def saved(path: Path, nodes: list[Any], constants: dict[str, Any], size: tuple[int, int],
          outputs: dict[str, list[Any]]) -> None:  # fmt: skip
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "dots",
        [helper.make_tensor_value_info("input", kind, ["N", 3, *size])],
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in outputs.items()],
        [onnx.numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()],
    )
    opset = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)


def pose_model(path: Path, count: int) -> None:
    """Like RTMPose: for each point, how much its colour is in each column and in each row."""
    node = onnx.helper.make_node
    kernel = (colours(count) * STD).astype(np.float32)[:, :, None, None] / 255
    shift = (colours(count) @ MEAN).astype(np.float32) / 255
    nodes = [
        node("Conv", ["input", "kernel", "shift"], ["near"]),
        node("ReduceMax", ["near"], ["columns"], axes=[2], keepdims=0),
        node("ReduceMax", ["near"], ["rows"], axes=[3], keepdims=0),
        node("Resize", ["columns", "", "twice"], ["simcc_x"], mode="linear"),
        node("Resize", ["rows", "", "twice"], ["simcc_y"], mode="linear"),
    ]
    constants = {"kernel": kernel, "shift": shift, "twice": np.array([1, 1, 2], dtype=np.float32)}
    outputs = {"simcc_x": ["N", count, 384], "simcc_y": ["N", count, 512]}
    saved(path, nodes, constants, (256, 192), outputs)


def people_model(path: Path, boxes: list[list[float]]) -> None:
    """Like YOLOX: always the same boxes of its input, with their scores."""
    node = onnx.helper.make_node
    nodes = [
        node("ReduceMin", ["input"], ["least"], axes=[1, 2, 3], keepdims=0),
        node("Mul", ["least", "zero"], ["nothing"]),
        node("Add", ["boxes", "nothing"], ["dets"]),
    ]
    constants = {"boxes": np.array([boxes], dtype=np.float32), "zero": np.zeros(1, dtype=np.float32)}
    saved(path, nodes, constants, (480, 640), {"dets": [1, len(boxes), 5]})


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Array]:
    """A lossless video of a walk as 17 coloured dots, and where they are."""
    motion = walking()
    uv = points_px("coco17", motion, watching(motion))[:10]
    uv = (uv - uv.mean(axis=(0, 1))) * 0.75 + [320.0, 240.0]
    path = tmp_path_factory.mktemp("film") / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), RATE, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for frame in uv:
        image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for (u, v), colour in zip(frame, colours(17), strict=True):
            centre = (round(16 * u), round(16 * v))
            cv2.circle(image, centre, 16 * 4, (255 * colour).tolist(), -1, cv2.LINE_AA, 4)
        writer.write(image)
    writer.release()
    return path, uv


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "models"
    folder.mkdir()
    pose_model(folder / "pose.onnx", 17)
    return folder


def error_px(found: Array, truth: Array) -> float:
    return float(np.median(np.linalg.norm(found - truth, axis=-1)))


def test_a_video_gives_points_with_its_times(film: tuple[Path, Array], folder: Path) -> None:
    path, uv = film
    told: list[tuple[str, int, int]] = []
    found = video.detect_video(path, folder, progress=lambda *args: told.append(args))
    assert found.uv_px.shape == (10, 1, 17, 2)
    assert error_px(found.uv_px[:, 0], uv) < 5.0  # dots of 4 px, hidden by each other, on a grid
    np.testing.assert_allclose(found.times, np.arange(10) / RATE, atol=2e-3)
    assert told == [("detect", i + 1, 10) for i in range(10)]
    assert len(video.detect_video(path, folder, seconds=0.1)) == 3
    video.write_detections(folder / "k.npz", found)
    again = read_detector_file(folder / "k.npz")
    for name in ("uv_px", "confidence", "times"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    with pytest.raises(RtofError, match="cannot be written"):
        video.write_detections(folder / "k.npz" / "k.npz", found)


def test_a_person_detector_gives_several_people(film: tuple[Path, Array], folder: Path) -> None:
    path, uv = film
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    box = [*low, *high, 0.9]
    people_model(folder / "yolox.onnx", [box, [0, 0, 60, 60, 0.8], [5, 5, 50, 50, 0.01]])
    found = video.detect_video(path, folder)
    assert found.uv_px.shape == (10, 2, 17, 2)
    assert error_px(found.uv_px[:, 0], uv) < 3.0
    people_model(folder / "yolox.onnx", [[5, 5, 50, 50, 0.01]])
    with pytest.raises(FileFormatError, match="walk.avi: there is no person"):
        video.detect_video(path, folder)


def test_the_command_writes_keypoints_and_their_recording_toml(
    film: tuple[Path, Array], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, uv = film
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    people_model(folder / "yolox.onnx", [[*low, *high, 0.9]])
    out = tmp_path / "keypoints.npz"
    order = ["detect", str(path), "--model-dir", str(folder), "--out", str(out)]
    assert main(order) == 0
    said = capsys.readouterr().out
    assert "10 frames of up to 1 people, 10 frames with at least one" in said
    assert 'layout = "coco17"' in said
    assert "load " not in said  # rtmlib prints when it loads a model
    assert read_detector_file(out).uv_px.shape == (10, 1, 17, 2)
    assert main(order) == 2
    assert "is there already" in capsys.readouterr().err
    assert main([*order, "--overwrite"]) == 0


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


def test_a_webcam_may_be_interrupted_and_has_clock_times(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    with pytest.raises(FileFormatError, match="webcam 3: not a video or camera"):
        video.detect_video(3, folder, seconds=1.0)


def test_times_follow_from_the_rate_where_a_file_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    class Film(Webcam):
        def get(self, what: int) -> float:
            return 30.0 if what == cv2.CAP_PROP_FPS else 0.0

    monkeypatch.setattr(cv2, "VideoCapture", lambda source: Film(0, 3))
    times = [frame.time for frame in video.read_video(__file__)]
    np.testing.assert_allclose(times, [0, 1 / 30, 2 / 30])
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: Webcam(0, 3))
    with pytest.raises(FileFormatError, match="neither times nor a frame rate"):
        list(video.read_video(__file__))


def test_invalid_videos_and_models_are_refused(
    film: tuple[Path, Array], folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(FileFormatError, match="none.mp4: there is no such video"):
        video.detect_video(tmp_path / "none.mp4", folder)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(FileFormatError, match="text.mp4: not a video or camera"):
        video.detect_video(tmp_path / "text.mp4", folder)
    with pytest.raises(FileFormatError, match="there is no such folder of models; put an RTMPose"):
        video.detect_video(film[0], tmp_path / "none")
    with pytest.raises(FileFormatError, match="only no .onnx file; put an RTMPose body model"):
        video.detect_video(film[0], tmp_path)
    pose_model(folder / "other.onnx", 26)
    with pytest.raises(FileFormatError, match="several models of poses: other.onnx, pose.onnx"):
        video.detect_video(film[0], folder)
    (folder / "other.onnx").write_bytes(b"no model")
    with pytest.raises(FileFormatError, match="other.onnx: not a readable ONNX model"):
        video.detect_video(film[0], folder)


def test_models_are_recognised_by_inputs_and_outputs(film: tuple[Path, Array], folder: Path) -> None:
    helper = onnx.helper
    odd = [helper.make_node("ReduceMax", ["input"], ["heat"], axes=[1], keepdims=1)]
    saved(folder / "odd.onnx", odd, {}, (64, 48), {"heat": ["N", 1, 64, 48]})
    with pytest.raises(FileFormatError, match=r"odd.onnx: its outputs .* are not RTMPose's"):
        video.detect_video(film[0], folder)
    saved(folder / "odd.onnx", odd, {}, ("H", 48), {"heat": ["N", 1, "H", 48]})  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=r"odd.onnx: its inputs .* are not one image"):
        video.detect_video(film[0], folder)


def test_a_missing_extra_names_what_to_install(
    film: tuple[Path, Array],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("rtmlib", "onnxruntime", "cv2"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(RtofError, match=rf"{name} is not installed.*pip install 'rtof_kin\[video\]'"):
                video.detect_video(film[0], folder)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["detect", str(film[0]), "--model-dir", str(folder), "--out", str(folder / "k.npz")]) == 2
    assert "model files are yours to provide" in " ".join(capsys.readouterr().err.split())
