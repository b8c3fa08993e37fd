"""Tracking of one of several people: ambiguous and lost frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.vision.detections import Detections, Person, is_keypoint_header, of_body
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.layouts import detector_table, own
from rtof_kin.vision.tracking import NOBODY, PersonFollower, _median, track_person

Array = NDArray[np.float64]
T = 90
TIMES = np.arange(T) / 30.0
BODY = np.random.default_rng(0).uniform(-1, 1, (17, 2)) * [60, 200]
IMAGE = (1920.0, 1080.0)


def walker(start: float, stop: float, size: float = 1.0, height: float = 540.0) -> Array:
    """(T, 17, 2) points of a person who crosses the image."""
    u = np.linspace(start, stop, T)
    swing = 10 * np.sin(2 * np.pi * TIMES)[:, None, None] * np.sin(np.arange(34)).reshape(17, 2)
    return size * (BODY + swing) + np.stack([u, np.full(T, height)], axis=-1)[:, None]


def filmed(people: list[Array], seed: int = 0, hidden: Array | None = None) -> tuple[Detections, Array]:
    """Detections with everybody in random order, and (T,) where person 0 is among them, -1 where not."""
    rng = np.random.default_rng(seed)
    uv = np.stack(people, axis=1) + rng.normal(size=(T, len(people), 17, 2))
    confidence = np.full(uv.shape[:3], 0.8)
    if hidden is not None:
        confidence[hidden] = 0.0
    index = np.empty(T, dtype=int)
    for t in range(T):
        order = rng.permutation(len(people))
        uv[t], confidence[t] = uv[t, order], confidence[t, order]
        index[t] = int(np.flatnonzero(order == 0)[0]) if confidence[t][order == 0].any() else NOBODY
    return Detections(uv, confidence), index


def test_a_single_person_is_never_ambiguous() -> None:
    found, _ = filmed([walker(400, 1500)])
    track = track_person(found, TIMES)
    np.testing.assert_array_equal(track.person, 0)
    assert (track.people, track.ambiguous.any(), track.lost.any()) == (1, False, False)


def test_medians_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    for shape in ((1,), (2, 2), (3,), (6, 2), (33, 2), (32,)):
        values = rng.normal(size=shape)
        assert np.array_equal(_median(values), np.median(values, axis=0))


def test_people_are_tracked_in_any_order() -> None:
    found, index = filmed([walker(700, 1200), walker(100, 300, 0.5), walker(1800, 1700, 0.8)])
    track = track_person(found, TIMES, image_px=IMAGE)
    np.testing.assert_array_equal(track.person, index)
    assert track.people == 3
    assert "of 3 people the largest" in track.reason
    uv, confidence = track.of(found)
    np.testing.assert_array_equal(uv[7], found.uv_px[7, index[7]])
    assert np.all(confidence == 0.8)
    crossing, index = filmed([walker(300, 1600), walker(1600, 300, height=640.0)])
    track = track_person(crossing, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)
    assert f"person {index[0] + 1} in frame 0" in track.reason


def test_overlapping_people_are_ambiguous() -> None:
    found, _ = filmed([walker(900, 1000), walker(900, 1000) + np.array([4.0, 2.0])])
    track = track_person(found, TIMES, image_px=IMAGE)
    assert track.ambiguous[1:].mean() > 0.9
    apart, _ = filmed([walker(300, 400), walker(1300, 1400)])
    assert not track_person(apart, TIMES, image_px=IMAGE).ambiguous.any()


def test_short_gaps_are_bridged_and_lost() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[40:55, 0] = True  # half a second
    found, index = filmed([walker(700, 900), walker(1500, 1600, 0.6)], hidden=hidden)
    track = track_person(found, TIMES, image_px=IMAGE)
    np.testing.assert_array_equal(track.person, index)
    np.testing.assert_array_equal(np.flatnonzero(track.lost), np.arange(40, 55))
    uv, confidence = track.of(found)
    assert np.isnan(uv[40:55]).all()
    assert not confidence[40:55].any()
    assert track.people == 2


def test_a_return_after_a_long_gap_is_ambiguous() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[20:70, 0] = True  # longer than a person is expected back
    found, index = filmed([walker(700, 900), walker(1500, 1600, 0.5)], hidden=hidden)
    track = track_person(found, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)
    np.testing.assert_array_equal(np.flatnonzero(track.ambiguous), [70])
    assert track.people == 2


def test_another_person_does_not_fill_a_gap() -> None:
    hidden = np.zeros((T, 2), dtype=bool)
    hidden[30:, 0] = True
    found, index = filmed([walker(800, 1000), walker(1100, 1300)], hidden=hidden)
    where = int(np.flatnonzero(index >= 0)[0])
    track = track_person(found, TIMES, person=int(index[where]), frame=where)
    np.testing.assert_array_equal(track.person, index)
    assert track.lost[30:].all()


def test_identities_of_a_tracker_override_positions() -> None:
    found, index = filmed([walker(900, 1000), walker(905, 1005)])
    identity = np.where(np.arange(2) == index[:, None], 7, 3)
    known = Detections(found.uv_px, found.confidence, identity=identity)
    track = track_person(known, TIMES, person=int(index[0]), frame=0)
    np.testing.assert_array_equal(track.person, index)


@pytest.mark.parametrize("person, frame", [(2, 0), (-1, 0), (0, T), (0, -1), (5, None)])
def test_unknown_persons_are_refused(person: int, frame: int | None) -> None:
    found, _ = filmed([walker(300, 400), walker(1300, 1400)])
    with pytest.raises(InvalidInputError, match=f"person {person + 1} in frame .*there is no such person"):
        track_person(found, TIMES, person=person, frame=frame)


def test_a_brief_false_detection_elsewhere_does_not_continue_a_person() -> None:
    found, index = filmed([walker(300, 600)])
    uv, confidence = np.array(found.uv_px), np.array(found.confidence)
    uv[:50], confidence[:50] = np.nan, 0.0
    ghost = slice(5, 10)
    uv[ghost, 0], confidence[ghost, 0] = BODY + np.array([1500.0, 300.0]), 0.8
    track = track_person(Detections(uv, confidence), TIMES, person=0, frame=60)
    np.testing.assert_array_equal(track.person, np.where(np.arange(T) < 50, NOBODY, index))
    seen = slice(5, 20)  # half a second is somebody who comes back
    uv[seen, 0], confidence[seen, 0] = BODY + np.array([400.0, 540.0]), 0.8
    track = track_person(Detections(uv, confidence), TIMES, person=0, frame=60)
    assert (track.person[seen] == 0).all()


def follow(*frames: list[tuple[float, float]]) -> tuple[PersonFollower, list[float | None]]:
    """Where the followed person stands in each frame, px; people are (place, size) in an image of 1000 px."""
    body = np.array([[0, 0], [0, 1], [0.3, 0.5], [-0.3, 0.5], [0, 0.4]])
    follower = PersonFollower((1000.0, 800.0))
    at: list[float | None] = []
    for i, people in enumerate(frames):
        found = [Person(np.column_stack([body * size + [place, 100], np.full(5, 0.9)])) for place, size in people]
        index = follower.follow(found, i / 30)
        at.append(None if index is None else people[index][0])
    return follower, at


def test_the_follower_keeps_the_person_chosen_first_whatever_the_order_and_others_do() -> None:
    follower, at = follow([(100, 200), (480, 220)], [(485, 220), (110, 210)], [(120, 300), (490, 220)], [(495, 220)])
    assert at == [480, 485, 490, 495]
    assert (follower.chosen, follower.ambiguous) == (1, 0)


def test_the_follower_waits_a_second_for_a_person_who_is_hidden_and_then_takes_another() -> None:
    other, gone = [(900.0, 200.0)], [(500.0, 200.0), (900.0, 200.0)]
    follower, at = follow(gone, *[other] * 40)
    assert at[:31] == [500, *[None] * 30]
    assert at[-1] == 900
    assert follower.chosen == 2
    _, back = follow(gone, *[other] * 20, gone)
    assert back[-1] == 500


def test_the_follower_counts_frames_in_which_two_people_are_near() -> None:
    near = [(500.0, 200.0), (505.0, 200.0)]
    follower, at = follow([(500.0, 200.0)], near, near, [])
    assert follower.ambiguous >= 1
    assert at[-1] is None


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
