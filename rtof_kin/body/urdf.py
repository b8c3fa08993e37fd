"""URDF of a skeleton table: writing and reading.

URDF has no spherical joint: each ball joint is three revolutes with light links of small inertia between
them. The root link has no parent; the floating joint is added when the file is loaded.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from rtof_kin.body.skeleton_table import Joint, SkeletonTable, inertia, mass_fraction, read_skeleton_table
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.text import read_text
from rtof_kin.core.packages import optional

pin = optional(
    "pinocchio",
    "",
    "a skeleton",
    "pip install pin (Linux, macOS), or conda install -c conda-forge pinocchio (Windows too)",
)


LIGHT_MASS_KG = 1e-3
LIGHT_INERTIA = 1e-6
MAX_EFFORT_NM, MAX_VELOCITY = 500.0, 30.0
_LARGEST_URDF = 16 * 2**20
_AXIS = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def to_urdf(table: SkeletonTable) -> str:
    """Return the URDF of a skeleton; all link frames are parallel when all angles are zero."""
    robot = ET.Element("robot", name=table.name)
    ET.SubElement(ET.SubElement(robot, "material", name="body"), "color", rgba="0.45 0.6 0.75 1")
    for joint in table.joints:
        parent = joint.parent
        for i, axis in enumerate(joint.axes):
            last = i == len(joint.axes) - 1
            child = joint.name if last else f"{joint.name}_{axis}_link"
            if not last:
                _inertial(ET.SubElement(robot, "link", name=child), LIGHT_MASS_KG)
            assert parent is not None
            origin = joint.offset if i == 0 else np.zeros(3)
            _revolute(robot, joint, i, parent, child, origin)
            parent = child
        link = ET.SubElement(robot, "link", name=joint.name)
        _inertial(link, *segment_inertia(joint, table))
        length = float(np.linalg.norm(joint.end))
        turn = so3.minimal_rotation([0.0, 0.0, 1.0], joint.end)
        pitch = np.arcsin(np.clip(-turn[2, 0], -1, 1))
        rpy = (np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0]))
        body = _visual(link, joint.end / 2, rpy)
        ET.SubElement(body, "cylinder", radius=_number(joint.radius), length=_number(length))
        for point in (np.zeros(3), joint.end):
            ET.SubElement(_visual(link, point), "sphere", radius=_number(joint.radius))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def read_urdf(path: str | Path, table_path: str | Path) -> tuple[SkeletonTable, str]:
    """Read a URDF that was made from a skeleton table. `FileFormatError`: not a URDF, or of another skeleton.

    Returns:
        The table scaled to the bone offsets of the URDF, and the text of the URDF.
    """
    table = read_skeleton_table(table_path)
    text = read_text(path, "a URDF", _LARGEST_URDF)
    with reading(path, "not a readable URDF: {}", ValueError, RuntimeError):
        loaded = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    offsets = np.zeros_like(table.offsets)
    for i, joint in enumerate(table.joints[1:], start=1):
        if not loaded.existJointName(joint.dofs[0].urdf):
            raise FileFormatError(path, f"there is no joint {joint.dofs[0].urdf} in it")
        offsets[i] = loaded.jointPlacements[loaded.getJointId(joint.dofs[0].urdf)].translation
    if not np.allclose(offsets, table.offsets, atol=1e-12):
        table = table.scaled_to(offsets)
    own = pin.buildModelFromXML(to_urdf(table), pin.JointModelFreeFlyer())
    for name in loaded.names[1:]:
        if not _same_joint(name, loaded, own):
            raise FileFormatError(
                path,
                f"the joint {name} has another parent, place or axis than in the skeleton table; "
                "give the table that this URDF was made from",
            )
    return table, text


def _same_joint(name: str, a: Any, b: Any) -> bool:
    """Return whether a joint is the same in two Pinocchio models."""
    if not b.existJointName(name):
        return False
    i, j = a.getJointId(name), b.getJointId(name)
    return bool(
        a.names[a.parents[i]] == b.names[b.parents[j]]
        and a.joints[i].shortname() == b.joints[j].shortname()
        and a.jointPlacements[i].isApprox(b.jointPlacements[j], 1e-9)
    )


def _revolute(robot: ET.Element, joint: Joint, i: int, parent: str, child: str, origin: Array) -> None:
    element = ET.SubElement(robot, "joint", name=joint.dofs[i].urdf, type="revolute")
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=_text(origin), rpy="0 0 0")
    ET.SubElement(element, "axis", xyz=_AXIS[joint.axes[i]])
    low, high = joint.limits[i]
    ET.SubElement(
        element,
        "limit",
        lower=_number(low),
        upper=_number(high),
        effort=_number(MAX_EFFORT_NM),
        velocity=_number(MAX_VELOCITY),
    )


def segment_inertia(joint: Joint, table: SkeletonTable) -> tuple[float, Array, Array]:
    """Return mass, kg, centre of mass (3,), m, and inertia about it (3, 3), kg m^2, in the link frame."""
    masses = [(name, share * mass_fraction(name, table.sex) * table.mass_kg) for name, share in joint.mass_shares]
    total = sum(mass for _, mass in masses)
    parts = [inertia(name, mass, joint.end, table.sex) for name, mass in masses]
    center = np.sum([m * c for (_, m), (c, _) in zip(masses, parts, strict=True)], axis=0) / total
    matrix = np.zeros((3, 3))
    for (_, mass), (c, I) in zip(masses, parts, strict=True):
        d = so3.skew(c - center)
        matrix += I - mass * d @ d  # Steiner
    return total, center, matrix


def _visual(link: ET.Element, xyz: Array, rpy: Iterable[float] = (0, 0, 0)) -> ET.Element:
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_text(xyz), rpy=_text(rpy))
    geometry = ET.SubElement(visual, "geometry")
    ET.SubElement(visual, "material", name="body")
    return geometry


def _inertial(link: ET.Element, mass_kg: float, center: Array | None = None, matrix: Array | None = None) -> None:
    center = np.zeros(3) if center is None else center
    matrix = LIGHT_INERTIA * np.eye(3) if matrix is None else matrix
    element = ET.SubElement(link, "inertial")
    ET.SubElement(element, "origin", xyz=_text(center), rpy="0 0 0")
    ET.SubElement(element, "mass", value=_number(mass_kg))
    upper = [(a, b) for a in range(3) for b in range(a, 3)]
    ET.SubElement(element, "inertia", {f"i{'xyz'[a]}{'xyz'[b]}": _number(matrix[a, b]) for a, b in upper})


def _number(value: float) -> str:
    """Return a number with 12 significant digits, without negative zero."""
    return f"{float(value) + 0.0:.12g}"


def _text(vector: Iterable[float]) -> str:
    return " ".join(_number(value) for value in vector)
