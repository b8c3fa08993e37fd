"""Acclaim files: a skeleton (.asf) and a motion of it (.amc).

A bone's rotation is given about its own axes: with C the rotation that its `axis` line states and M the product of its
degrees of freedom, the bone turns by C M C^-1 against its parent; before any rotation all frames are parallel to the
file's world. C and M turn about fixed axes in the order listed, so the last one stands leftmost. A bone begins at its
parent's end and runs along `direction` for `length`. Source: the notes on ASF/AMC files of the University of
Wisconsin-Madison (course CS 838, 1999), and the skeletons of mocap.cs.cmu.edu.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import numbers_of, read_text
from rtof_kin.formats.articulated import ArticulatedMotion

Lines = list[tuple[int, str]]  #: Numbered lines that are neither empty nor comments
_INCH: Final = 0.0254
_ANGLE_UNITS: Final = {"deg": np.pi / 180, "degrees": np.pi / 180, "rad": 1.0, "radians": 1.0}
_ROOT: Final = "root"


@dataclass
class _Bone:
    """A bone; angles in the file's unit."""

    name: str
    line: int
    direction: list[float] = field(default_factory=list)
    length: float | None = None
    axis: tuple[str, list[float]] = ("xyz", [0.0, 0.0, 0.0])
    dofs: tuple[str, ...] = ()

    @property
    def p_bone_end(self) -> Array:
        """End of the bone in its own frame, file units."""
        direction = np.asarray(self.direction, dtype=float)
        return np.asarray(direction / np.linalg.norm(direction) * (self.length or 0.0))


@dataclass
class _Skeleton:
    path: Path
    length_unit: float = 1.0
    angle_unit: float = np.pi / 180
    root: _Bone = field(default_factory=lambda: _Bone(_ROOT, 0, [0.0, 0.0, 1.0], 0.0))
    root_position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    bones: dict[str, _Bone] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)


def read_asf_amc(path_asf: str | Path, path_amc: str | Path, rate_hz: float = 120.0) -> ArticulatedMotion:
    """Read an Acclaim skeleton and a motion of it, in the file's axes and units. `FileFormatError`: no such file,
    incomplete, inconsistent or not finite; names the line.

    Args:
        rate_hz: frames per second, which the format does not state; CMU's are 120, a few 60.

    Returns:
        The motion. Joints have the names of the bones that begin at them. ``unit_m`` comes from
        ``:units length``, which counts units per inch (CMU: 0.45, so 1 unit is 0.0564 m).
    """
    path_asf, path_amc = Path(path_asf), Path(path_amc)
    skeleton = _read_skeleton(path_asf)
    bones = [skeleton.root, *_depth_first(skeleton)]
    values, angle_unit = _read_frames(path_amc, bones, skeleton.angle_unit)
    return _assemble(skeleton, bones, values, angle_unit, rate_hz)


# --- the lines of both files ----------------------------------------------------------------------


def _text_lines(path: Path) -> Lines:
    text = read_text(path, "an ASF or AMC file")
    numbered = enumerate((line.split("#")[0].strip() for line in text.splitlines()), 1)
    lines = [(number, line) for number, line in numbered if line]
    if not lines:
        raise FileFormatError(path, "empty", 1)
    return lines


def _axis_order(path: Path, line: int, word: str) -> str:
    if sorted(word.lower()) != ["x", "y", "z"]:
        raise FileFormatError(path, f"axis order {word[:40]!r} is not one like XYZ", line)
    return word.lower()


# --- the skeleton ---------------------------------------------------------------------------------


def _read_skeleton(path: Path) -> _Skeleton:
    lines = _text_lines(path)
    skeleton = _Skeleton(path)
    readers = {":units": _read_units, ":root": _read_root, ":bonedata": _read_bones, ":hierarchy": _read_hierarchy}
    starts = [i for i, (_, text) in enumerate(lines) if text.startswith(":")]
    sections = [lines[i][1].split()[0].lower() for i in starts]
    for name in (":root", ":bonedata", ":hierarchy"):
        if name not in sections:
            raise FileFormatError(path, f"no {name} section; is the file cut off?", lines[-1][0])
    for name, start, stop in zip(sections, starts, [*starts[1:], len(lines)], strict=True):
        if name in readers:
            readers[name](lines[start + 1 : stop], skeleton)
    return skeleton


