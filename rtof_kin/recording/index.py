"""``recording.toml``, the index of a recording's folder: its fields and, by a `Source`, its streams.

The format is described in docs/recording.md.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np
import tomli_w

from rtof_kin.body.pose_prior import NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel, known_body
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.input_table import InputTable
from rtof_kin.core.files.manifest import made_from, read_contents, write_manifest
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.core.over_time import Stream
from rtof_kin.data.corrections import Correction
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.cameras import filmed_stream
from rtof_kin.recording.labels import Session
from rtof_kin.recording.sensor_files import imu_stream
from rtof_kin.recording.streams import Source, Streams, corrected, data_path, naming, needed
from rtof_kin.recording.tables import BodyTable, RecordingTable, TruthTable
from rtof_kin.vision.lift_points import LiftPoints, read_lift_points, split_convention

INDEX: Final = "recording.toml"
UNFINISHED: Final = PurePath("live", "setup")  #: Folder that a live session makes first
SCHEMA_VERSION: Final = 1
SKELETONS: Final = ("total_capture", "human36m")  #: Tables of skeletons that a recording may name
_TRUTH_AXES: Final = {
    "times": 1,
    "p_world_joint": 3,
    "R_world_bone": 4,
    "provenance": 2,
    "valid": 2,
    "orientation_observed": 2,
}
"""Number of axes of arrays with a row for each sample; with fewer they hold for all samples."""
_CORRECTION: Final = re.compile(r"^\[\[corrections\]\].*?(?=^\[(?!\[corrections)|\Z)", re.MULTILINE | re.DOTALL)
TRUTH: Final = tuple(_TRUTH_AXES)  #: Fields of `PoseSequence` in a file
shipped = cache(SkeletonModel.named)  #: Skeleton of a table


def index_of(folder: Path) -> RecordingTable:
    """Return the tables of a recording's ``recording.toml``; errors as `InputTable.read`."""
    path = folder / INDEX
    if folder.is_dir() and not path.exists():
        if (folder / UNFINISHED / INDEX).is_file():
            finish = f"rtof-kin live --finish {folder}"
            raise FileFormatError(folder, f"a live session that was not finished; {finish} makes a recording of it")
        raise FileFormatError(
            path, "there is no such file; rtof-kin run --only recording makes a recording of a video and sensors' files"
        )
    data = load_toml(path)
    version = data.get("schema_version", SCHEMA_VERSION)
    if version != SCHEMA_VERSION and isinstance(version, int | float):
        raise FileFormatError(
            path,
            f"schema_version: {version} is not {SCHEMA_VERSION}, which this version of the package reads; use the "
            "version that wrote it, or a newer one",
        )
    return RecordingTable.of(data, path)


def read_index(index: RecordingTable, source: Source) -> tuple[dict[str, Any], Streams]:
    """Return the fields of a `Recording`, and open its streams; errors as `read_camera`."""
    subject, notes = index.subject, index.notes.text
    facts: dict[str, Any] = {
        "skeleton_table": index.skeleton.table,
        "height": subject.height_m,
        "mass_kg": subject.mass_kg,
        "sex": subject.sex,
        **_lengths_and_offsets(index.skeleton),
    }
    table = shipped(index.skeleton.table)
    keypoints, imus, calibration, posture, truth = None, None, None, None, None
    if index.camera is not None and index.keypoints is not None:
        keypoints, note = filmed_stream(index.camera, index.keypoints, table, source)
        notes = "\n".join(filter(None, (notes, note)))
    views = tuple(filmed_stream(view.camera, view.keypoints, table, source)[0] for view in index.views)
    lifts = tuple[LiftPoints, ...]()
    if index.lift is not None:
        files = [split_convention(name) for name in index.lift.files]
        filmed = None if keypoints is None or index.keypoints is None else keypoints.times - index.keypoints.start_s
        lifts = tuple(
            read_lift_points(data_path(index.lift, field="files", name=str(file)), convention, filmed)
            for file, convention in files
        )
    body = body_of(**facts)
    if index.imus is not None:
        if index.imus.file is None and keypoints is None:
            raise index.imus.error("file", "is missing; without a camera, name the file of the sensors' samples")
        sensors, calibration = imu_stream(index.imus, body, source)
        imus = None if sensors is None else source.checked(sensors)
    if index.posture is not None:
        _check_joints(index.posture, "quat_wxyz", body.names)
        quats = index.posture.quat_wxyz
        posture = NeutralPosture(tuple(quats), np.array([*quats.values()]).reshape(-1, 4))
    if index.truth is not None:
        truth = source.checked(_truth_stream(index.truth, body, source))
    try:
        session = Session(**{field.name: getattr(index.session, field.name) for field in fields(Session)})
    except InvalidInputError as error:
        raise index.session.error("date", str(error)) from error
    corrections = tuple(table.correction() for table in index.corrections)
    own: dict[str, Any] = {
        "name": index.name if index.has("name") else index.path.absolute().parent.name,
        "first_frame": index.first_frame,
        "floor_height": index.scene.floor_height_m,
        "acknowledgement": index.notes.acknowledgement,
        "notes": notes,
        "session": session,
        "calibration": calibration,
        "posture": posture,
        "lifts": lifts,
        "corrections": corrections,
    }
    return facts | own, corrected(Streams(keypoints, views, imus, truth), corrections, index.path)


