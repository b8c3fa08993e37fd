"""Files of other models' 3D points, and the conventions of their joints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.formats.markers import MarkerSequence, write_trc
from rtof_kin.vision.detections import Detections, Person
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.lift_points import (
    LiftPoints,
    convention,
    conventions,
    read_lift_points,
    recognised,
    split_convention,
)
from rtof_kin.vision.video import write_detections

TIMES = np.arange(5) / 30


def planted(count: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(count).normal(size=(len(TIMES), count, 3))


def test_every_joint_of_a_convention_lies_in_the_body_and_mirrors_the_other_side() -> None:
    body = SkeletonModel.default()
    for one in conventions().values():
        assert {*one.segments} <= {*body.names}
        assert len(one.layout) == len({*one.at}) == len(one.places)
        assert max(one.at) < max(one.counts)
        assert np.linalg.norm(one.places, axis=1).max() < 0.5
        assert (one.sigma >= 0.015).all()
        place = dict(zip(one.layout.points, zip(one.segments, one.places, strict=True), strict=True))
        for name, (segment, p) in place.items():
            if name.startswith("Left"):
                other, q = place[name.replace("Left", "Right")]
                assert other == segment.replace("Left", "Right")
                np.testing.assert_allclose(q, p * [1, -1, 1])


@pytest.mark.parametrize("name", [*conventions()])
def test_a_convention_is_recognised_by_its_names_in_any_order_among_others(name: str) -> None:
    found = recognised(["left_index_3", *reversed(convention(name).layout.names), "jaw"])
    assert (found and found.layout.name) == name


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ("Pelvis Neck Head _Hip _Knee _Ankle _Shoulder _Elbow", "smpl24"),
        ("Hips Head _Leg _Shin _Foot _Arm _ForeArm _Hand", "soma77"),
        ("Hips Head _UpLeg _Leg _Foot _Arm _ForeArm _Hand", "joints"),
        ("Hip Neck Head Nose _Hip _Knee _Ankle _BigToe _Shoulder _Elbow", "halpe26"),
        ("_ASI _KNE _ANK", None),
    ],
)
def test_names_say_the_convention(names: str, found: str | None) -> None:
    sided = (["L" + name, "R" + name] if name.startswith("_") else [name] for name in names.split())
    one = recognised([name for both in sided for name in both])
    assert (one and one.layout.name) == found


@pytest.mark.parametrize(
    ("key", "count", "name", "joint"),
    [
        ("joints", 24, "smpl24", ("left_knee", 4)),
        ("joints", 22, "smpl24", ("right_wrist", 21)),
        ("joints", 55, "smpl24", ("pelvis", 0)),
        ("keypoints_3d", 33, "mediapipe33", ("left_hip", 23)),
        ("keypoints_3d", 133, "coco23", ("right_heel", 22)),
        ("keypoints_3d", 136, "halpe26", ("hip", 19)),
        ("pred_keypoints_3d", 70, "mhr70", ("left-wrist", 62)),
        ("pred_keypoints_3d", 44, "body25", ("MidHip", 8)),
        ("posed_joints", 77, "soma77", ("rightShin", 73)),
    ],
)
def test_an_array_without_names_is_known_by_its_number(
    tmp_path: Path, key: str, count: int, name: str, joint: tuple[str, int]
) -> None:
    p = planted(count)
    np.savez(tmp_path / "a.npz", times=TIMES, **{key: p})
    found = read_lift_points(tmp_path / "a.npz")
    assert found.points.names == convention(name).layout.names
    np.testing.assert_array_equal(found.points.p_world[:, found.points.names.index(joint[0])], p[:, joint[1]])


def test_a_number_of_two_conventions_is_refused_until_one_is_named(tmp_path: Path) -> None:
    p = planted(17)
    np.savez(tmp_path / "a.npz", times=TIMES, joints=p)
    with pytest.raises(FileFormatError) as error:
        read_lift_points(tmp_path / "a.npz")
    assert str(error.value) == (
        f"{tmp_path / 'a.npz'}: 17 points without names may be coco17 (COCO, 17 points) or human36m17 (Human3.6M, "
        "17 points (VideoPose3D's order)): say which, as a.npz:coco17 after --lift, or in the files of [lift]"
    )
    path, name = split_convention(f"{tmp_path / 'a.npz'}:human36m17")
    found = read_lift_points(path, name)
    assert (found.name, found.convention, found.points.names[4]) == ("a.npz", "human36m17", "LHip")
    np.testing.assert_array_equal(found.points.p_world, p)
    assert split_convention("C:/a.npz") == (Path("C:/a.npz"), "")


def test_times_may_be_those_of_the_videos_frames(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", joints=planted(24))
    found = read_lift_points(tmp_path / "a.npz", frame_times=TIMES + 3.0)
    np.testing.assert_array_equal(found.points.times, TIMES + 3.0)
    with pytest.raises(FileFormatError, match="has no times, and 5 frames where the video has 4; give times"):
        read_lift_points(tmp_path / "a.npz", frame_times=TIMES[:4])
    with pytest.raises(FileFormatError, match="has no times; give times"):
        read_lift_points(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.zeros(3)}, r"no array p_world, joints, .* of shape \(T, K, 3\); there is times, other"),
        ({"joints": np.zeros((5, 2, 24, 3))}, r"shape \(5, 2, 24, 3\); give those of one person, \(T, K, 3\)"),
        ({"joints": np.zeros((5, 24, 2))}, r"shape \(5, 24, 2\); give those of one person"),
        ({"joints": np.zeros((5, 19, 3))}, r"19 points without names are of no known convention \(smpl24 24/22/52/55,"),
        ({"joints": np.zeros((5, 24, 3)), "times": np.zeros(5)}, "a.npz: marker times: .*increas"),
    ],
)
def test_other_arrays_are_refused_with_the_cause(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "a.npz", **{"times": TIMES, **arrays})
    with pytest.raises(FileFormatError, match=message):
        read_lift_points(tmp_path / "a.npz")


def test_files_of_every_kind_are_read(tmp_path: Path) -> None:
    names, p = convention("mhr70").layout.names, planted(23)
    p[3, 2] = np.nan
    plain = [[None if np.isnan(q).any() else q.tolist() for q in frame] for frame in p]
    (tmp_path / "a.json").write_text(
        json.dumps({"times": TIMES.tolist(), "names": names, "points": plain}), encoding="utf-8"
    )
    np.savez(tmp_path / "a.npz", times=TIMES, names=np.array(names), p_world=p)
    head = ",".join(["time", *(f"{name}_{axis}" for name in names for axis in "xyz")])
    rows = np.column_stack([TIMES, p.reshape(len(p), -1)])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=head, comments="")
    write_trc(tmp_path / "a.trc", MarkerSequence(TIMES, names, p), up="z")
    for suffix in ("json", "npz", "csv", "trc"):
        found = read_lift_points(tmp_path / f"a.{suffix}")
        assert found.points.names == names
        np.testing.assert_allclose(found.points.p_world, p, atol=1e-8)
    for name, text, what in (
        ("json", '{"times": [0], "names": ["a"]}', "times, names and points"),
        ("csv", "time,a_x\n0,1\n", "time, and x, y and z"),
    ):
        (tmp_path / f"bad.{name}").write_text(text, encoding="utf-8")
        with pytest.raises(FileFormatError, match=rf"bad\.{name}.*needs {what}"):
            read_lift_points(tmp_path / f"bad.{name}")
    with pytest.raises(FileFormatError, match=r"a\.mp4: no 3D points; known: \.trc, "):
        read_lift_points(tmp_path / "a.mp4")


def test_points_in_space_of_the_own_detection_are_read_from_its_file(tmp_path: Path) -> None:
    p, seen = planted(33), np.full((33, 3), 0.5) * [100, 100, 1]
    people = {k: [Person(seen, p_model=p[k])] for k in range(len(TIMES)) if k != 2}
    write_detections(tmp_path / "keypoints.npz", Detections.of_frames(people, TIMES))
    np.testing.assert_array_equal(read_detector_file(tmp_path / "keypoints.npz").p_model[[0, 4], 0], p[[0, 4]])
    found = read_lift_points(tmp_path / "keypoints.npz").points
    assert (found.names[23], np.isnan(found.p_world[2]).all()) == ("left_hip", True)
    np.testing.assert_array_equal(found.p_world[3], p[3])
    two = {k: [Person(seen, p_model=p[k])] * 2 for k in range(len(TIMES))}
    write_detections(tmp_path / "keypoints.npz", Detections.of_frames(two, TIMES), overwrite=True)
    with pytest.raises(FileFormatError, match=r"shape \(5, 2, 33, 3\); give those of one person"):
        read_lift_points(tmp_path / "keypoints.npz")


def test_an_unknown_convention_is_named_with_those_known() -> None:
    points = MarkerSequence(TIMES, ("a",), planted(1))
    with pytest.raises(UnknownNameError, match="unknown convention of 3D joints 'smpl'. .*smpl24"):
        LiftPoints("a.npz", points, "smpl")