def _read_units(lines: Lines, skeleton: _Skeleton) -> None:
    path = skeleton.path
    for line, text in lines:
        key, *words = text.split()
        if key == "length":
            (skeleton.length_unit,) = numbers_of(path, line, words, 1, "numbers of :units length")
            if skeleton.length_unit <= 0:
                raise FileFormatError(path, ":units length is not positive", line)
        elif key == "angle":
            if not words or words[0].lower() not in _ANGLE_UNITS:
                raise FileFormatError(path, f":units {text[:40]!r}; known: deg, rad", line)
            skeleton.angle_unit = _ANGLE_UNITS[words[0].lower()]


def _read_root(lines: Lines, skeleton: _Skeleton) -> None:
    path, root = skeleton.path, skeleton.root
    order, angles = "xyz", [0.0, 0.0, 0.0]
    for line, text in lines:
        key, *words = text.split()
        if key == "order":
            root.dofs, root.line = _read_dofs(path, line, words), line
        elif key == "axis":
            order = _axis_order(path, line, "".join(words))
        elif key == "position":
            skeleton.root_position = numbers_of(path, line, words, 3, "numbers of root position")
        elif key == "orientation":
            angles = numbers_of(path, line, words, 3, "numbers of root orientation")
    root.axis = (order, angles)
    if not root.dofs:
        line_of_root = lines[0][0] if lines else None
        raise FileFormatError(path, "the root has no 'order TX TY TZ RX RY RZ'", line_of_root)


def _read_dofs(path: Path, line: int, words: Sequence[str]) -> tuple[str, ...]:
    dofs = tuple(word.lower() for word in words)
    if not set(dofs) <= {"tx", "ty", "tz", "rx", "ry", "rz"} or len(set(dofs)) < len(dofs):
        found = " ".join(words)[:40]
        raise FileFormatError(path, f"degrees of freedom {found!r}; known: TX ... RZ, once each", line)
    return dofs


def _read_bones(lines: Lines, skeleton: _Skeleton) -> None:
    path, bone = skeleton.path, None
    for line, text in lines:
        key, *words = text.split()
        if key == "begin":
            if bone is not None:
                raise FileFormatError(path, f"'begin' inside bone {bone.name!r}; 'end' is missing", line)
            bone = _Bone("", line)
        elif bone is None:
            raise FileFormatError(path, f"expected 'begin', found {text[:40]!r}", line)
        elif key == "end":
            if not bone.name or bone.name in skeleton.bones or bone.name == _ROOT:
                raise FileFormatError(path, f"bone name {bone.name!r} is missing or taken", line)
            if bone.length is None or not np.any(bone.direction):
                raise FileFormatError(path, f"bone {bone.name!r} lacks a direction or a length", line)
            skeleton.bones[bone.name] = bone
            bone = None
        else:
            _read_bone_line(path, line, bone, key, words)
    if bone is not None:
        raise FileFormatError(path, f"bone {bone.name!r} has no 'end'", lines[-1][0])


def _read_bone_line(path: Path, line: int, bone: _Bone, key: str, words: list[str]) -> None:
    if key == "name":
        bone.name = " ".join(words)
    elif key == "direction":
        bone.direction = numbers_of(path, line, words, 3, "numbers of direction")
    elif key == "length":
        (bone.length,) = numbers_of(path, line, words, 1, "numbers of length")
    elif key == "axis":
        order = _axis_order(path, line, words[-1] if words else "")
        bone.axis = (order, numbers_of(path, line, words[:-1], 3, "numbers of axis"))
    elif key == "dof":
        bone.dofs = _read_dofs(path, line, words)


def _read_hierarchy(lines: Lines, skeleton: _Skeleton) -> None:
    path = skeleton.path
    if not lines or lines[0][1] != "begin" or lines[-1][1] != "end":
        where = lines[-1][0] if lines else None
        raise FileFormatError(path, ":hierarchy is not enclosed in 'begin' and 'end'", where)
    for line, text in lines[1:-1]:
        parent, *children = text.split()
        for name in (parent, *children):
            if name not in skeleton.bones and name != _ROOT:
                raise FileFormatError(path, f"no bone is named {name[:40]!r}", line)
        for child in children:
            if child in skeleton.parents or child == _ROOT:
                raise FileFormatError(path, f"{child!r} gets a second parent", line)
            skeleton.parents[child] = parent


def _depth_first(skeleton: _Skeleton) -> Iterator[_Bone]:
    """Yield the bones below the root, parents first, in the order of the hierarchy."""
    children: dict[str, list[str]] = {}
    for child, parent in skeleton.parents.items():
        children.setdefault(parent, []).append(child)
    reached, stack = set(), children.get(_ROOT, [])[::-1]
    while stack:
        name = stack.pop()
        reached.add(name)
        yield skeleton.bones[name]
        stack += children.get(name, [])[::-1]
    for name, bone in skeleton.bones.items():
        if name not in reached:
            raise FileFormatError(skeleton.path, f"{name!r} is not below the root in :hierarchy", bone.line)