def read_corrections(folder: str | Path) -> tuple[Correction, ...]:
    """Return what was corrected by hand in a recording's folder; nothing where there is no recording."""
    if not (Path(folder) / INDEX).is_file():
        return ()
    return tuple(table.correction() for table in index_of(Path(folder)).corrections)


def write_corrections(folder: str | Path, corrections: Iterable[Correction]) -> None:
    """Replace the corrections in a recording's folder; all else in ``recording.toml`` stays as it is, with its remarks.
    `RtofError`: one of them says nothing sensible, then nothing is written; or it cannot be written.
    """
    path = Path(folder) / INDEX
    text = with_corrections(path.read_text(encoding="utf-8"), corrections)
    for table in RecordingTable.of(tomllib.loads(text), path).corrections:
        table.correction()
    inputs, contents = made_from(path.parent), read_contents(path.parent)
    write_text(path, text, overwrite=True)
    if path in contents.own:
        write_manifest(path.parent, contents.kind, inputs, [one for one in contents.own if one.is_file()])


def with_corrections(text: str, corrections: Iterable[Correction]) -> str:
    """Return the text of ``recording.toml`` with these corrections in place of its own."""
    made = [f"\n[[corrections]]\n{tomli_w.dumps(one.plain())}" for one in corrections]
    return "".join([_CORRECTION.sub("", text).rstrip("\n"), "\n", *made])


def body_of(
    skeleton_table: str,
    joint_offsets: Array | None = None,
    bone_lengths: Mapping[str, float] | None = None,
    height: float | None = None,
    mass_kg: float | None = None,
    sex: str | None = None,
) -> SkeletonModel:
    """Return a table's skeleton with a `Recording`'s offsets, or else its height and then its lengths."""
    skeleton = shipped(skeleton_table)
    if joint_offsets is None:
        skeleton = skeleton if height is None else skeleton.with_height(height)
        skeleton = skeleton.with_bone_lengths(bone_lengths) if bone_lengths else skeleton
    elif not np.array_equal(joint_offsets, skeleton.joint_offsets):
        skeleton = known_body(skeleton_table, np.asarray(joint_offsets, dtype=float).tobytes())
    return skeleton.with_mass(mass_kg, sex)


def _check_joints(table: InputTable, field: str, joints: tuple[str, ...]) -> None:
    """Check that the names in a table inside another one are joints other than the root."""
    given: Collection[str] = getattr(table, field)
    if unknown := [name for name in given if name not in joints[1:]]:
        raise UnknownNameError("joint", unknown, joints[1:], table.path, table.where(field))


def _lengths_and_offsets(table: BodyTable) -> dict[str, Any]:
    """Return the fields of `Recording` that describe the skeleton, where they are given."""
    joints = shipped(table.table).names
    for name in ("bone_lengths_m", "joint_offsets_m"):
        _check_joints(table, name, joints)
    found: dict[str, Any] = {"bone_lengths": table.bone_lengths_m} if table.bone_lengths_m else {}
    if offsets := table.joint_offsets_m:
        if missing := [name for name in joints[1:] if name not in offsets]:
            raise FileFormatError(table.path, f"[skeleton.joint_offsets_m] {missing[0]}: missing; add 3 numbers")
        found["joint_offsets"] = np.array([np.zeros(3), *(offsets[name] for name in joints[1:])])
    return found


def _truth_stream(table: TruthTable, skeleton: SkeletonModel, source: Source) -> Stream[PoseSequence]:
    """Open known poses, joints in the skeleton's order."""
    path = data_path(table)
    arrays = source.npz(path, _TRUTH_AXES)
    for name, shape in zip(TRUTH[:3], ("(T)", "(T, J, 3)", "(T, J, 3, 3)"), strict=True):
        needed(path, arrays.shapes, name, shape)
    times = arrays.column("times")
    assert times is not None  # needed

    def part(rows: slice) -> PoseSequence:
        with naming(path):
            return PoseSequence(names=skeleton.names, **arrays.rows(rows))

    return Stream(times, part)
