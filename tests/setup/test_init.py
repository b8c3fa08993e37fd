"""From keypoints, or a detected video, to the folder of a recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from setup_support import LAYOUT, beside, pair, walker, write_demo, write_keypoints

from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.recording.recording import Recording
from rtof_kin.setup import init
from rtof_kin.setup.init import Findings, find_people, read_findings, write_recording
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources
from rtof_kin.vision import layouts
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.layouts import detector_table
from rtof_kin.vision.video import write_detections

SETTINGS = SetupSettings(height=1.72, size_px=(1920, 1080))


def no_detector(video: Path) -> Detections:
    raise AssertionError(f"{video}: there are keypoints")


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the drawing out, which takes longest and is tested elsewhere."""
    monkeypatch.setattr(init, "write_frames_picture", lambda path, *_: path.write_bytes(b""))


def set_up(folder: Path, settings: SetupSettings, *files: Path) -> Findings:
    sources = Sources.of(files)
    find_people(sources, settings, folder, no_detector)
    return write_recording(sources, settings, folder)


def test_keypoints_become_a_recording_with_every_assumption_said(tmp_path: Path) -> None:
    uv = walker()
    given = write_keypoints(tmp_path / "walk.npz", uv, beside(uv, 0.4, (1100.0, 400.0)))
    found = set_up(tmp_path / "out", SETTINGS, given)
    recording = Recording.load(tmp_path / "out")
    own = [name for name in recording.video.names if name.startswith(f"{LAYOUT}:")]
    points = recording.video.uv_px[:, [recording.video.names.index(name) for name in own]]
    np.testing.assert_allclose(points, uv)  # the larger of the two, its order in the file undone
    assert recording.height == 1.72
    assert recording.floor_height == 0.0
    assert recording.video.camera.uncertainty is not None
    assert recording.video.camera.assumed == ("focal length", "lens distortion", "pose")
    assert found.given == ("the person is 1.72 m tall",)
    assert found.found == ("person 1 of 2 in frames.png; --person takes another one",)
    assert [sentence.split()[0] for sentence in found.assumed] == ["the", "focal", "the"]
    assert found.doubtful == ("the take lasts 1.6 s; 20 s with walking and turning tell camera and sensors",)
    assert read_findings(tmp_path / "out") == found
    assert recording.notes == found.text
    assert found.text.startswith("doubtful: the take lasts 1.6 s")
    assert found.text.endswith("given: the person is 1.72 m tall")
    assert (tmp_path / "out" / "frames.png").stat().st_size > 1000


@pytest.mark.usefixtures("no_picture")
def test_what_found_the_points_and_how_fast_is_kept(tmp_path: Path) -> None:
    found = read_detector_file(write_keypoints(tmp_path / "walk.npz", walker()))
    write_detections(tmp_path / "own.npz", replace(found, detector="pose.onnx on cpu, 31 frames per second"))
    said = set_up(tmp_path / "out", SETTINGS, tmp_path / "own.npz")
    title = detector_table().layout(LAYOUT).title
    assert f"found: {title}, by pose.onnx on cpu, 31 frames per second" in said.text
    assert read_detector_file(tmp_path / "out" / "keypoints.npz").detector == "pose.onnx on cpu, 31 frames per second"
    assert Recording.load(tmp_path / "out").notes == said.text


@pytest.mark.usefixtures("no_picture")
def test_the_person_asked_for_is_taken(tmp_path: Path) -> None:
    first, second = pair()
    given = write_keypoints(tmp_path / "two.npz", first, second)
    set_up(tmp_path / "a", replace(SETTINGS, person=1), given)
    set_up(tmp_path / "b", replace(SETTINGS, person=2), given)
    found = [Recording.load(tmp_path / name).video.uv_px for name in ("a", "b")]
    assert abs(abs(np.nanmean(found[0] - found[1], axis=(0, 1))[0]) - 700.0) < 1.0
    assert "# given: person 2 of 2 in frames.png" in (tmp_path / "b" / "recording.toml").read_text()


