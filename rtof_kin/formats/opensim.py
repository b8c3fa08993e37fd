"""OpenSim 4: the skeleton as a model (``.osim``), motions (``.mot``, states in ``.sto``), and a reader of both tables.

Bodies are the URDF's segments, with the same link frames and masses, without the light links between revolutes: a
joint's three revolutes are one CustomJoint about the same axes in the same order. A marker stands at each landmark,
under its name in the .trc. The joint of the root takes the world (z up) to OpenSim's ground (y up).

The skeleton table has OpenSim's names. With a leading minus, as in ``-hip_flexion_r``, a coordinate turns
about the opposite of the revolute's axis, so that its values have OpenSim's sign; a revolute without a name
in OpenSim keeps the URDF's. Every angle is zero in the T-pose. The root has OpenSim's pelvis_tilt, _list,
_rotation, _tx, _ty and _tz: rotations about z, x, y and translations along x, y, z of its ground, y up.

Both files are tables for the .osim of the same skeleton: a header that ends with ``endheader``, then tab-separated
columns, the first one time in s. OpenSim needs even times and takes a NaN for the end of the file, so a motion with
gaps becomes several files. A ``.mot`` lacks the coordinates that were never observed, for which OpenSim's tools take
the model's zero; a ``.sto`` must have all states, so its header names them.

``.mot`` and ``.sto`` of any model are read: lines of ``key=value`` up to ``endheader``, then a line of column names,
the first one ``time`` in s, and a row of numbers for each frame, separated by tabs or blanks. ``inDegrees`` in the
header is the unit of all rotations; translations are in m. States ``/jointset/JOINT/NAME/value`` are read as
``NAME``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from rtof_kin.body.motion_source import Block, MotionSource
from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Joint, SkeletonTable
from rtof_kin.body.urdf import segment_inertia
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, freeze
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import numbers_of, read_text, write_text
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.formats.joint_trajectory import BASE_TURN
from rtof_kin.formats.motion_views import AnyMotion, check_known, even_times, shares_from_prior
from rtof_kin.formats.world_axes import R_WORLD_GROUND

SUFFIXES: Final = (".mot", ".sto")
_END: Final = "endheader"
_STATE: Final = re.compile(r"(?:.*/)?([^/]+)/value")
_OWN: Final = re.compile(r"^Coordinates of the \.osim of the skeleton (\w+), zero in the T-pose", re.MULTILINE)
"""Line in the header of this package's tables."""


@dataclass(frozen=True)
class OpenSimTable:
    """Coordinates of a model over time."""

    times: Array  #: (T,) seconds, strictly increasing
    names: tuple[str, ...]  #: C coordinates, e.g. 'knee_angle_r'.
    values: Array  #: (T, C) as in the file: rotations in degrees or rad, translations in m; NaN where missing
    in_degrees: bool  #: Whether rotations are in degrees
    skeleton: str = ""  #: Skeleton of this package whose .osim the coordinates belong to; '' for another model

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times("coordinate times", self.times))
        object.__setattr__(self, "names", checked_names("OpenSim coordinates", self.names))
        freeze(self, "coordinate", values=(len(self.times), len(self.names)))

    def rotation(self, name: str) -> Array | None:
        """Return one rotation (T,) in rad; None if there is no such column."""
        if name not in self.names:
            return None
        column = np.array(self.values[:, self.names.index(name)])
        return np.radians(column) if self.in_degrees else column


