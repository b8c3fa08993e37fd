"""Detectors' files: every format gives the same people; damaged files are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from detector_support import flat
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError
from rtof_kin.vision.detections import is_keypoint_header
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.layouts import detector_table

Array = NDArray[np.float64]
T, K = 6, 17
RNG = np.random.default_rng(0)
UV = RNG.uniform(50, 900, (T, 2, K, 2)).round(3)
NAMES = detector_table().layout("coco17").names
MP_NAMES = detector_table().layout("mediapipe33").names


def points(t: int, p: int) -> list[float]:
    return flat(UV[t, p])


def openpose_folder(path: Path) -> Path:
    folder = path / "walk_json"
    folder.mkdir()
    for t in range(T):
        people = [{"person_id": [-1], "pose_keypoints_2d": points(t, p), "face_keypoints_2d": []} for p in (0, 1)]
        name = f"walk_{t + 100:012d}_keypoints.json"
        (folder / name).write_text(json.dumps({"version": 1.3, "people": people}))
    return folder


def dumped(path: Path, data: Any) -> Path:
    path = path / "people.json"
    path.write_text(json.dumps(data))
    return path


def frames(key: str, of: str) -> list[dict[str, Any]]:
    return [{key: [{of: points(t, p)} for p in (0, 1)]} for t in range(T)]


def entries(image: Callable[[int], Any]) -> list[dict[str, Any]]:
    return [
        {"image_id": image(t), "category_id": 1, "keypoints": points(t, p), "score": 2.5, "idx": p + 4}
        for t in range(T)
        for p in (0, 1)
    ]


def coco_annotations() -> dict[str, Any]:
    """Image ids in no order; 2 for visible instead of a confidence."""

    def flags(t: int, p: int) -> list[float]:
        return [v if i % 3 < 2 else 2 for i, v in enumerate(points(t, p))]

    return {
        "images": [{"id": 900 - 7 * t} for t in range(T)],
        "annotations": [{"image_id": 900 - 7 * t, "keypoints": flags(t, p)} for p in (0, 1) for t in range(T)],
        "categories": [{"id": 1, "keypoints": list(NAMES)}],
    }


FORMATS: dict[str, Callable[[Path], Path]] = {
    "OpenPose folder": openpose_folder,
    "OpenPose frames": lambda p: dumped(p, frames("people", "pose_keypoints_2d")),
    "frames in a table": lambda p: dumped(p, {"frames": frames("people", "pose_keypoints")}),
    "AlphaPose": lambda p: dumped(p, entries(lambda t: f"{t}.jpg")),
    "AlphaPose cmu": lambda p: dumped(
        p, {f"frame_{t}.jpg": frame for t, frame in enumerate(frames("bodies", "joints"))}
    ),
    "COCO results": lambda p: dumped(p, entries(lambda t: t)),
    "COCO annotations": lambda p: dumped(p, coco_annotations()),
    "MMPose": lambda p: dumped(p, {"instance_info": frames("instances", "keypoints")}),
    "MMPose scores": lambda p: dumped(
        p,
        [
            {"instances": [{"keypoints": UV[t, i].tolist(), "keypoint_scores": [0.8] * K} for i in (0, 1)]}
            for t in range(T)
        ],
    ),
    "lists of lists": lambda p: dumped(
        p, np.reshape([[points(t, p) for p in (0, 1)] for t in range(T)], (T, 2, K, 3)).tolist()
    ),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_json_gives_the_same_people(name: str, tmp_path: Path) -> None:
    found = read_detector_file(FORMATS[name](tmp_path))
    np.testing.assert_allclose(found.uv_px, UV)
    np.testing.assert_allclose(found.confidence, 1.0 if name == "COCO annotations" else 0.8)
    assert (found.names == NAMES) == (name == "COCO annotations")
    assert (found.identity is not None) == (name in ("AlphaPose", "COCO results"))
    if found.identity is not None:
        np.testing.assert_array_equal(found.identity, np.tile([4, 5], (T, 1)))


@pytest.mark.parametrize("many", [False, True])
@pytest.mark.parametrize("kind", ["npy", "npy with confidence", "npz", "npz with confidence and times"])
def test_arrays_of_one_or_many_people(many: bool, kind: str, tmp_path: Path) -> None:
    uv = UV if many else UV[:, 0]
    joined = np.concatenate([uv, np.full((*uv.shape[:-1], 1), 0.8)], axis=-1)
    path = tmp_path / f"people.{kind[:3]}"
    if kind.startswith("npy"):
        np.save(path, uv if kind == "npy" else joined)
    elif kind == "npz":
        np.savez(path, keypoints=joined)
    else:
        np.savez(path, uv_px=uv, confidence=joined[..., 2], times=np.arange(T) / 25)
    found = read_detector_file(path)
    np.testing.assert_allclose(found.uv_px, UV if many else UV[:, :1])
    np.testing.assert_allclose(found.confidence, 1.0 if kind == "npy" else 0.8)
    assert (found.times is not None) == kind.endswith("times")


def landmark(t: int, k: int) -> dict[str, float]:
    u, v = UV[t, 0, k % K] / [1920, 1080]
    return {"x": u, "y": v, "z": -0.2, "visibility": 0.8}


MEDIAPIPE: dict[str, Callable[[int], Any]] = {
    "bare": lambda t: [landmark(t, k) for k in range(33)],
    "landmarks": lambda t: {"timestamp_ms": 40 * t, "landmarks": [landmark(t, k) for k in range(33)]},
    "several": lambda t: {"time": 0.04 * t, "pose_landmarks": [[landmark(t, k) for k in range(33)]]},
    "one": lambda t: {"time": 0.04 * t, "pose_landmarks": [landmark(t, k) for k in range(33)]},
}


@pytest.mark.parametrize("kind", MEDIAPIPE)
def test_mediapipes_fractions_of_the_image_become_pixels(kind: str, tmp_path: Path) -> None:
    path = dumped(tmp_path, [MEDIAPIPE[kind](t) for t in range(T)])
    found = read_detector_file(path, 1920, 1080)
    np.testing.assert_allclose(found.uv_px[:, 0], UV[:, 0][:, np.arange(33) % K])
    if kind == "bare":
        assert found.times is None
    else:
        np.testing.assert_allclose(found.times, 0.04 * np.arange(T))
    with pytest.raises(FileFormatError, match="width_px and height_px"):
        read_detector_file(path)


@pytest.mark.parametrize(
    "endings, size",
    [
        ("{n}_x {n}_y {n}_z {n}_visibility", [1920, 1080]),
        ("x{k} y{k} z{k} v{k}", [1920, 1080]),
        ("{n}_u_px {n}_v_px {n}_confidence", [1, 1]),
    ],
)
def test_columns_with_names_or_numbers(endings: str, size: list[int], tmp_path: Path) -> None:
    names = [endings.format(n=n, k=k) for k, n in enumerate(MP_NAMES)]
    uv = UV[:, 0][:, np.arange(33) % K]
    cells = np.concatenate([uv / size, np.full((T, 33, 2), 0.8)], axis=-1)[..., : len(endings.split())]
    rows = np.column_stack([40 * np.arange(T), cells.reshape(T, -1)])
    path = tmp_path / "pose.csv"
    header = ",".join(["timestamp_ms", *" ".join(names).split()])
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=header, comments="")
    found = read_detector_file(path, 1920, 1080)
    np.testing.assert_allclose(found.uv_px[:, 0], uv)
    np.testing.assert_allclose(found.confidence, 0.8)
    np.testing.assert_allclose(found.times, 0.04 * np.arange(T))
    assert found.names == (None if endings.startswith("x") else MP_NAMES)


def test_empty_frames_keep_their_number(tmp_path: Path) -> None:
    folder = openpose_folder(tmp_path)
    (folder / "walk_000000000102_keypoints.json").unlink()
    (folder / "walk_000000000103_keypoints.json").write_text('{"people": []}')
    empty = {"people": [{"pose_keypoints_2d": []}, {}]}
    (folder / "walk_000000000104_keypoints.json").write_text(json.dumps(empty))
    found = read_detector_file(folder)
    np.testing.assert_array_equal(found.present.any(axis=1), [True, True, False, False, False, True])
    np.testing.assert_allclose(found.uv_px[5], UV[5])
    path = dumped(tmp_path, [e for e in entries(lambda t: f"{t}.jpg") if e["image_id"] != "0.jpg"])
    np.testing.assert_array_equal(read_detector_file(path).present.any(axis=1), [False] + 5 * [True])


def test_zeros_and_nan_are_undetected_and_large_confidences_are_clipped(tmp_path: Path) -> None:
    data = np.concatenate([UV[:, 0], np.full((T, K, 1), 1.7)], axis=-1)
    data[0, 3], data[1, 4, 0], data[2, 5, 2] = 0.0, np.nan, np.nan
    np.save(tmp_path / "p.npy", data)
    found = read_detector_file(tmp_path / "p.npy")
    for t, k in ((0, 3), (1, 4), (2, 5)):
        assert found.confidence[t, 0, k] == 0
        assert np.isnan(found.uv_px[t, 0, k]).all()
    assert found.confidence.max() == 1.0


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"other": np.zeros(3)}, "no array uv_px or keypoints .*there is other"),
        ({"uv_px": np.ones((3, 17))}, r"shape \(3, 17\) is neither"),
        ({"uv_px": np.ones((3, 17, 4))}, "is neither"),
        ({"uv_px": UV, "keypoints": UV}, "has uv_px and keypoints; leave only one"),
        ({"uv_px": UV, "confidence": np.ones((T, K))}, r"confidence: expected shape \(6, 2, 17\)"),
        ({"uv_px": UV, "confidence": np.full((T, 2, K), 87.0)}, "give values from 0 to 1"),
        ({"uv_px": UV, "confidence": np.full((T, 2, K), -0.1)}, "give values from 0 to 1"),
        ({"uv_px": UV, "times": np.arange(3)}, "3, but there are 6 frames"),
        ({"uv_px": UV, "times": np.zeros(T)}, "time does not increase"),
        ({"uv_px": UV[:0]}, "no person in any frame"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(arrays: dict[str, Array], message: str, tmp_path: Path) -> None:
    path = tmp_path / "p.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=message):
        read_detector_file(path)


def test_a_folder_must_hold_numbered_json(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no .json file"):
        read_detector_file(tmp_path)
    with pytest.raises(FileFormatError, match="no such file"):
        read_detector_file(tmp_path / "none.json")
    for names, refused in ((["a"], "a"), (["a_1", "b_1"], "b_1")):
        folder = tmp_path / "".join(names)
        folder.mkdir()
        for name in names:
            (folder / f"{name}.json").write_text('{"people": []}')
        with pytest.raises(FileFormatError, match=f"{refused}.json: .* frame number"):
            read_detector_file(folder)


@pytest.mark.parametrize(
    ("array", "text"),
    [
        (np.frombuffer(b"pose.onnx on cpu, 31 frames per second", np.uint8), "pose.onnx on cpu, 31 frames per second"),
        (np.frombuffer(b"two\x1b[2Jlines\n", np.uint8), "two[2Jlines"),
        (np.array([65.0, np.nan, np.inf, -3.0, 300.0]), "A\ufffd\ufffd"),
        (np.full((3, 400), 65), 200 * "A"),
        (np.zeros(0), ""),
    ],
)
def test_what_a_file_says_of_its_detector_is_printable_and_short(array: Array, text: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", uv_px=UV, detector=array)
    assert read_detector_file(tmp_path / "p.npz").detector == text


BODYPARTS = ("left_hip", "wing")
TRACKED = RNG.uniform(50, 900, (3, 2, 2, 2)).round(2)  # (T, P, K, 2)


def deeplabcut(path: Path, people: tuple[str, ...]) -> Path:
    columns = [(who, name, part) for who in people for name in BODYPARTS for part in ("x", "y", "likelihood")]
    heads = [["scorer", *["DLC_resnet"] * len(columns)]]
    if len(people) > 1:
        heads.append(["individuals", *(who for who, _, _ in columns)])
    heads += [["bodyparts", *(name for _, name, _ in columns)], ["coords", *(part for _, _, part in columns)]]
    rows = []
    for t in (0, 2):  # frame 1 is missing
        cells = [v for p in range(len(people)) for k in range(2) for v in (*TRACKED[t, p, k], 0.75)]
        rows.append([str(t + 10), *map(str, cells)])
    rows[1][1] = ""
    file = path / "DLC.csv"
    file.write_text("\n".join(",".join(row) for row in [*heads, *rows]) + "\n")
    return file


@pytest.mark.parametrize("people", [("",), ("ann", "bob")])
def test_predictions_of_deeplabcut_are_read(tmp_path: Path, people: tuple[str, ...]) -> None:
    file = deeplabcut(tmp_path, people)
    assert is_keypoint_header(file.read_text().partition("\n")[0])
    found = read_detector_file(file)
    assert found.names == BODYPARTS
    assert found.uv_px.shape == (3, len(people), 2, 2)
    np.testing.assert_allclose(found.uv_px[0], TRACKED[0, : len(people)])
    assert np.isnan(found.uv_px[1]).all()
    assert np.isnan(found.uv_px[2, 0, 0]).all()
    np.testing.assert_allclose(found.confidence[2, 0], [0, 0.75])
    assert (found.identity is None) == (len(people) == 1)


def sleap_csv(path: Path, track: str) -> Path:
    head = ["track", "frame_idx", "instance.score", *(f"{n}.{part}" for n in BODYPARTS for part in ("x", "y", "score"))]
    rows = [
        [track.format(p), str(t + 4), "0.9", *(str(v) for k in range(2) for v in (*TRACKED[t, p, k], 0.5))]
        for t in range(3)
        for p in (1, 0)
        if (t, p) != (1, 0)
    ]
    file = path / "sleap.csv"
    file.write_text("\n".join(",".join(row) for row in [head, *rows]))
    return file


@pytest.mark.parametrize("track", ["track_{}", ""])
def test_sleaps_analysis_is_read_as_a_table(tmp_path: Path, track: str) -> None:
    file = sleap_csv(tmp_path, track)
    assert is_keypoint_header(file.read_text().partition("\n")[0])
    found = read_detector_file(file)
    assert found.names == BODYPARTS
    np.testing.assert_allclose(found.uv_px[0], TRACKED[0, ::-1])  # in the order of the rows
    np.testing.assert_allclose(found.uv_px[1, 0], TRACKED[1, 1])
    assert np.isnan(found.uv_px[1, 1]).all()
    assert (found.identity is None) == (not track)


def test_sleaps_analysis_is_read_as_hdf5(tmp_path: Path) -> None:
    tracks = np.moveaxis(TRACKED, (0, 1, 2, 3), (3, 0, 2, 1)).copy()
    tracks[0, :, 0, 1] = np.nan
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tracks"], file["node_names"] = tracks, [name.encode() for name in BODYPARTS]
    found = read_detector_file(tmp_path / "a.h5")
    assert found.names == BODYPARTS
    np.testing.assert_allclose(found.uv_px[0], TRACKED[0])
    assert found.confidence[1, 0].tolist() == [0.0, 1.0]


def test_hdf5_that_leads_to_another_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["tracks"] = np.zeros((1, 2, 2, 3))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tracks"] = h5py.ExternalLink("other.h5", "tracks")
        file["node_names"] = [name.encode() for name in BODYPARTS]
    with pytest.raises(FileFormatError, match="tracks: leads to another file; not opened"):
        read_detector_file(tmp_path / "a.h5")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("10,", "img10.png,", "'img10.png' is not the frame's number; give the predictions of a video"),
        ("coords", "cords", "no rows bodyparts and coords below scorer"),
        ("12,,", "12,x,", "line 5: expected 1 numbers, found 1, among them 'x'"),
        ("12,,", "12,", "line 5: expected 7 cells, found 6"),
        ("10,", "99999999,", "frames of 2 points of 1 for 2 rows; number from 0"),
    ],
)
def test_damaged_predictions_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = deeplabcut(tmp_path, ("",))
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(FileFormatError, match=said):
        read_detector_file(file)
