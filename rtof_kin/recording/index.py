"""``recording.toml``, the index of a recording's folder: its fields and, by a `Source`, its streams.

The format is described in docs/recording.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from rtof_kin.body.neutral_posture import NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel, known_body
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.section import Section
from rtof_kin.recording import files
from rtof_kin.recording.camera_motion_files import filmed_stream
from rtof_kin.recording.schema import check_index
from rtof_kin.recording.sensor_files import imu_stream
from rtof_kin.recording.session import read_session
from rtof_kin.recording.sources import Source
from rtof_kin.recording.streams import Streams
from rtof_kin.recording.views import view_streams

INDEX: Final = "recording.toml"
UNFINISHED: Final = PurePath("live", "setup")
"""Folder that a live session makes first."""
SCHEMA_VERSION: Final = 1
SKELETONS: Final = ("total_capture", "human36m")
"""Tables of skeletons that a recording may name."""
shipped = cache(SkeletonModel.named)
"""Skeleton of a table."""


def index_of(folder: Path) -> Section:
    """Return the top level of a recording's ``recording.toml``.

    Raises:
        FileFormatError: it does not exist or is not TOML.
    """
    path = folder / INDEX
    if folder.is_dir() and not path.exists():
        if (folder / UNFINISHED / INDEX).is_file():
            finish = f"rtof-kin live --finish {folder}"
            raise FileFormatError(folder, f"a live session that was not finished; {finish} makes a recording of it")
        raise FileFormatError(
            path, "there is no such file; rtof-kin run --only recording makes a recording of a video and sensors' files"
        )
    return Section.of_file(path)


def read_index(index: Section, source: Source) -> tuple[dict[str, Any], Streams]:
    """Read the fields of a `Recording`, and open its streams.

    Args:
        index: top level of ``recording.toml``.

    Raises:
        FileFormatError, UnknownNameError, UnitError: the message names file, field and remedy.
    """
    version = index.integer("schema_version")
    if version != SCHEMA_VERSION:
        raise index.error(
            "schema_version",
            f"{version} is not {SCHEMA_VERSION}, which this version of the "
            "package reads; use the version that wrote it, or a newer one",
        )
    check_index(index)
    subject, skeleton, scene, notes = (index.table(n) for n in ("subject", "skeleton", "scene", "notes"))
    fields: dict[str, Any] = {
        "name": index.text("name", index.path.absolute().parent.name),
        "first_frame": index.integer("first_frame", 0),
        "height": subject.optional_number("height_m"),
        "mass_kg": subject.optional_number("mass_kg"),
        "sex": subject.optional_text("sex"),
        "floor_height": scene.optional_number("floor_height_m"),
        "acknowledgement": notes.text("acknowledgement", ""),
        "notes": notes.text("text", ""),
        "session": read_session(index.table("session")),
        **_read_skeleton(skeleton),
    }
    table = shipped(fields["skeleton_table"])
    keypoints, imus, truth = None, None, None
    if index.has("camera") or index.has("keypoints") or not index.has("imus"):
        filmed, note = filmed_stream(index.table("camera"), index.table("keypoints"), table, source)
        keypoints = source.checked(filmed)
        fields["notes"] = "\n".join(filter(None, (fields["notes"], note)))
    views = tuple(source.checked(view) for view in view_streams(index.tables("views"), table, source))
    facts = ("skeleton_table", "joint_offsets", "bone_lengths", "height", "mass_kg", "sex")
    body = body_of(**{name: fields[name] for name in facts if name in fields})
    if index.has("imus"):
        sensors, fields["calibration"] = imu_stream(index.table("imus"), body, source)
        imus = None if sensors is None else source.checked(sensors)
    if index.has("posture"):
        fields["posture"] = _read_posture(index.table("posture"), body.names)
    if index.has("truth"):
        truth = source.checked(files.truth_stream(index.table("truth"), body, source))
    for section in (index, subject, skeleton, scene, notes):
        section.close()
    return fields, Streams(keypoints, views, imus, truth)


def body_of(
    skeleton_table: str,
    joint_offsets: Array | None = None,
    bone_lengths: Mapping[str, float] | None = None,
    height: float | None = None,
    mass_kg: float | None = None,
    sex: str | None = None,
) -> SkeletonModel:
    """Return a table's skeleton with these offsets, or else this height and then these lengths.

    Args:
        skeleton_table, joint_offsets, bone_lengths, height, mass_kg, sex: fields of `Recording`.
    """
    skeleton = shipped(skeleton_table)
    if joint_offsets is None:
        skeleton = skeleton if height is None else skeleton.with_height(height)
        skeleton = skeleton.with_bone_lengths(bone_lengths) if bone_lengths else skeleton
    elif not np.array_equal(joint_offsets, skeleton.joint_offsets):
        skeleton = known_body(skeleton_table, np.asarray(joint_offsets, dtype=float).tobytes())
    return skeleton.with_mass(mass_kg, sex)


def _read_posture(section: Section, joints: tuple[str, ...]) -> NeutralPosture:
    """Read the quaternions of ``[posture.quat_wxyz]`` by joint."""
    quats = section.table("quat_wxyz")
    named = tuple(quats.keys())
    unknown = [name for name in named if name not in joints[1:]]
    if unknown:
        raise UnknownNameError("joint", unknown, joints[1:], section.path, section.where("quat_wxyz"))
    section.close()
    return NeutralPosture(named, np.array([quats.array(name, (4,)) for name in named]).reshape(-1, 4))


def _read_skeleton(section: Section) -> dict[str, Any]:
    """Read the fields of `Recording` that describe the skeleton."""
    table = section.text("table", "total_capture")
    if table not in SKELETONS:
        raise UnknownNameError("skeleton", [table], SKELETONS, section.path, section.where("table"))
    joints = shipped(table).names
    fields: dict[str, Any] = {"skeleton_table": table}
    for name in ("bone_lengths_m", "joint_offsets_m"):
        unknown = [n for n in section.table(name).keys() if n not in joints[1:]]  # noqa: SIM118
        if unknown:
            raise UnknownNameError("joint", unknown, joints[1:], section.path, section.where(name))
    lengths, offsets = section.table("bone_lengths_m"), section.table("joint_offsets_m")
    if len(lengths):
        fields["bone_lengths"] = {name: lengths.number(name) for name in lengths.keys()}  # noqa: SIM118
    if len(offsets):
        given = [offsets.array(name, (3,)) for name in joints[1:]]
        fields["joint_offsets"] = np.array([np.zeros(3), *given])
    return fields
