"""Known skeletons of motion capture and the mapping of their joints to the package's.

The data are in ``mocap_families.toml``, whose head explains the fields.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.resources import model_path
from rtof_kin.formats.articulated import ArticulatedMotion

Between = tuple[str, str, float]  #: Two source joints and the share of the way from the first to the second

TABLE = Path(__file__).with_name("mocap_families.toml")
_SKELETON = read_skeleton_table(model_path("skeleton.toml"))
NAMES = _SKELETON.names  #: Joints that a clip has
PARENTS = _SKELETON.parents  #: Index of the parent of each joint; -1 for the root

UNITS_M: Final = (1.0, 0.01, 0.0254, 0.0254 / 0.45)
"""Length units of such files, m: metre, centimetre, inch, CMU's own."""
_PLAUSIBLE_LEG: Final = (0.6, 1.1)
"""Length of thigh and shank together, m. The ratio is smaller than that of any two units."""


@dataclass(frozen=True)
class Family:
    """Mapping of the joints of one kind of skeleton to the package's; see the table."""

    name: str  #: Its name in the table
    recognise: frozenset[str]  #: Source joints that identify the family
    at: tuple[Between, ...]  #: Position of each of `NAMES` in the source
    turns: tuple[Between, ...]  #: Rotation of each of `NAMES` in the source
    aim: tuple[float, ...]  #: Share of the final turn of each of `NAMES` towards its child
    restore: dict[str, tuple[str, float]]
    """Source joints without an offset, each with the joint whose offset it gets and a factor."""
    t_pose_deg: dict[str, tuple[float, float, float]]
    """Orientation of source joints in the T-pose, about x left, y up, z forward."""
    feet_go_with_shanks: bool  #: Whether the rest pose spreads the feet along with the legs
    lead_in: int  #: Number of artificial frames at the start


@cache
def families() -> tuple[Family, ...]:
    """Read the table of known skeletons."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return tuple(_family(name, row, table) for name, row in table.items())


def _family(name: str, row: dict[str, Any], table: dict[str, Any]) -> Family:
    row = {**table[row["like"]], **row} if "like" in row else row
    rename = row.get("rename", {})

    def source(joint: str) -> str:
        return str(rename.get(joint, joint))

    def between(entry: str | list[Any]) -> Between:
        start, stop, share = (entry, entry, 0.0) if isinstance(entry, str) else entry
        return source(start), source(stop), float(share)

    at = [row["at"].get(joint, joint) for joint in NAMES]
    turns = [row["turns"].get(joint, begins) for joint, begins in zip(NAMES, at, strict=True)]
    restore, t_pose_deg = row.get("restore", {}), row.get("t_pose_deg", {})
    aim = row.get("aim", {})
    return Family(
        name=name,
        recognise=frozenset(row["recognise"]),
        at=tuple(map(between, at)),
        turns=tuple(map(between, turns)),
        aim=tuple(aim.get(joint, 1.0) for joint in NAMES),
        restore={source(joint): (source(of), factor) for joint, (of, factor) in restore.items()},
        t_pose_deg={source(joint): tuple(angles) for joint, angles in t_pose_deg.items()},
        feet_go_with_shanks=row["feet"] == "shank",
        lead_in=row["lead_in"],
    )


def recognise_family(path: str | Path, motion: ArticulatedMotion) -> Family:
    """Return the family of a skeleton; `FileFormatError` where it is unknown, or lacks a joint of its family."""
    family = _candidate(motion)
    if family is None:
        raise FileFormatError(
            path,
            f"unknown skeleton ({', '.join(motion.names[:8])}, ...); known families: "
            f"{', '.join(family.name for family in families())}; give its joints the names of one of "
            f"them (names=...), or add it to {TABLE.name}",
        )
    need = {joint for entry in (*family.at, *family.turns) for joint in entry[:2]}
    lacking = sorted(need - set(motion.names))
    if lacking:
        raise FileFormatError(path, f"a skeleton of family {family.name} without {', '.join(lacking)}")
    return family


def _candidate(motion: ArticulatedMotion) -> Family | None:
    return next((f for f in families() if f.recognise <= set(motion.names)), None)


def without_character(motion: ArticulatedMotion) -> ArticulatedMotion:
    """Remove the character's name before the joints' names, up to a ':', '_' or '|', if a family is known
    without it only.
    """
    root = motion.names[0]
    ends = (i + 1 for i, letter in enumerate(root) if letter in ":_|")
    shared = (end for end in ends if all(name.startswith(root[:end]) for name in motion.names))
    length = max(shared, default=0)
    bare = motion.renamed({name: name[length:] or name for name in motion.names})
    return bare if _candidate(motion) is None and _candidate(bare) is not None else motion


def lead_in(motion: ArticulatedMotion, family: Family) -> int:
    """Return the number of artificial frames at the start: those of the family, and rest poses after them."""
    if not family.lead_in:
        return 0
    at_rest = np.abs(motion.R_parent_joint - np.eye(3)).max(axis=(1, 2, 3)) < 1e-9
    at_rest[: family.lead_in] = True
    return min(int(np.argmin(np.append(at_rest, False))), len(motion) - 1)


def restored_offsets(motion: ArticulatedMotion, family: Family) -> Array:
    """Return the offsets (J, 3) in file units, with those restored that a converter lost."""
    moving = motion.p_parent_joint
    given = motion.offsets if moving is None else np.median(moving, axis=0)
    offsets = np.array(given)
    for joint, (of, factor) in family.restore.items():
        if not np.any(given[motion.index(joint)]):
            offsets[motion.index(joint)] = factor * given[motion.index(of)]
    return offsets


def recognise_unit(path: str | Path, motion: ArticulatedMotion, family: Family) -> float:
    """Return the one of `UNITS_M` that gives human legs, m; `FileFormatError` where none does."""
    offsets = restored_offsets(motion, family)
    below_hip = ("LeftLeg", "LeftFoot", "RightLeg", "RightFoot")
    joints = [motion.index(family.at[NAMES.index(joint)][0]) for joint in below_hip]
    leg = float(np.linalg.norm(offsets[joints], axis=-1).sum()) / 2
    for unit_m in UNITS_M:
        if _PLAUSIBLE_LEG[0] < leg * unit_m < _PLAUSIBLE_LEG[1]:
            return unit_m
    units = ", ".join(f"{unit:.4g}" for unit in UNITS_M)
    raise FileFormatError(path, f"the legs are {leg:.4g} units long, human in no unit of {units} m; give unit_m=...")
