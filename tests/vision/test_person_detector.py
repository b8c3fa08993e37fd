"""The detector at hand is chosen, and where none is, one message says how to get one."""

from __future__ import annotations

import importlib.machinery
import socket
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dot_detector import people_model, pose_model, saved, transformer_model
from numpy.typing import NDArray

from rtof_kin.core.choices import Provider
from rtof_kin.core.errors import FileFormatError, InvalidInputError, MissingPackageError, RtofError
from rtof_kin.vision import person_detector
from rtof_kin.vision.model_download import ModelFile, ModelSet, model_sets, models_folder
from rtof_kin.vision.person_detector import (
    MediaPipeDetector,
    OnnxDetector,
    RtmlibDetector,
    choose_detector,
    contained_models,
)
from rtof_kin.vision.video import detect_video, read_video


class Loaded:
    """Stands for a detector; remembers its models."""

    def __init__(self, models: Path | None = None, provider: Provider = "cpu", people_every: int = 1):
        self.name, self.points = "own" if models is None else models.name, 17
        self.provider = provider


@pytest.fixture
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


@pytest.mark.usefixtures("offline")
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


@pytest.mark.usefixtures("offline")
def test_a_provider_is_for_models_that_onnx_runtime_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cached(monkeypatch)
    for models in (None, tmp_path):
        chosen = choose_detector(models, "openvino")
        assert isinstance(chosen, Loaded)
        assert chosen.provider == "openvino"
    (tmp_path / "pose.task").touch()
    for path in (tmp_path, tmp_path / "pose.task"):
        with pytest.raises(InvalidInputError, match="provider cuda: runs .onnx models, and MediaPipe's is none"):
            choose_detector(path, "cuda")
    monkeypatch.setattr(ModelSet, "missing", property(lambda wanted: wanted.needs))
    monkeypatch.setattr(person_detector, "contained_models", lambda: {})
    with pytest.raises(InvalidInputError, match="or leave the provider out"):
        choose_detector(None, "cuda")


@pytest.mark.usefixtures("offline")
def test_downloaded_models_are_used_before_mediapipes_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(person_detector, "contained_models", lambda: {})
    assert choose_detector().name == "own"
    tiny = cached(monkeypatch)
    assert choose_detector().name == "tiny"
    monkeypatch.setattr(ModelSet, "missing", property(lambda wanted: wanted.needs))
    assert choose_detector().name == "own"
    monkeypatch.undo()
    assert tiny.name not in [each.name for each in model_sets()]


@pytest.mark.usefixtures("offline")
def test_a_changed_model_in_the_cache_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = cached(monkeypatch)
    (models_folder(tiny) / "a.onnx").write_bytes(b"y")
    with pytest.raises(FileFormatError, match="a.onnx: its SHA-256 .* is not the published 2d711642b726"):
        choose_detector()


@pytest.mark.usefixtures("offline")
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
            return SimpleNamespace(pose_landmarks=[], pose_world_landmarks=[])
        v, u = np.unravel_index(red.argmax(), red.shape)
        at = SimpleNamespace(x=u / red.shape[1], y=v / red.shape[0], visibility=0.9)
        foot = SimpleNamespace(x=at.x, y=1.2, visibility=0.8)
        people = [[at, foot], *self.more]
        in_space = [[SimpleNamespace(x=p.x, y=0.1 * k, z=-0.2) for p in points] for k, points in enumerate(people)]
        return SimpleNamespace(pose_landmarks=people, pose_world_landmarks=in_space)

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
    np.testing.assert_allclose(person.p_model, [[0.75, 0.0, -0.2], [0.75, 0.0, -0.2]])
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
    assert person.p_model is not None
    assert person.p_model[0, 1] == 0.1
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


pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("av")
rtmlib: Any = pytest.importorskip("rtmlib", exc_type=ImportError)
onnx: Any = pytest.importorskip("onnx")

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