@pytest.mark.usefixtures("no_picture")
def test_two_people_stop_it_with_the_picture_written(tmp_path: Path) -> None:
    given = write_keypoints(tmp_path / "two.npz", *pair())
    with pytest.raises(InvalidInputError, match=r"look at .*out/frames.png and choose one with --person"):
        set_up(tmp_path / "out", SETTINGS, given)
    assert (tmp_path / "out" / "frames.png").is_file()
    assert not (tmp_path / "out" / "recording.toml").exists()


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"size_px": None}, "keypoints do not say how large the image is; give the video beside them"),
        ({"rate_hz": None}, "has no times; give the video beside it, or its rate by --rate 60"),
        ({"height": 172.0}, "--height 172: is no human height in metres; give e.g. --height 1.72"),
    ],
)
def test_what_is_missing_is_asked_for_in_one_sentence(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    given = write_keypoints(tmp_path / "walk.npz", walker(), rate_hz=None)
    with pytest.raises(InvalidInputError, match=message):
        set_up(tmp_path / "out", replace(SETTINGS, **({"rate_hz": 30.0} | changes)), given)


@pytest.mark.usefixtures("no_picture")
def test_an_unknown_height_is_assumed_and_in_doubt(tmp_path: Path) -> None:
    given = write_keypoints(tmp_path / "walk.npz", walker())
    found = set_up(tmp_path / "out", replace(SETTINGS, height=None), given)
    height = Recording.load(tmp_path / "out").height
    assert height is not None
    assert f"the person is {height:.2f} m tall" in found.assumed
    assert any("height is not known" in sentence for sentence in found.doubtful)


def test_a_recording_of_a_camera_needs_an_image(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("time,a_fx,a_fy,a_fz,a_qw,a_qx,a_qy,a_qz\n0,0,0,9.8,1,0,0,0\n")
    with pytest.raises(InvalidInputError, match="no video and no keypoints among them; give one"):
        set_up(tmp_path / "out", SETTINGS, tmp_path / "s.csv")


@pytest.mark.usefixtures("no_picture")
def test_a_calibration_replaces_every_assumption_of_the_camera(tmp_path: Path) -> None:
    camera = watching(walking())
    write_camera_toml(tmp_path / "calib.toml", {"cam": camera})
    given = write_keypoints(tmp_path / "walk.npz", walker())
    found = set_up(tmp_path / "out", replace(SETTINGS, size_px=None), given, tmp_path / "calib.toml")
    assert found.assumed == ()
    recording = Recording.load(tmp_path / "out")
    np.testing.assert_allclose(recording.video.camera.t_camera_world, camera.t_camera_world)
    assert recording.floor_height is None


def test_a_discarded_video_leaves_no_name(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    video = tmp_path / "secret_patient.mp4"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height = 640, 360
        for _ in range(50):
            frame = av.VideoFrame.from_ndarray(np.full((360, 640, 3), 90, dtype=np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())

    def detect(path: Path) -> Detections:
        assert path == video
        uv = walker()[:, None] / 3
        return Detections(uv, np.full(uv.shape[:-1], 0.9), np.arange(len(uv)) / 30)

    sources = Sources.of([video])
    for name, settings in {"kept": SETTINGS, "discarded": replace(SETTINGS, keep_video=False)}.items():
        find_people(sources, settings, tmp_path / name, detect)
        write_recording(sources, settings, tmp_path / name, name="walk")
    text = {name: (tmp_path / name / "recording.toml").read_text() for name in ("kept", "discarded")}
    assert "secret_patient.mp4" in text["kept"]
    everything = b"".join(path.read_bytes() for path in (tmp_path / "discarded").iterdir())
    assert b"secret_patient" not in everything
    assert (tmp_path / "kept" / "frames.png").read_bytes() != (tmp_path / "discarded" / "frames.png").read_bytes()
    assert json.loads((tmp_path / "discarded" / "findings.json").read_text())["doubtful"]


BELT = """
[[point]]
name = "Buckle"
joint = "Hips"
offset_mm = [110, 0, 60]

[[layout]]
name = "belt"
names = ["knee_L", "ankle_L", "hip_L", "shoulder_L", "shoulder_R", "hip_R", "knee_R", "ankle_R", "belt"]
points = { belt = "Buckle" }
"""


@pytest.mark.usefixtures("no_picture")
def test_a_layout_of_the_users_travels_with_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    (tmp_path / "belt.toml").write_text(BELT, encoding="utf-8")
    name = layouts.layout_named(tmp_path / "belt.toml")
    uv = points_px(name, walking(), watching(walking()))
    given, folder = write_keypoints(tmp_path / "walk.npz", uv), tmp_path / "out"
    with_layout = replace(SETTINGS, layout=str(tmp_path / "belt.toml"))
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    set_up(folder, with_layout, given)
    assert 'layout = "layout.toml"' in (folder / "recording.toml").read_text()
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    recording = Recording.load(folder)
    at = recording.video.names.index("belt:Buckle")
    np.testing.assert_allclose(recording.video.uv_px[:, at], uv[:, -1])
    recording.save(tmp_path / "saved")
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    with pytest.raises(UnknownNameError, match="layout of keypoints.*'belt'"):
        Recording.load(tmp_path / "saved")
    layouts.layout_named(tmp_path / "belt.toml")  # as reconstruct --layout does
    assert "belt:Buckle" in Recording.load(tmp_path / "saved").video.names


def test_a_layout_by_name_takes_knuckles(tmp_path: Path) -> None:
    uv = np.full((50, 133, 2), np.nan)
    form = layouts.detector_table().layout("coco_hands31")
    uv[:, list(dict(form.whole)[133])] = points_px(form.name, walking(), watching(walking()))
    given = write_keypoints(tmp_path / "walk.npz", uv)
    set_up(tmp_path / "out", replace(SETTINGS, layout="coco_hands31"), given)
    names = Recording.load(tmp_path / "out").video.names
    assert "coco_hands31:LeftForefinger1" in names
    with pytest.raises(UnknownNameError, match="'coco_hand'.*Did you mean"):
        set_up(tmp_path / "out", replace(SETTINGS, layout="coco_hand"), given)


@pytest.mark.usefixtures("no_picture")
def test_sensors_are_set_up_by_the_liveliest_part_and_else_by_the_whole_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uv, log = walker(), write_demo(tmp_path, 0, 2)[1]
    uv[:10] = uv[10]  # stands still at first
    spans = list[tuple[float, float]]()

    def refuse(_: SensorLog, __: Path | None, ___: object, keypoints: KeypointSequence, *____: object) -> None:
        spans.append((float(keypoints.times[0]), float(keypoints.times[-1])))
        raise InvalidInputError("sensors of another take")

    monkeypatch.setattr(init, "_ENOUGH", 1.0)
    monkeypatch.setattr(init, "lift", lambda *_: SimpleNamespace(poses=None))
    monkeypatch.setattr(init, "set_up_sensors", refuse)
    write_camera_toml(tmp_path / "camera.toml", {"phone": watching(walking())})
    sources = Sources.of([write_keypoints(tmp_path / "walk.npz", uv), tmp_path / "camera.toml", log])
    find_people(sources, SETTINGS, tmp_path / "out", no_detector)
    with pytest.raises(InvalidInputError, match="another take"):
        write_recording(sources, SETTINGS, tmp_path / "out")
    last = (len(uv) - 1) / 30.0
    assert spans[0][0] > 0.3
    assert spans[0][1] - spans[0][0] == pytest.approx(1.0)
    assert spans[1] == pytest.approx((0.0, last))