# --- the motion -----------------------------------------------------------------------------------


def _read_frames(path: Path, bones: list[_Bone], angle_unit: float) -> tuple[list[Array], float]:
    """Return values (T, dofs) of each bone, and radians per unit of the file's angles."""
    lines = _text_lines(path)
    start = 0
    while start < len(lines) and not lines[start][1].isdigit():
        line, text = lines[start]
        if not text.startswith(":"):
            raise FileFormatError(path, f"expected a frame number, found {text[:40]!r}", line)
        angle_unit = _ANGLE_UNITS.get(text[1:].lower(), angle_unit)
        start += 1
    moving = {bone.name: bone for bone in bones if bone.dofs}
    rows: dict[str, list[list[float]]] = {name: [] for name in moving}
    frames = 0

    def check_frame(line: int) -> None:
        short = [name for name, values in rows.items() if len(values) < frames]
        if short:
            problem = f"frame {frames} ends without {', '.join(short[:5])}; is the file cut off?"
            raise FileFormatError(path, problem, line)

    for line, text in lines[start:]:
        name, *words = text.split()
        if not words and name.isdigit():
            check_frame(line)
            frames += 1
            continue
        if name not in moving:
            raise FileFormatError(path, f"{name[:40]!r} is no moving bone of the skeleton", line)
        count = len(moving[name].dofs)
        if len(words) != count or len(rows[name]) != frames - 1:
            raise FileFormatError(path, f"{name}: expected {count} value(s) once a frame, found {text[:40]!r}", line)
        rows[name].append(numbers_of(path, line, words, count, f"numbers of {name}"))
    check_frame(lines[-1][0])
    if frames == 0:
        raise FileFormatError(path, "no frames", lines[-1][0])
    empty = np.zeros((frames, 0))
    return [np.array(rows[bone.name]) if bone.dofs else empty for bone in bones], angle_unit


def _turn(order: str, angles: ArrayLike) -> Array:
    """Return the rotation about fixed axes in an order; angles (..., len(order)) in radians."""
    angles = np.asarray(angles, dtype=float)
    R = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for i, axis in enumerate(order):
        R = so3.about_axis(axis, angles[..., i]) @ R
    return np.asarray(R)


def _assemble(
    skeleton: _Skeleton, bones: list[_Bone], values: list[Array], angle_unit: float, rate_hz: float
) -> ArticulatedMotion:
    index = {bone.name: j for j, bone in enumerate(bones)}
    parents = [-1, *(index[skeleton.parents[bone.name]] for bone in bones[1:])]
    offsets = np.zeros((len(bones), 3))
    offsets[1:] = [bones[parent].p_bone_end for parent in parents[1:]]
    T = len(values[0])
    R = np.empty((T, len(bones), 3, 3))
    p = np.broadcast_to(offsets, (T, len(bones), 3)).copy()
    for j, (bone, value) in enumerate(zip(bones, values, strict=True)):
        C = _turn(bone.axis[0], np.asarray(bone.axis[1]) * skeleton.angle_unit)
        turns = [i for i, dof in enumerate(bone.dofs) if dof[0] == "r"]
        M = _turn("".join(bone.dofs[i][1] for i in turns), value[:, turns] * angle_unit)
        # The root's orientation is where it starts from, a bone's axis only states coordinates.
        R[:, j] = M @ C if j == 0 else C @ M @ C.T
        for i, dof in enumerate(bone.dofs):
            if dof[0] == "t":
                p[:, j, "xyz".index(dof[1])] += value[:, i]
    p[:, 0] += skeleton.root_position
    slides = any(dof[0] == "t" for bone in bones[1:] for dof in bone.dofs)
    leaves = [j for j in range(1, len(bones)) if j not in parents]
    return ArticulatedMotion(
        names=tuple(index),
        parents=tuple(parents),
        offsets=offsets,
        R_parent_joint=R,
        p_root=p[:, 0],
        rate_hz=rate_hz,
        unit_m=_INCH / skeleton.length_unit,
        p_parent_joint=p if slides else None,
        end_parents=tuple(leaves),
        end_offsets=np.array([bones[j].p_bone_end for j in leaves]).reshape(-1, 3),
    )
