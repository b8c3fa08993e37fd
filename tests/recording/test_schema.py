"""The schema of ``recording.toml`` and the readers agree on every field, in both directions."""

from __future__ import annotations

import copy
import datetime
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from sensor_files import SERIALS, truth, write_mt

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.imu_declaration import CHOICES
from rtof_kin.formats.camera_motion_npz import write_camera_motion
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.formats.world_axes import UP
from rtof_kin.inertial.camera_gyroscope import HELD
from rtof_kin.recording import index as index_module
from rtof_kin.recording.files import RECOGNISE, naming
from rtof_kin.recording.index import SCHEMA_VERSION, SKELETONS, read_index
from rtof_kin.recording.recording import INDEX, Recording
from rtof_kin.recording.schema import SCHEMA, check_index, schema, shape_of
from rtof_kin.recording.sources import InMemory
from rtof_kin.recording.streams import ALL
from rtof_kin.vision.layouts import detector_table

DEMO = Path(__file__).parents[2] / "models/demo"
T = 12
LINES = """
    width_px = 1920
    height_px = 1080
"""
AIMED = f"{LINES}focal_px = 1250.0\nposition_m = [4.0, 0.6, 1.5]\ntarget_m = [0.0, 0.0, 1.0]\n"
MATRICES = f"""{LINES}
    K = [[1250, 0, 960.0], [0, 1250, 540], [0, 0, 1]]
    R_camera_world = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
    t_camera_world_m = [0.0, 1.0, 4.0]
"""
SENSORS = """
    [imus.sensors.L_UpArm]
    quat_wxyz_world_inertial = [1, 0, 0, 0]
    R_sensor_bone = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    [imus.sensors.strap]
    joint = "RightLeg"
    lever_arm_m = [0.05, 0.0, -0.16]
    R_world_inertial = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    quat_wxyz_sensor_bone = [1, 0, 0, 0]
"""
JOINTS = SkeletonModel.default().names
OFFSETS = "\n".join(f"{name} = [0.01, 0.02, 0.2]" for name in JOINTS[1:])
RECORDINGS = {
    "everything": f"""
    schema_version = 1
    name = "walk"
    first_frame = 3
    [session]
    subject = "P07"
    operator = "A"
    date = "2026-01-31"
    place = "here"
    protocol = "walk"
    [scene]
    floor_height_m = 0.0
    [camera]
    {AIMED}
    principal_point_px = [960.0, 540.0]
    distortion = [0, 0, 0, 0, 0]
    assumed = ["pose"]
    stabilised = true
    heading_drift_deg_s = 0.01
    uncertainty = {{focal = 0.1, tilt_deg = 5, roll_deg = 1.0, height_m = 0.02, k1 = 0.05, of_motion = true}}
    [keypoints]
    file = "keypoints.npz"
    rate_hz = 60.0
    start_s = 0.5
    layout = "joints"
    [[views]]
    [views.camera]
    {MATRICES}
    [views.keypoints]
    file = "keypoints.npz"
    rate_hz = 60
    start_s = 0.5
    landmarks = {list(JOINTS)}
    [imus]
    file = "imus.npz"
    rate_hz = 60.0
    start_s = 0.4
    clock_drift = 1e-5
    names = ["L_UpArm", "strap"]
    {SENSORS}
    [truth]
    file = "truth.npz"
    [notes]
    acknowledgement = "Data by nobody."
    text = "-"
    """,
    "a person": """
    schema_version = 1
    [subject]
    height_m = 1.8
    mass_kg = 70.0
    sex = "male"
    [skeleton]
    table = "total_capture"
    bone_lengths_m = {LeftLeg = 0.41}
    [posture.quat_wxyz]
    Spine1 = [1.0, 0, 0, 0]
    [imus]
    file = "imus.npz"
    rate_hz = 60.0
    names = ["a", "b"]
    """,
    "files of others": f"""
    schema_version = 1
    [camera]
    file = "cameras.toml"
    name = "a"
    up = "z"
    metres_per_unit = 1.0
    motion = {{file = "gyro.csv", sensor = "phone", held = "portrait"}}
    [keypoints]
    file = "keypoints.npz"
    layout = "joints"
    rate_hz = 60
    person = 0
    frame = 1
    [imus]
    file = "trial"
    rate_hz = 60.0
    first_sample_s = 0.0
    acceleration_unit = "m/s2"
    gravity = "included"
    acceleration_axes = "sensor"
    angular_unit = "rad/s"
    quaternion_order = "wxyz"
    orientation_maps = "sensor to inertial"
    inertial_axes = "z up"
    [imus.map]
    {SERIALS[0]} = "pelvis"
    """,
    "sensors alone": f"""
    schema_version = 1
    [skeleton.joint_offsets_m]
    {OFFSETS}
    [imus]
    file = "imus.csv"
    start_s = 0.0
    {SENSORS}
    """,
    "a map of sensors": """
    schema_version = 1
    [imus]
    file = "trial"
    sensor_map = "places.csv"
    """,
    "a camera's matrices": f"""
    schema_version = 1
    [camera]
    {MATRICES}
    motion = {{file = "turning.npz", start_s = 0.0}}
    [keypoints]
    file = "keypoints.npz"
    rate_hz = 60
    landmarks = {list(JOINTS)}
    """,
    "points in a .csv": f"""
    schema_version = 1
    [camera]
    {AIMED}
    [keypoints]
    file = "keypoints.csv"
    [imus]
    {SENSORS}
    """,
}  # fmt: skip
DELETED = object()
VALUES = (
    DELETED, "text", True, 3, 1.5, -1, math.nan, datetime.date(2026, 1, 31), [], ["a"], [1.0], {},
)  # fmt: skip
KINDS = (DELETED, "text", True, 1.5, [])
CONTENTS = (
    "no human height", "is no person's", "the skeleton stands", "leads out of the folder", "there is no file",
    "has times of its own", "has no times", r"\[imus\] '(names|map|gravity|\w+_\w+)'",
    "it has no table", "unknown (joint|segment|sensor|camera)", "is not a day", "shift them to one clock",
    "is it in mm", "no such person", "on their clock", "points; name each one", "sensors are named",
    "list the sensors in the file's order",
    "stabilised already", "name one of a, b", "longer than 1 m", r"strap\] (joint|lever_arm_m): missing",
    r"joint_offsets_m\] \w+: missing",
)  # fmt: skip
"""What readers find that the text alone does not tell."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that `RECORDINGS` name."""
    folder = tmp_path_factory.mktemp("recording")
    video = planted.recording(planted.moving(SkeletonModel.default(), T)).video
    np.savez(folder / "keypoints.npz", uv_px=video.uv_px, confidence=np.full((T, 21), 0.9))
    np.savez(
        folder / "imus.npz",
        quat_wxyz=np.tile([1.0, 0, 0, 0], (T, 2, 1)),
        f_sensor=np.tile([0, 0, 9.81], (T, 2, 1)),
    )
    poses = planted.moving(SkeletonModel.default(), T).poses
    np.savez(
        folder / "truth.npz",
        times=poses.times + 0.5,
        p_world_joint=poses.p_world_joint,
        R_world_bone=poses.R_world_bone,
    )
    names = [f"{s}_{end}" for s in ("L_UpArm", "strap") for end in ("qw", "qx", "qy", "qz", "fx", "fy", "fz")]
    rows = [",".join(map(str, [t / 60, *[1, 0, 0, 0, 0, 0, 9.81] * 2])) for t in range(T)]
    (folder / "imus.csv").write_text("\n".join([",".join(["time", *names]), *rows]))
    rows = [f"{t / 60},500,{500 + t}" for t in range(T)]
    (folder / "keypoints.csv").write_text("\n".join(["time,Hips_u_px,Hips_v_px", *rows]))
    times = np.arange(-1, 3, 0.02)
    write_camera_motion(
        folder / "turning.npz", CameraMotion(times, so3.exp(0.1 * np.sin(times)[:, None] * [0, 1.0, 0]))
    )
    rows = [
        ",".join(map(str, row))
        for row in np.column_stack([times, np.tile([0, 0.1, 0, 0, 9.81, 0], (len(times), 1))])
    ]
    (folder / "gyro.csv").write_text("\n".join(["time,wx,wy,wz,fx,fy,fz", *rows]))
    (folder / "trial").mkdir()
    write_mt(folder / "trial", [truth(6), truth(7)])
    (folder / "places.csv").write_text(f"{SERIALS[0]},pelvis\n")
    write_camera_toml(folder / "cameras.toml", {"a": video.camera, "b": video.camera})
    return folder


