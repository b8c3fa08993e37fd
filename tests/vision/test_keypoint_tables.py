"""Tables with a row for each point, Sports2D's markers in pixels, whole bodies, scores of a frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.camera import Camera
from rtof_kin.vision.detections import Detections, of_body
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.keypoint_tables import is_keypoint_header
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.layouts import detector_table, own

RNG = np.random.default_rng(0)
UV = RNG.uniform(100, 900, (4, 17, 2)).round(3)
SCORES = RNG.uniform(0.2, 1.0, (4, 17)).round(3)
CALISCOPE = "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"
SPORTS2D = """
Hip RHip RKnee RAnkle RBigToe RSmallToe RHeel LHip LKnee LAnkle LBigToe LSmallToe LHeel Neck Head Nose
RShoulder RElbow RWrist LShoulder LElbow LWrist
""".split()  # noqa: SIM905


def write(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows, ""]))
    return path


def standing() -> tuple[np.ndarray, tuple[str, ...]]:
    """A person as the points of a layout are placed on average, px, y down; and the points' names."""
    gaussian = LandmarkRegression.default().gaussian
    mean = np.array(gaussian.mean).reshape(-1, 2)
    return 300 * mean + [960, 540], tuple(gaussian.names)


def of_layout(name: str) -> np.ndarray:
    p, names = standing()
    return p[[names.index(point) for point in detector_table().layout(name).points]]


def test_rows_of_points_are_a_person(tmp_path: Path) -> None:
    rows = [
        f"{t + 7},{k},{UV[t, k, 0]},{UV[t, k, 1]},{SCORES[t, k]},{t / 25}"
        for t in (0, 1, 3)
        for k in range(17)
        if (t, k) != (1, 5)
    ]
    shuffled = [rows[i] for i in RNG.permutation(len(rows))]
    found = read_detector_file(write(tmp_path / "a.csv", "frame,landmark,x,y,visibility,time", shuffled))
    assert found.uv_px.shape == (4, 1, 17, 2)
    np.testing.assert_array_equal(found.uv_px[[0, 3], 0], UV[[0, 3]])
    np.testing.assert_array_equal(found.confidence[[0, 3], 0], SCORES[[0, 3]])
    assert np.isnan(found.uv_px[1, 0, 5]).all()
    assert not found.present[2].any()  # a frame without rows keeps its place
    assert found.times is not None
    np.testing.assert_allclose(found.times, np.arange(4) / 25)


def test_caliscopes_table_of_one_camera_is_read_without_hands_and_face(tmp_path: Path) -> None:
    uv = of_layout("mediapipe33")
    rows = [
        f"{t},2,{t},{400 + t / 30:.6f},{k},{uv[k, 0]:.3f},{uv[k, 1]:.3f},,"
        for t in range(6)
        for k in range(33)
        if k not in (13, 32)
    ]
    rows += [f"{t},2,{t},{400 + t / 30:.6f},{k},10,10,," for t in range(6) for k in (100, 220, 500)]
    path = write(tmp_path / "xy.csv", CALISCOPE, rows)
    found = read_detector_keypoints(path, Camera.looking_at([4, 0, 1], [0, 0, 1], 1000))
    assert found.recognition.layout.name == "mediapipe33"
    assert found.keypoints.times[-1] - found.keypoints.times[0] == pytest.approx(5 / 30, abs=1e-5)
    several = write(tmp_path / "b.csv", CALISCOPE, [*rows, rows[0].replace(",2,", ",3,", 1)])
    with pytest.raises(FileFormatError, match="has the cameras 2, 3; keep the rows of one"):
        read_detector_file(several)


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (["0,0.5,1,2"], "must have whole numbers"),
        (["-1,0,1,2"], "must have whole numbers"),
        (["0,0,1,2", "0,0,1,2"], "has a point twice"),
        (["0,0,1,2", "900000,0,1,2"], "number frames from 0"),
        (["0,,1,2"], "must have whole numbers"),
    ],
)
def test_rows_that_are_no_frames_are_refused(tmp_path: Path, rows: list[str], problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        read_detector_file(write(tmp_path / "a.csv", "frame,point_id,x,y", rows))


def test_columns_numbered_behind_a_word_are_in_the_order_of_the_numbers(tmp_path: Path) -> None:
    order = [3, 16, 0, 10, *(k for k in range(17) if k not in (3, 16, 0, 10))]
    header = ",".join(f"landmark_{k}_x,landmark_{k}_y" for k in order)
    rows = [",".join(f"{UV[t, k, 0]},{UV[t, k, 1]}" for k in order) for t in range(4)]
    found = read_detector_file(write(tmp_path / "a.csv", header, rows))
    assert found.names is None
    np.testing.assert_array_equal(found.uv_px[:, 0], UV)


@pytest.mark.parametrize(
    ("line", "known"),
    [
        ("frame,landmark,x,y", True),
        (CALISCOPE, True),
        ("time,nose_x,nose_y", True),
        ("x0,y0,v0", True),
        ("frame,x,y", False),
        ("time,a,b", False),
        ("nose_x,nose_score", False),
        ("", False),
    ],
)
def test_the_first_line_tells_keypoints_from_other_tables(line: str, known: bool) -> None:
    assert is_keypoint_header(line) is known


def trc(path: Path, names: list[str], uv: np.ndarray) -> Path:
    """As Sports2D's `make_trc_with_trc_data` writes it."""
    T, M = uv.shape[:2]
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"30\t30\t{T}\t{M}\tm\t30\t0\t{T}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t",
        "\t\t" + "\t".join(f"X{i + 1}\tY{i + 1}\tZ{i + 1}" for i in range(M)),
    ]
    rows = []
    for t in range(T):
        cells = ["" if np.isnan(x) else f"{x:.6f}" for point in uv[t] for x in (*point, 0)]
        rows.append("\t".join([str(t), repr(t / 30), *cells]))
    path.write_text("\n".join([*head, *rows, ""]))
    return path


