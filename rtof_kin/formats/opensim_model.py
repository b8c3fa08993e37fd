"""``.osim``: the skeleton as a model for OpenSim 4, for its motions, markers and inverse dynamics.

Bodies are the URDF's segments, with the same link frames and masses, without the light links between revolutes: a
joint's three revolutes are one CustomJoint about the same axes in the same order. A marker stands at each landmark,
under its name in the .trc. The joint of the root takes the world (z up) to OpenSim's ground (y up).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import Joint, SkeletonTable
from rtof_kin.body.urdf import segment_inertia
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.text import write_text
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.formats.opensim_mot import Coordinate, coordinates
from rtof_kin.formats.world_axes import R_WORLD_GROUND

_VERSION: Final = "40000"
"""Version of the format; every OpenSim 4 reads it."""
_CREDITS: Final = (
    "Bodies have the link frames of the URDF: x forward, y left, z up in the T-pose, where every "
    "coordinate is zero. Masses: de Leva (1996). Ground: x forward, y up, z right. A coordinate with "
    "a name of OpenSim has its sign; one called JOINT_AXIS is the URDF's revolute."
)


def write_osim(path: str | Path, skeleton: SkeletonModel, *, overwrite: bool = False) -> None:
    """Write a skeleton as an OpenSim model.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. RtofError: it cannot be written.
    """
    write_text(Path(path), to_osim(skeleton), overwrite)


def to_osim(skeleton: SkeletonModel) -> str:
    """Return the OpenSim model of a skeleton, XML; its angles are `opensim_mot.coordinates`."""
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