def read_opensim_table(path: str | Path) -> OpenSimTable:
    """Read coordinates of a ``.mot`` or ``.sto``; `FileFormatError`: no such file, not such a table, or without the
    unit of its rotations.
    """
    path = Path(path)
    lines = read_text(path, f"an OpenSim table, whose header ends with {_END}").splitlines()
    end = next((n for n, line in enumerate(lines) if line.strip().lower() == _END), None)
    if end is None or end + 1 >= len(lines):
        raise FileFormatError(path, f"no {_END} with column names after it, so not an OpenSim table")
    labels = _cells(lines[end + 1])
    if not labels or labels[0].lower() != "time" or len(labels) < 2:
        raise FileFormatError(path, "the first column must be time, and others must follow", end + 2)
    first = end + 2
    rows = [(n, line) for n, line in enumerate(lines[first:], first + 1) if line.strip()]
    if not rows:
        raise FileFormatError(path, "has column names and no row", first)
    table = np.array([numbers_of(path, n, _cells(line), len(labels), gaps=True) for n, line in rows])
    states = {i: found[1] for i, label in enumerate(labels) if (found := _STATE.fullmatch(label))}
    chosen = states or dict(enumerate(labels[1:], 1))
    header = "\n".join(lines[:end])
    unit = re.search(r"^[ \t]*indegrees[ \t]*=[ \t]*(yes|no)[ \t]*$", header, re.IGNORECASE | re.MULTILINE)
    if unit is None:
        raise FileFormatError(
            path, "the header does not state the unit of rotations: add a line inDegrees=yes or inDegrees=no"
        )
    own = _OWN.search(header)
    with reading(path):
        return OpenSimTable(
            table[:, 0], tuple(chosen.values()), table[:, list(chosen)], unit[1].lower() == "yes", own[1] if own else ""
        )


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in (line.rstrip("\r\n").split("\t") if "\t" in line else line.split())]


_VERSION: Final = "40000"  #: Version of the format; every OpenSim 4 reads it
_CREDITS: Final = (
    "Bodies have the link frames of the URDF: x forward, y left, z up in the T-pose, where every "
    "coordinate is zero. Masses: de Leva (1996). Ground: x forward, y up, z right. A coordinate with "
    "a name of OpenSim has its sign; one called JOINT_AXIS is the URDF's revolute."
)


def write_osim(path: str | Path, skeleton: SkeletonModel, *, overwrite: bool = False) -> None:
    """Write a skeleton as an OpenSim model; errors as `core.files.folder.new_file`."""
    write_text(Path(path), to_osim(skeleton), overwrite)


def to_osim(skeleton: SkeletonModel) -> str:
    """Return the OpenSim model of a skeleton, XML; its angles are `coordinates`."""
    table = skeleton.table
    document = ET.Element("OpenSimDocument", Version=_VERSION)
    model = ET.SubElement(document, "Model", name=table.name)
    _leaf(model, "credits", _CREDITS)
    _leaf(model, "gravity", _text([0, -STANDARD_GRAVITY, 0]))
    _leaf(model, "length_units", "meters")
    _leaf(model, "force_units", "N")
    bodies, joints, markers = (
        ET.SubElement(ET.SubElement(model, kind, name=kind.lower()), "objects")
        for kind in ("BodySet", "JointSet", "MarkerSet")
    )
    every = coordinates(table)
    for joint in table.joints:
        _body(bodies, joint, table)
        _custom_joint(joints, joint, [c for c in every if c.joint == joint.name])
    for name, (joint_name, offset) in skeleton.landmarks.items():
        marker = ET.SubElement(markers, "Marker", name=name)
        _leaf(marker, "socket_parent_frame", f"/bodyset/{joint_name}")
        _leaf(marker, "location", _text(offset))
    ET.indent(document)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(document, encoding="unicode") + "\n"


def _body(bodies: ET.Element, joint: Joint, table: SkeletonTable) -> None:
    """Add a body with its inertia and, for display, a cylinder along its segment."""
    mass_kg, center, matrix = segment_inertia(joint, table)
    body = ET.SubElement(bodies, "Body", name=joint.name)
    along = so3.minimal_rotation([0.0, 1.0, 0.0], joint.end)  # OpenSim's cylinders lie along y
    shape = _frame(ET.SubElement(body, "components"), "shape", "..", joint.end / 2, along)
    cylinder = ET.SubElement(ET.SubElement(shape, "attached_geometry"), "Cylinder", name="segment")
    _leaf(cylinder, "radius", _text([joint.radius]))
    _leaf(cylinder, "half_height", _text([float(np.linalg.norm(joint.end)) / 2]))
    _leaf(body, "mass", _text([mass_kg]))
    _leaf(body, "mass_center", _text(center))
    _leaf(body, "inertia", _text([*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]]))