def test_people_are_followed_by_their_points_between_images_in_which_they_are_found(
    film: Film, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, uv = film
    people_model(folder / "yolox.onnx", [[*uv[0].min(axis=0), *uv[0].max(axis=0), 0.9]])  # of the first image only
    looked: list[int] = []
    find, images = rtmlib.YOLOX.__call__, [frame.image for frame in read_video(path)]
    monkeypatch.setattr(rtmlib.YOLOX, "__call__", lambda self, image: looked.append(1) or find(self, image))
    for every, times in ((1, 10), (4, 3), (100, 1)):
        looked.clear()
        found = detect_video(path, OnnxDetector(folder, people_every=every))
        assert len(looked) == times
        assert found.uv_px.shape == (10, 1, 17, 2)
        assert error_px(found.uv_px[:, 0], uv) < 3.0
    detector = OnnxDetector(folder, people_every=100)
    looked.clear()
    shifted = [np.roll(image, 12 * k, axis=1) for k, image in enumerate(images)]  # away from where it was found
    for k, image in enumerate(shifted):
        (person,) = detector.find(image, 0.04 * k)
        assert error_px(person.points[:, :2], uv[k] + [12 * k, 0]) < 3.0
    assert len(looked) == 1
    detector.find(np.zeros_like(images[0]), 0.4)
    assert len(detector.find(images[0], 0.44)) == 1
    assert len(looked) == 2  # who was lost is found anew
    with pytest.raises(InvalidInputError, match="people_every: 0; give 1 or more"):
        OnnxDetector(folder, people_every=0)


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
    flat = helper.make_node("Flatten", ["heat"], ["classes"])
    saved(folder / "odd.onnx", [*odd, flat], {}, (64, 48), {"classes": ["N", 3072]})
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


@pytest.mark.parametrize("kind", ["RTMPose", "RTMPose3d", "ViTPose"])
def test_each_kind_of_pose_model_is_recognised_and_run(kind: str, film: Film, folder: Path) -> None:
    path, uv = film
    pose_model(folder / "pose.onnx", 17, kind)
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    size = np.array([640, 480])
    person, car = [*(low + high) / 2 / size, *(high - low) / size, 1], [0.2, 0.2, 0.2, 0.2, 3]
    transformer_model(folder / "people.onnx", [car, person])
    found = detect_video(path, folder)
    assert found.uv_px.shape == (10, 1, 17, 2)
    assert error_px(found.uv_px[:, 0], uv) < 5.0


def test_a_solution_of_rtmlib_is_a_detector(film: Film, folder: Path, tmp_path: Path) -> None:
    path, uv = film
    low, high = uv.min(axis=(0, 1)) - 10, uv.max(axis=(0, 1)) + 10
    people_model(tmp_path / "yolox.onnx", [[*low, *high, 0.9]])
    pose_model(tmp_path / "space.onnx", 17, "RTMPose3d")
    boxes = {"det": str(tmp_path / "yolox.onnx"), "det_input_size": (480, 640), "pose_input_size": (192, 256)}
    plane = rtmlib.Custom("YOLOX", pose_class="RTMPose", pose=str(folder / "pose.onnx"), backend="onnxruntime", **boxes)
    space = rtmlib.Wholebody3d(pose=str(tmp_path / "space.onnx"), **boxes)
    for solution in (plane, space):
        detector = RtmlibDetector(solution, 17)
        assert (detector.name, detector.points) == (f"rtmlib's {type(solution).__name__}", 17)
        assert error_px(detect_video(path, detector).uv_px[:, 0], uv) < 5.0
    assert RtmlibDetector(lambda _: ([], []), 17, "nobody").find(np.zeros((4, 4, 3), np.uint8), 0.0) == []


def test_a_provider_that_is_missing_or_does_not_start_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import onnxruntime

    cases: list[tuple[Provider, str]] = [
        ("cuda", r"pip install \"onnxruntime-gpu\[cuda,cudnn\]\""),
        ("coreml", "onnxruntime, on a Mac"),
        ("openvino", "onnxruntime-openvino"),
    ]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    for provider, remedy in cases:
        with pytest.raises(MissingPackageError, match=f"provider {provider}: ONNX Runtime has CPU here; .*{remedy}"):
            OnnxDetector(folder, provider)
    named = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: named)
    load, asked = onnxruntime.InferenceSession, list[list[str]]()

    def session(path: str, providers: list[str]) -> Any:
        asked.append(providers)
        print("EP Error, falling back")
        return load(path, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    with pytest.raises(MissingPackageError, match="provider cuda: does not start, its driver or libraries are missing"):
        OnnxDetector(folder, "cuda")
    assert asked == [named]
    assert capfd.readouterr() == ("", "")


def test_models_run_in_the_session_of_the_provider(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    load, ran = onnxruntime.InferenceSession, list[str]()

    class Session:
        """A session of ONNX Runtime that says it runs on OpenVINO."""

        def __init__(self, path_or_bytes: str, providers: list[str]):
            self._own = load(path_or_bytes, providers=providers[-1:])
            self.get_inputs, self.get_outputs = self._own.get_inputs, self._own.get_outputs
            self.get_providers, self.name = (lambda: providers), providers[0]

        def run(self, *arguments: Any) -> Any:
            ran.append(self.name)
            return self._own.run(*arguments)

    name = "OpenVINOExecutionProvider"
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [name, "CPUExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    people_model(folder / "yolox.onnx", [[0, 0, 640, 480, 0.9]])
    detector = OnnxDetector(folder, "openvino")
    assert detector.name == "pose.onnx and yolox.onnx on openvino"
    detector.find(np.full((480, 640, 3), 200, dtype=np.uint8), 0.0)
    assert ran == [name, name]
