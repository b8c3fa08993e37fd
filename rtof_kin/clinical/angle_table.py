"""The clinical angles of a skeleton, from ``models/clinical_angles.toml``: names, axes, signs, ranges."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import WORLD
from rtof_kin.formats.joint_trajectory import BASE_TURN

SIDES: Final = ("right", "left")
_VERTICAL: Final = "y"  # axis of the ISB frames that points up


def clinical_name(skeleton: SkeletonTable, dof: str) -> str:
    """Return a degree of freedom in words, e.g. 'left hip internal/external rotation (LeftUpLeg_z)'. dof: its URDF
    name, or `BASE_TURN` for the orientation of the root. Other names are unchanged.
    """
    if dof == BASE_TURN:
        return f"pelvis orientation ({dof})"
    names = {own.urdf: own.clinical.lstrip("-") for joint in skeleton.joints for own in joint.dofs}
    if not (name := names.get(dof)):
        return dof
    for both in _file()["movements"]:
        positive = re.sub(r"/\w+", "", both)
        if name.endswith(positive):
            return f"{name.removesuffix(positive)}{both} ({dof})"
    return f"{name} ({dof})"


@dataclass(frozen=True)
class AngleRow:
    """One clinical angle."""

    name: str  #: Name in files, e.g. 'right_knee_flexion'.
    positive: str  #: The movement that is positive
    sign: int  #: Sign relative to the rotation about its axis, in the (mirrored, if left) ISB frames
    range: tuple[float, float]  #: [rad] interval into which whole turns are wrapped
    opensim: str  #: OpenSim coordinate, a leading '-' for the opposite sign; '' if there is none
    about_vertical: bool = False
    """Whether it is a heading, the angle of a segment about the vertical of world: no range of motion."""
    segments: tuple[str, ...] = ()
    """Joints of the skeleton that carry its two segments; of an angle against the world the child's alone."""

    @property
    def label(self) -> str:
        """The name with spaces."""
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class JointCoordinateSystem:
    """Three angles of the rotation of a child segment in its parent's frame."""

    name: str  #: E.g. 'right_hip'.
    side: str  #: 'right', 'left' or ''
    parent: str  #: Joint of the skeleton that carries the parent segment, or `WORLD`
    child: str  #: Joint of the skeleton that carries the child segment
    sequence: str  #: Intrinsic axes in the ISB frames, e.g. 'zxy'.
    hinge: bool  #: Whether the first angle is taken between the long axes if the parent's axial rotation is unobserved
    singular: str  #: Postures in which only the sum of the first and the third angle is defined
    source: str  #: Publication that recommends it
    angles: tuple[AngleRow, AngleRow, AngleRow]  #: In the order of the sequence
    urdf: tuple[str, ...]  #: Revolutes of the URDF between the two segments; () against the world


@dataclass(frozen=True)
class AngleTable:
    """All clinical angles of one skeleton."""

    joints: tuple[JointCoordinateSystem, ...]
    segments: dict[str, str]
    """Anatomical term ('pelvis', 'right shank', 'left heel') -> joint or landmark of the skeleton."""

    @property
    def rows(self) -> tuple[AngleRow, ...]:
        """All angles in order."""
        return tuple(angle for joint in self.joints for angle in joint.angles)

    def sidecar(self) -> list[dict[str, Any]]:
        """Return the table as plain data, one entry per angle."""
        return [
            {
                "name": angle.name,
                "clinical": angle.label,
                "positive": angle.positive,
                "zero": "anatomical standing posture: upright, arms hanging, palms forward",
                "parent": joint.parent,
                "child": joint.child,
                "sequence": joint.sequence.upper(),
                "axis": f"{joint.sequence[k]}, number {k + 1} of the sequence",
                "sign": angle.sign,
                "mirrored": joint.side == "left",
                "range_deg": np.degrees(angle.range).round(6).tolist(),
                "singular": joint.singular,
                "opensim": angle.opensim,
                "urdf": list(joint.urdf),
                "source": joint.source,
            }
            for joint in self.joints
            for k, angle in enumerate(joint.angles)
        ]


def angle_table(skeleton: SkeletonTable) -> AngleTable:
    """Return the table of clinical angles of a skeleton. `UnknownNameError`: the skeleton is not in that file.

    Args:
        skeleton: one of those in ``models/clinical_angles.toml``.
    """
    return _table(skeleton, "joint")


def foot_table(skeleton: SkeletonTable) -> AngleTable:
    """Return the table of the angles of both feet in world, for foot progression, as `angle_table` does."""
    return _table(skeleton, "foot")


@cache
def _file() -> dict[str, Any]:
    return load_toml(model_path("clinical_angles.toml"))


def _table(skeleton: SkeletonTable, entries_of: str) -> AngleTable:
    """Table of one list of entries of the file."""
    data = _file()
    known = data["segments"]
    if skeleton.name not in known:
        raise UnknownNameError("skeleton in the table of clinical angles", [skeleton.name], list(known))
    segments = {WORLD: WORLD}
    for term, name in known[skeleton.name].items():
        for side in SIDES if "{" in name else ("",):
            segments[f"{side} {term}".strip()] = name.format(S=side.title(), s=side[:1].upper())
    entries = [(entry, side) for entry in data[entries_of] for side in (SIDES if entry.get("sides") else ("",))]
    return AngleTable(tuple(_joint(entry, side, segments, skeleton) for entry, side in entries), segments)


def _joint(
    entry: dict[str, Any], side: str, segments: dict[str, str], skeleton: SkeletonTable
) -> JointCoordinateSystem:
    parent, child = (segments.get(f"{side} {entry[end]}") or segments[entry[end]] for end in ("parent", "child"))
    name = f"{side}_{entry['name']}" if side else entry["name"]
    first, second, third = (
        AngleRow(
            name=f"{name}_{angle['name']}",
            positive=angle["positive"],
            sign=angle["sign"],
            range=(float(np.radians(angle["range_deg"][0])), float(np.radians(angle["range_deg"][1]))),
            opensim=angle["opensim"].format(x=side[:1]),
            about_vertical=parent == WORLD and axis == _VERTICAL,
            segments=(child,) if parent == WORLD else (parent, child),
        )
        for angle, axis in zip(entry["angle"], entry["sequence"], strict=True)
    )
    return JointCoordinateSystem(
        name=name,
        side=side,
        parent=parent,
        child=child,
        sequence=entry["sequence"],
        hinge=entry.get("hinge", False),
        singular=entry["singular"],
        source=entry["source"],
        angles=(first, second, third),
        urdf=_revolutes(skeleton, parent, child),
    )


def _revolutes(skeleton: SkeletonTable, parent: str, child: str) -> tuple[str, ...]:
    """URDF names of the revolutes between a segment and another below it."""
    if parent == WORLD:
        return ()
    chain, at = [], skeleton.names.index(child)
    while skeleton.names[at] != parent:
        chain.append(skeleton.joints[at])
        at = skeleton.parents[at]
    return tuple(dof.urdf for joint in reversed(chain) for dof in joint.dofs)