def test_sports2ds_markers_in_pixels_are_a_halpe_body_without_eyes_and_ears(tmp_path: Path) -> None:
    form = detector_table().layout("halpe26")
    person = of_layout("halpe26")
    order = form_order(SPORTS2D)
    uv = np.tile(person[order], (3, 1, 1))
    path = trc(tmp_path / "walk_px_person00.trc", SPORTS2D, uv)
    found = read_detector_file(path)
    assert found.names == form.names
    seen = np.isfinite(found.uv_px[0, 0, :, 0])
    assert [name for name, is_seen in zip(form.names, seen, strict=True) if not is_seen] == [
        "left_eye",
        "right_eye",
        "left_ear",
        "right_ear",
    ]
    np.testing.assert_allclose(found.uv_px[0, 0, seen], person[seen], atol=1e-5)
    keypoints = read_detector_keypoints(path, Camera.looking_at([4, 0, 1], [0, 0, 1], 1000)).keypoints
    np.testing.assert_allclose(keypoints.times, np.arange(3) / 30)


def form_order(names: list[str]) -> list[int]:
    """Index of each name among halpe26's points."""
    form, order = detector_table().nearest(names)
    assert form is not None
    assert form.name == "halpe26"
    return [order.index(i) for i in range(len(names))]


def test_markers_in_metres_or_of_no_detector_are_refused(tmp_path: Path) -> None:
    uv = np.full((3, len(SPORTS2D), 2), 1.5)
    with pytest.raises(FileFormatError, match="its markers are in metres"):
        read_detector_file(trc(tmp_path / "a.trc", SPORTS2D, uv))
    with pytest.raises(FileFormatError, match="no layout of a detector has its markers LASI, RASI"):
        read_detector_file(trc(tmp_path / "b.trc", ["LASI", "RASI"], 500 * uv[:, :2]))


def test_a_whole_body_is_read_without_face_and_hands() -> None:
    for K, layout in ((133, "coco23"), (136, "halpe26")):
        body = of_layout(layout)
        uv = np.concatenate([body, RNG.uniform(0, 900, (K - len(body), 2))])[None, None]
        found = of_body(Detections(uv, np.ones((1, 1, K))))
        np.testing.assert_array_equal(found.uv_px[0, 0], body)
    few = Detections(np.ones((1, 1, 17, 2)), np.ones((1, 1, 17)))
    assert of_body(few) is few


def test_what_rtmlibs_whole_body_returns_is_read_with_its_scores(tmp_path: Path) -> None:
    body = np.concatenate([of_layout("coco23"), np.full((110, 2), 5.0)])
    people, scores = np.stack([body, body + 40]), RNG.uniform(0.3, 0.9, (2, 133))
    frames = [{"frame": t, "keypoints": people.tolist(), "scores": scores.tolist()} for t in range(3)]
    path = tmp_path / "rtmlib.json"
    path.write_text(json.dumps(frames))
    found = read_detector_file(path)
    np.testing.assert_allclose(found.uv_px[1], people[:, :23])
    np.testing.assert_allclose(found.confidence[2], scores[:, :23])
    camera = Camera.looking_at([4, 0, 1], [0, 0, 1], 1000)
    named = read_detector_keypoints(path, camera, rate_hz=30, person=0)
    assert named.recognition.layout.name == "coco23"
    one = tmp_path / "one.json"
    alone = [{"keypoints": UV[t].tolist(), "scores": SCORES[t].tolist()} for t in range(4)]
    one.write_text(json.dumps(alone))
    np.testing.assert_allclose(read_detector_file(one).confidence[:, 0], SCORES)


def test_points_of_the_skeleton_are_no_detectors() -> None:
    assert detector_table().nearest([own("Hips"), "Spine", "Spine1"]) == (None, ())
