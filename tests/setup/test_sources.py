"""Files given on a command line are recognised by their content and sorted by what they are."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import planted
import pytest
from fuzz_support import OPENCV, OPENPOSE, recording, sensor_file, write_files
from sensor_files import WRITERS

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.setup.sources import SourceKind, Sources, recognise_source

CAMERA = planted.camera()
MAP = b"serial,segment\n00B42279,pelvis\n00B4227D,right shank\n"
LANDMARKS = b'{"frames": [{"time": 0.1, "landmarks": [{"x": 0.5, "y": 0.25}]}]}'
OF_ONE_FILE = {
    # video: the first bytes of containers, whatever the file is called
    "a.mp4": (b"\0\0\0\x20ftypisom\0\0\2\0", SourceKind.VIDEO),
    "b.data": (b"\0\0\0\x14ftypqt  ", SourceKind.VIDEO),
    "c": (b"RIFF\x10\0\0\0AVI LIST", SourceKind.VIDEO),
    "d.bin": (b"\x1a\x45\xdf\xa3\x01\0\0\0", SourceKind.VIDEO),
    "e.MTS": (b"\0\0\1\0G@\0\x10", SourceKind.VIDEO),
    # keypoints
    "f.json": (OPENPOSE, SourceKind.KEYPOINTS),
    "g.txt": (LANDMARKS, SourceKind.KEYPOINTS),
    "h.json": (b'[{"image_id": 0, "keypoints": [1.5, 2.5, 0.5]}]', SourceKind.KEYPOINTS),
    "i.csv": (b"time,nose_x,nose_y,nose_score\n0.0,1,2,0.5\n", SourceKind.KEYPOINTS),
    "j.csv": (b"frame,x0,y0,v0,x1,y1,v1\n0,1,2,1,3,4,1\n", SourceKind.KEYPOINTS),
    # cameras
    "k.yml": (OPENCV, SourceKind.CAMERA),
    "l.json": (b'{"width": 64, "height": 48, "K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]]}', SourceKind.CAMERA),
    # maps of sensors
    "n.csv": (MAP, SourceKind.SENSOR_MAP),
    "o.txt": (b"00B42279 pelvis\n00B4227D right shank\n", SourceKind.SENSOR_MAP),
    # the phone that filmed
    "x.csv": (b'"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"\n', SourceKind.PHONE),
    "Gyroscope.csv": (b"time,seconds_elapsed,z,y,x\n1,0,1,2,3\n", SourceKind.PHONE),
    # others
    "p.pickle": (pickle.dumps({"a": 1}), SourceKind.UNKNOWN),
    "q.txt": (b"A license\nof two words a\nline perhaps\n", SourceKind.UNKNOWN),
    "r.csv": (b"time,force\n0,1\n", SourceKind.UNKNOWN),
    "s.json": (b'{"a": 1}', SourceKind.UNKNOWN),
    "t.toml": (b"[tool.ruff]\nline-length = 110\n", SourceKind.UNKNOWN),
    "u.npz": (b"PK\x03\x04 no archive", SourceKind.UNKNOWN),
    "v": (b"", SourceKind.UNKNOWN),
    "w.dat": (b"\0\1\2\3\4\5\6\7\x08", SourceKind.UNKNOWN),
}


@pytest.mark.parametrize("name", OF_ONE_FILE)
def test_a_file_is_known_by_its_content(tmp_path: Path, name: str) -> None:
    content, kind = OF_ONE_FILE[name]
    (tmp_path / name).write_bytes(content)
    assert recognise_source(tmp_path / name) is kind


@pytest.mark.parametrize("title", WRITERS)
def test_sensors_of_every_format_are_known_as_file_and_as_folder(tmp_path: Path, title: str) -> None:
    write_files(tmp_path / "trial", sensor_file(title))
    assert recognise_source(tmp_path / "trial") is SourceKind.SENSORS
    beside = "Quaternion.csv", "channels.tsv", "motion.json"
    path = next(p for p in (tmp_path / "trial").rglob("*") if p.is_file() and not p.name.endswith(beside))
    assert recognise_source(path) is SourceKind.SENSORS


def test_arrays_and_folders(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", uv_px=np.zeros((2, 3, 2)))
    np.savez(tmp_path / "b.npz", quat_wxyz=np.zeros((2, 3, 4)))
    np.save(tmp_path / "c.npy", np.zeros((2, 3, 2)))
    write_camera_toml(tmp_path / "d.toml", {"left": CAMERA})
    write_files(tmp_path / "json", {f"p_{i}_keypoints.json": OPENPOSE for i in range(3)})
    recording(tmp_path)
    (tmp_path / "empty").mkdir()
    write_files(tmp_path / "phone", {"Gyroscope.csv": OF_ONE_FILE["Gyroscope.csv"][0]})
    kinds = {
        "a.npz": SourceKind.KEYPOINTS,
        "b.npz": SourceKind.UNKNOWN,
        "c.npy": SourceKind.KEYPOINTS,
        "d.toml": SourceKind.CAMERA,
        "json": SourceKind.KEYPOINTS,
        "take": SourceKind.RECORDING,
        "take/recording.toml": SourceKind.RECORDING,
        "empty": SourceKind.UNKNOWN,
        "phone": SourceKind.PHONE,
    }
    assert {name: recognise_source(tmp_path / name) for name in kinds} == kinds


def test_the_files_of_a_take_are_sorted_in_any_order(tmp_path: Path) -> None:
    for name in ("a.mp4", "f.json", "k.yml", "n.csv"):
        (tmp_path / name).write_bytes(OF_ONE_FILE[name][0])
    write_files(tmp_path / "mtw", sensor_file("Xsens MT Manager text"))
    write_files(tmp_path / "dot", sensor_file("Movella DOT CSV"))
    write_files(tmp_path / "phone", {"Gyroscope.csv": OF_ONE_FILE["Gyroscope.csv"][0]})
    names = ("mtw", "a.mp4", "n.csv", "phone", "dot", "k.yml", "f.json")
    found = Sources.of(tmp_path / name for name in names)
    assert found == Sources(
        video=tmp_path / "a.mp4",
        keypoints=tmp_path / "f.json",
        sensors=(tmp_path / "mtw", tmp_path / "dot"),
        camera=tmp_path / "k.yml",
        sensor_map=tmp_path / "n.csv",
        phone=tmp_path / "phone",
    )
    assert set(found.paths) == {tmp_path / name for name in names}
    assert found.name == "a"
    assert Sources.of([str(tmp_path / "dot")]).name == "dot"


def test_what_is_double_unknown_or_missing_is_told_in_a_sentence(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.data", "q.txt"):
        (tmp_path / name).write_bytes(OF_ONE_FILE[name][0])
    recording(tmp_path)
    with pytest.raises(InvalidInputError, match=r"a\.mp4 and .*b\.data: each is a video; give one of them"):
        Sources.of([tmp_path / "a.mp4", tmp_path / "b.data"])
    with pytest.raises(FileFormatError, match=r"q\.txt: nothing that is known. Known: a video .* a map"):
        Sources.of([tmp_path / "a.mp4", tmp_path / "q.txt"])
    with pytest.raises(FileFormatError, match="there is no such file or folder"):
        Sources.of([tmp_path / "no.mp4"])
    with pytest.raises(InvalidInputError, match="is a recording already; go on with: rtof-kin reconstruct"):
        Sources.of([tmp_path / "take"])