def index_of(name: str) -> dict[str, Any]:
    return tomllib.loads(RECORDINGS[name])


def fault(check: Callable[[], object]) -> str | None:
    try:
        check()
    except RtofError as error:
        return str(error)
    return None


def refused_by_schema(folder: Path, index: dict[str, Any]) -> str | None:
    return fault(lambda: check_index(Section(folder / INDEX, index)))


def refused_by_readers(folder: Path, index: dict[str, Any]) -> str | None:
    def read() -> None:
        with naming(folder / INDEX), np.errstate(all="ignore"):
            fields, streams = read_index(Section(folder / INDEX, index), InMemory())
            Recording(**fields, **streams.parts(lambda stream: stream.part(ALL)))

    return fault(read)


@pytest.fixture(autouse=True)
def _readers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "check_index", lambda _: None)


# --- agreement -----------------------------------------------------------------------------------


def tables(
    index: dict[str, Any], node: dict[str, Any], where: str = ""
) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Name, contents and schema of all tables."""
    yield where, index, node
    for field, value in index.items():
        inner = node.get("properties", {}).get(field, node["additionalProperties"])
        if isinstance(value, dict):
            yield from tables(value, inner, f"{where}.{field}")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from tables(value[0], inner["items"], f"{where}.{field}")


def fields_of(node: dict[str, Any], where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """All fields of the schema, with their tables."""
    inner = dict(node.get("properties", {}))
    if isinstance(node.get("additionalProperties"), dict):
        inner["*"] = node["additionalProperties"]
    for field, one in inner.items():
        yield f"{where}.{field}", one
        yield from fields_of(one.get("items") or one, f"{where}.{field}")


def changed(name: str, tried: set[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The recording with one field left out or added, or, unless it was tried, of another value or kind.

    Of fields that are alike in the schema, the first one is given all values, the others one of each kind.
    """
    whole = index_of(name)
    for where, table, node in tables(whole, schema()):
        for field in list(table) if "properties" in node else list(table)[:1]:
            kept = table[field]
            own = dict(node.get("properties", {}).get(field, {}), description="")
            known = {f"{where}.{field}", kind := json.dumps(own)} & tried
            for value in (DELETED,) if f"{where}.{field}" in known else KINDS if known else VALUES:
                if value is DELETED:
                    del table[field]
                else:
                    table[field] = value
                yield f"{name}{where}.{field} = {value}", copy.deepcopy(whole)
                table[field] = kept
            tried |= {f"{where}.{field}", kind}
        for field in (*node.get("properties", {}), "mispelt"):
            if field not in table:
                table[field] = usual(node.get("properties", {}).get(field, {}))
                yield f"{name}{where}.{field} added", copy.deepcopy(whole)
                del table[field]