def _custom_joint(joints: ET.Element, joint: Joint, moved_by: list[Coordinate]) -> None:
    element = ET.SubElement(joints, "CustomJoint", name=joint.name)
    place = "world" if joint.parent is None else "place"
    _leaf(element, "socket_parent_frame", place)
    _leaf(element, "socket_child_frame", f"/bodyset/{joint.name}")
    listed = ET.SubElement(element, "coordinates")
    for coordinate in moved_by:
        entry = ET.SubElement(listed, "Coordinate", name=coordinate.name)
        _leaf(entry, "range", _text(coordinate.range))
    frames = ET.SubElement(element, "frames")
    if joint.parent is None:
        _frame(frames, place, "/ground", np.zeros(3), R_WORLD_GROUND.T)
    else:
        _frame(frames, place, f"/bodyset/{joint.parent}", joint.offset, np.eye(3))
    transform = ET.SubElement(element, "SpatialTransform")
    for kind in ("rotation", "translation"):
        own = [c for c in moved_by if c.is_rotation == (kind == "rotation")]
        for i in range(3):
            axis = ET.SubElement(transform, "TransformAxis", name=f"{kind}{i + 1}")
            _leaf(axis, "coordinates", own[i].name if own else "")
            _leaf(axis, "axis", _text(own[i].axis if own else np.eye(3)[i]))
            function = ET.SubElement(axis, "LinearFunction" if own else "Constant", name="function")
            _leaf(function, "coefficients" if own else "value", "1 0" if own else "0")


def _frame(into: ET.Element, name: str, parent: str, p: Array, R_parent_frame: Array) -> ET.Element:
    """Add a frame fixed in another; OpenSim's orientation is rotations about its own x, y and z, rad."""
    frame = ET.SubElement(into, "PhysicalOffsetFrame", name=name)
    _leaf(frame, "socket_parent", parent)
    _leaf(frame, "translation", _text(p))
    _leaf(frame, "orientation", _text(so3.matrix_to_euler("xyz", R_parent_frame)))
    return frame


def _leaf(into: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(into, tag).text = text


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number) + 0.0) for number in numbers)


ROOT_AXES: Final = "yxz"  #: Rotation axes of the root in world: z, x and y of OpenSim's ground, the first one reversed
_ROOT_ROTATIONS: Final = ("-pelvis_tilt", "pelvis_list", "pelvis_rotation")
_ROOT_TRANSLATIONS: Final = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
_ROOT_RANGE_M: Final = 10.0


@dataclass(frozen=True)
class Coordinate:
    """One degree of freedom of an .osim."""

    name: str
    joint: str  #: The joint of the skeleton that it moves
    axis: Array  #: (3,) axis of rotation or translation, in the joint's axes with all angles zero
    is_rotation: bool
    range: tuple[float, float]  #: Radians or metres
    urdf: str = ""  #: Its URDF name; `BASE_TURN` for the root's rotations, empty for its translations

    @property
    def sign(self) -> float:
        """-1 where the axis is the opposite of a link frame's, else 1."""
        return float(np.sign(self.axis.sum()))


def coordinates(table: SkeletonTable) -> tuple[Coordinate, ...]:
    """Return all coordinates: three rotations and three translations of the root, then three rotations of each joint in
    the order of its axes; `InvalidInputError` where two would have one name.
    """
    root = table.names[0]
    out = [
        _rotation(root, axis, name, BASE_TURN, (-np.pi, np.pi))
        for axis, name in zip(ROOT_AXES, _ROOT_ROTATIONS, strict=True)
    ]
    for name, axis in zip(_ROOT_TRANSLATIONS, R_WORLD_GROUND.T, strict=True):
        out.append(Coordinate(name, root, axis, False, (-_ROOT_RANGE_M, _ROOT_RANGE_M)))
    for joint in table.joints[1:]:
        for axis, dof, (low, high) in zip(joint.axes, joint.dofs, joint.limits, strict=True):
            out.append(_rotation(joint.name, axis, dof.opensim, dof.urdf, (low, high)))
    checked_names("OpenSim coordinates", [c.name for c in out])
    return tuple(out)


def _rotation(joint: str, axis: str, opensim: str, urdf: str, limits: tuple[float, float]) -> Coordinate:
    low, high = map(float, limits)
    unit = np.eye(3)["xyz".index(axis)]
    if opensim.startswith("-"):
        return Coordinate(opensim[1:], joint, -unit, True, (-high, -low), urdf)
    return Coordinate(opensim or urdf, joint, unit, True, (low, high), urdf)


