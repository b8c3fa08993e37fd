"""The clinical angles of a skeleton, from ``models/clinical_angles.toml``: names, axes, signs, ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import WORLD

SIDES = ("right", "left")


@dataclass(frozen=True)
class AngleRow:
    """One clinical angle."""

    name: str
    """Name in files, e.g. 'right_knee_flexion'."""
    positive: str
    """The movement that is positive."""
    sign: int
    """Of the angle against the rotation about its axis, in the (mirrored, if left) ISB frames."""
    range: tuple[float, float]
    """Radians, as wide as the angle can be told; whole turns are chosen so that it lies there."""
    opensim: str
    """OpenSim coordinate, a leading '-' for the opposite sign; '' where there is none."""

    @property
    def label(self) -> str:
        """The name for people."""
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class JointCoordinateSystem:
    """Three angles of one rotation: of a child segment in its parent's frame."""

    name: str
    """E.g. 'right_hip'."""
    side: str
    """'right', 'left' or ''."""
    parent: str
    """Joint of the skeleton that carries the parent segment, or `WORLD`."""
    child: str
    """Joint of the skeleton that carries the child segment."""
    sequence: str
    """Intrinsic axes in the ISB frames, e.g. 'zxy'."""
    hinge: bool
    """Whether the first angle is told from the long axes alone where the parent's twist is unseen."""
    singular: str
    """Postures in which the first and the third angle cannot be told apart."""
    source: str
    """Who recommends it."""
    angles: tuple[AngleRow, AngleRow, AngleRow]
    """In the order of the sequence."""
    urdf: tuple[str, ...]
    """Revolutes of the URDF between the two segments; () against the world."""


@dataclass(frozen=True)
class AngleTable:
    """All clinical angles of one skeleton, and which of its joints and landmarks carry what."""

    joints: tuple[JointCoordinateSystem, ...]
    segments: dict[str, str]
    """Anatomical word ('pelvis', 'right shank', 'left heel') -> joint or landmark of the skeleton."""

    @property
    def rows(self) -> tuple[AngleRow, ...]:
        """All angles in order."""
        return tuple(angle for joint in self.joints for angle in joint.angles)

    def sidecar(self) -> list[dict[str, Any]]:
        """The table as plain data, one entry per angle, for the file that goes with the numbers."""
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
    """The table of clinical angles of a skeleton.

    Raises:
        UnknownNameError: the table has no segments for this skeleton.
    """
    data = load_toml(model_path("clinical_angles.toml"))
    if skeleton.name not in data["segments"]:
        raise UnknownNameError(
            "skeleton in the table of clinical angles", [skeleton.name], list(data["segments"])
        )
    segments = _segments(data["segments"][skeleton.name])
    entries = [(entry, side) for entry in data["joint"] for side in (SIDES if entry.get("sides") else ("",))]
    return AngleTable(tuple(_joint(entry, side, segments, skeleton) for entry, side in entries), segments)


def _segments(names: dict[str, str]) -> dict[str, str]:
    out = {WORLD: WORLD}
    for word, name in names.items():
        if "{" not in name:
            out[word] = name
            continue
        for side in SIDES:
            out[f"{side} {word}"] = name.format(S=side.title(), s=side[0].upper())
    return out


def _joint(
    entry: dict[str, Any], side: str, segments: dict[str, str], skeleton: SkeletonTable
) -> JointCoordinateSystem:
    parent, child = (
        segments.get(f"{side} {entry[end]}") or segments[entry[end]] for end in ("parent", "child")
    )
    name = f"{side}_{entry['name']}" if side else entry["name"]
    angles = [
        AngleRow(
            name=f"{name}_{angle['name']}",
            positive=angle["positive"],
            sign=angle["sign"],
            range=(float(np.radians(angle["range_deg"][0])), float(np.radians(angle["range_deg"][1]))),
            opensim=angle["opensim"].format(x=side[:1]),
        )
        for angle in entry["angle"]
    ]
    return JointCoordinateSystem(
        name=name, side=side, parent=parent, child=child, sequence=entry["sequence"],
        hinge=entry.get("hinge", False), singular=entry["singular"], source=entry["source"],
        angles=(angles[0], angles[1], angles[2]), urdf=_revolutes(skeleton, parent, child),
    )  # fmt: skip


def _revolutes(skeleton: SkeletonTable, parent: str, child: str) -> tuple[str, ...]:
    """URDF names of the revolutes on the way from one segment to another below it."""
    if parent == WORLD:
        return ()
    chain, at = [], skeleton.names.index(child)
    while skeleton.names[at] != parent:
        chain.append(skeleton.joints[at])
        at = skeleton.parents[at]
    return tuple(dof.urdf for joint in reversed(chain) for dof in joint.dofs)