def usual(node: dict[str, Any]) -> Any:
    """A value of the kind that the schema says."""
    if "enum" in node:
        return node["enum"][0]
    if shape := shape_of(node) if "prefixItems" in node else ():
        return (
            (np.eye(3) if shape == (3, 3) else np.eye(*shape, 1)[:, 0]).tolist()
            if len(shape) > 1
            else [1.0] * shape[0]
        )
    kinds = {"number": 1.0, "integer": 1, "boolean": True, "object": {}, "array": [], "string": "imus.npz"}
    return kinds[node.get("type", "string")]


def test_schema_and_readers_accept_and_refuse_the_same(folder: Path) -> None:
    disagreements, tried = [], set[str]()
    for name in RECORDINGS:
        assert refused_by_schema(folder, index_of(name)) is None
        assert refused_by_readers(folder, index_of(name)) is None
        for what, index in changed(name, tried):
            by_schema, by_readers = refused_by_schema(folder, index), refused_by_readers(folder, index)
            if by_schema and not by_readers:
                disagreements.append(f"{what}: schema alone: {by_schema}")
            if by_readers and not by_schema and not any(re.search(text, by_readers) for text in CONTENTS):
                disagreements.append(f"{what}: readers alone: {by_readers}")
    assert not disagreements, "\n".join(disagreements)