def value_blocks(motion: MotionSource) -> Iterator[tuple[Block, Array]]:
    """Yield the motion in blocks with a margin of one frame, and the values of `coordinates` of both (n, C), rad and m,
    continuous over time; `InvalidInputError` where a configuration is unknown.
    """
    check_known(motion)
    skeleton, last = motion.skeleton, np.zeros((0, 3))
    signs = [c.sign for c in coordinates(skeleton.table)]
    index = [skeleton.dof_names.index(d.urdf) for j in skeleton.table.joints for d in j.dofs]
    for block in motion.blocks(margin=1):
        turns = so3.matrix_to_euler(ROOT_AXES, block.motion.poses.R_world_bone[block.before :, 0])
        turns = so3.euler_continuous(np.concatenate([last, turns]))  # goes on from the block before
        last = turns[block.own][-1:]
        q = block.motion.q
        unsigned = [turns, q[:, :3] @ np.abs(R_WORLD_GROUND), q[:, 7:][:, index]]
        yield block, np.concatenate(unsigned, axis=1) * signs


# --- files ---------------------------------------------------------------------------------------


def write_mot(path: str | Path, motion: AnyMotion, *, overwrite: bool = False) -> None:
    """Write coordinates, angles in degrees, without those that were never observed. `InvalidInputError` where a frame
    is unknown, or times are uneven; else errors as `core.files.folder.new_file`.
    """
    source = MotionSource.of(motion)
    every, unseen = coordinates(source.skeleton.table), never_observed(source.masks)
    unit = [180 / np.pi if c.is_rotation else 1.0 for c in every]
    kept = [i for i, c in enumerate(every) if c.urdf not in unseen]
    names = [every[i].name for i in kept]
    values = ((values * unit)[block.own][:, kept] for block, values in value_blocks(source))
    _write_table(Path(path), source, names, values, True, overwrite)


def write_sto(path: str | Path, motion: AnyMotion, *, overwrite: bool = False) -> None:
    """Write states under their paths in the model: values, rad and m, and speeds, rad/s and m/s, by central differences
    (0 for a single frame); errors as `write_mot`.
    """
    source = MotionSource.of(motion)
    every = coordinates(source.skeleton.table)
    names = [f"/jointset/{c.joint}/{c.name}/{kind}" for kind in ("value", "speed") for c in every]
    _write_table(Path(path), source, names, _states(source), False, overwrite)


def _states(motion: MotionSource) -> Iterator[Array]:
    """Values and speeds (n, 2 C) in blocks."""
    times = even_times(motion.times)
    for block, values in value_blocks(motion):
        first = block.start - block.before
        speeds = np.zeros_like(values)
        if len(values) > 1:
            speeds = np.gradient(values, times[first : first + len(values)], axis=0)
        yield np.hstack([values, speeds])[block.own]


def _write_table(
    path: Path, motion: MotionSource, names: list[str], blocks: Iterable[Array], in_degrees: bool, overwrite: bool
) -> None:
    header = [
        path.stem,
        "version=1",
        f"nRows={len(motion)}",
        f"nColumns={1 + len(names)}",
        f"inDegrees={'yes' if in_degrees else 'no'}",
        f"Coordinates of the .osim of the skeleton {motion.skeleton.name}, zero in the T-pose; y is up.",
        f"Units are S.I. units, angles in {'degrees' if in_degrees else 'radians'}.",
        *_unseen(motion),
        "endheader",
        "\t".join(["time", *names]),
    ]
    times, first = even_times(motion.times), 0
    with new_file(path, overwrite) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(f"{line}\n" for line in header)
        for values in blocks:
            table = np.column_stack([times[first : first + len(values)], values])
            stream.writelines("\t".join(map(repr, row)) + "\n" for row in table.tolist())
            first += len(values)


def _unseen(motion: MotionSource) -> list[str]:
    """Return a line each on unobserved joints and coordinates, if any."""
    found = shares_from_prior(motion)
    dofs = found["dofs_from_prior"]
    unseen = {c.name: dofs[c.urdf] for c in coordinates(motion.skeleton.table) if c.urdf in dofs}
    return [
        f"Unobserved {what} and the share of the frames: "
        + ", ".join(f"{name} {100 * share:.3g} %" for name, share in shares.items())
        + "."
        for what, shares in (("joints", found["from_prior"]), ("coordinates", unseen))
        if shares
    ]