# --- one contract --------------------------------------------------------------------------------


def test_the_recordings_here_have_every_field_of_the_schema() -> None:
    used = {
        re.sub(r"(sensors|bone_lengths_m|joint_offsets_m|map|quat_wxyz)\.\w+", r"\1.*", f"{where}.{field}")
        for name in RECORDINGS
        for where, table, _ in tables(index_of(name), schema())
        for field in table
    }
    views = {f".{name}" for name in ("camera", "keypoints")}
    expected = {name for name, _ in fields_of(schema())}
    missing = {name for name in expected - used if name.removeprefix(".views") not in used}
    assert missing == set()
    assert used <= expected
    assert views <= used


def test_choices_are_those_of_the_code() -> None:
    field = dict(fields_of(schema()))
    assert field[".schema_version"]["const"] == SCHEMA_VERSION
    layouts = ["joints", RECOGNISE, *detector_table().layouts]
    assert sorted(field[".keypoints.layout"]["enum"]) == sorted(set(layouts))
    assert all(name in field[".keypoints.layout"]["errorMessage"] for name in layouts)
    choices = {
        ".skeleton.table": SKELETONS,
        ".camera.up": UP,
        ".camera.motion.held": HELD,
        **{f".imus.{name}": values for name, values in CHOICES.items()},
    }
    for name, values in choices.items():
        assert tuple(field[name]["enum"]) == tuple(values), name


def test_schema_is_valid_and_says_what_every_field_is() -> None:
    from jsonschema import Draft202012Validator

    Draft202012Validator.check_schema(json.loads(SCHEMA.read_text(encoding="utf-8")))
    assert [
        name for name, one in fields_of(schema()) if not (name.endswith("*") or one.get("description"))
    ] == []


def test_demo_and_saved_recordings_hold_to_the_schema(tmp_path: Path) -> None:
    Recording.load(DEMO).save(tmp_path / "saved")
    for folder in (DEMO, tmp_path / "saved"):
        check_index(Section.of_file(folder / INDEX))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": 5}, r"recording\.toml: camera: not a table; write its fields under \[camera\]"),
        ({"views": {}}, r"views: not tables in a row; begin each with \[\[views\]\]"),
        ({"camera": None}, r"camera: is missing; a camera and its keypoints go together"),
        ({"imus": {"sensors": {"a": {"joint": 1}}}}, r"\[imus\.sensors\.a\] joint: 1 is not text; put it"),
        ({"subjekt": {}}, r"unknown field in .*recording\.toml 'subjekt'\. Did you mean 'subject'\?"),
        (
            {"session": {"date": datetime.date(2026, 1, 31)}},
            r"\[session\] date: .* is not text; put it in quotes",
        ),
        ({"notes": {"text": "a", "name": "b"}}, r"\[notes\] 'name'\. Known: acknowledgement, text"),
        ({"scene": {"floor_height_m": math.nan}}, r"\[scene\] floor_height_m: nan is not a finite number"),
        ({"views": [{"camera": {}}]}, r"\[views\.1\.camera\] width_px: missing; add e\.g\. width_px = 1\.0"),
    ],
)
def test_what_is_wrong_is_told_with_file_field_and_remedy(change: dict[str, Any], message: str) -> None:
    index = {name: value for name, value in {**index_of("everything"), **change}.items() if value is not None}
    with pytest.raises(RtofError, match=message):
        check_index(Section(Path("recording.toml"), index))


def test_check_needs_no_other_file_and_opening_raises_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "check_index", check_index)
    (tmp_path / INDEX).write_text(RECORDINGS["everything"].replace("K = [[1250,", "K = [[true,"))
    with pytest.raises(RtofError, match=r"\[views\.1\.camera\] K: not 3 x 3 numbers in brackets"):
        Recording.load(tmp_path)
