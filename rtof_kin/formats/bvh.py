"""Biovision hierarchy files (.bvh): a tree of joints and one line of channel values per frame.

The format has no standard. As its readers agree: the order of a joint's CHANNELS is the order of intrinsic rotations,
in degrees, and position channels replace the joint's OFFSET. Some programs give every joint position channels and fill
those of all but the root with zeros: such a joint stays at its OFFSET.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtof_kin.body.kinematics import children_of
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import shared
from rtof_kin.core.errors import FileFormatError, InvalidInputError, reading
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import LARGEST_NUMBER, numbers_of, read_text
from rtof_kin.formats.articulated import ArticulatedMotion

Row = tuple[int, str]  #: Number of a line, from 1, and its text
_CHANNELS = {f"{axis}{kind}": (kind, axis) for axis in "xyz" for kind in ("position", "rotation")}


@dataclass
class _Joint:
    line: int
    name: str
    parent: int
    is_end: bool = False
    offset: list[float] = field(default_factory=list)
    channels: list[tuple[str, str]] = field(default_factory=list)


def read_bvh(path: str | Path, rate_hz: float | None = None) -> ArticulatedMotion:
    """Read a BVH file, in its own axes and length unit; `rate_hz` is for frames per second that are missing or wrong in
    it. `p_parent_joint` is set where joints other than the root move in their parent. `FileFormatError`, which names
    the line: no such file, incomplete, inconsistent or not finite.
    """
    path = Path(path)
    lines = read_text(path, "a BVH file, which begins with HIERARCHY").splitlines()
    tokens = _Tokens(path, lines)
    nodes = _read_hierarchy(tokens)
    rate, values = _read_motion(path, lines, tokens.line, sum(len(n.channels) for n in nodes), rate_hz)
    with reading(path):
        return _assemble(nodes, values, rate)


class _Tokens:
    """Words of the hierarchy, each with its line."""

    def __init__(self, path: Path, lines: list[str]):
        self.path, self.line, self._last_line = path, 1, len(lines)
        self._words = self._walk(lines)

    @staticmethod
    def _walk(lines: list[str]) -> Iterator[Row]:
        for number, text in enumerate(lines, 1):
            for word in text.replace("{", " { ").replace("}", " } ").split():
                yield number, word

    def fail(self, problem: str) -> FileFormatError:
        return FileFormatError(self.path, problem, self.line)

    def next(self, wanted: str) -> str:
        """Return the next word; `wanted` is what the format has there, for messages."""
        self.line, word = next(self._words, (self._last_line, ""))
        if not word:
            raise self.fail(f"the file ends where {wanted} should stand")
        return word

    def expect(self, literal: str) -> None:
        word = self.next(literal)
        if word.upper() != literal.upper():
            raise self.fail(f"expected {literal}, found {word[:40]!r}")

    def number(self, wanted: str) -> float:
        word = self.next(wanted)
        value = _float_or_nan(word)
        if not abs(value) <= LARGEST_NUMBER:
            raise self.fail(f"expected {wanted}, found {word[:40]!r}")
        return value

    def name(self, optional: bool = False) -> str:
        """Return the words up to the opening brace, which is consumed."""
        words: list[str] = []
        while (word := self.next("a joint name and {")) != "{":
            if word == "}" or len(words) > 8:
                raise self.fail(f"expected {{ after the joint name, found {word[:40]!r}")
            words.append(word)
        if not (words or optional):
            raise self.fail("a joint has no name")
        return " ".join(words)


def _float_or_nan(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _read_hierarchy(tokens: _Tokens) -> list[_Joint]:
    """Read all nodes with end sites, depth first, and the word MOTION."""
    tokens.expect("HIERARCHY")
    tokens.expect("ROOT")
    nodes = [_Joint(tokens.line, tokens.name(), -1)]
    open_nodes = [0]
    while open_nodes:
        word = tokens.next("} or JOINT")
        node = nodes[open_nodes[-1]]
        match word.upper():
            case "}":
                if not node.offset:
                    raise tokens.fail(f"{node.name!r} (line {node.line}) has no OFFSET")
                open_nodes.pop()
            case "OFFSET":
                node.offset = [tokens.number("three offset numbers") for _ in range(3)]
            case "CHANNELS":
                node.channels = _read_channels(tokens, 0 if node.is_end else 6)
            case "JOINT" | "END" | "ENDSITE" if not node.is_end:
                is_end = word.upper() != "JOINT"
                child = _Joint(tokens.line, tokens.name(is_end), open_nodes[-1], is_end)
                if not is_end and child.name in {n.name for n in nodes if not n.is_end}:
                    raise tokens.fail(f"a second joint is named {child.name!r}; rename one")
                open_nodes.append(len(nodes))
                nodes.append(child)
            case _:
                raise tokens.fail(f"{word[:40]!r} does not belong in a joint; is a brace missing?")
    tokens.expect("MOTION")
    return nodes


def _read_channels(tokens: _Tokens, most: int) -> list[tuple[str, str]]:
    count = tokens.number("the number of channels")
    if count not in range(most + 1):
        what = "an end site has no channels" if most == 0 else "a joint has 0 to 6 channels"
        raise tokens.fail(f"{what}, not {count:g}")
    channels = []
    for _ in range(int(count)):
        word = tokens.next("a channel name")
        if word.lower() not in _CHANNELS:
            raise tokens.fail(f"unknown channel {word[:40]!r}; known: Xposition ... Zrotation")
        channels.append(_CHANNELS[word.lower()])
    if len(set(channels)) < len(channels):
        raise tokens.fail("a channel stands there twice in one joint")
    return channels


def _read_motion(path: Path, lines: list[str], start: int, width: int, rate_hz: float | None) -> tuple[float, Array]:
    """Read the rate in Hz and the channel values (T, width) of the lines after line `start`."""
    filled = [(n, text) for n, text in enumerate(lines[start:], start + 1) if text.strip()]
    end = (len(lines), "")
    line, frames = _labelled_number(path, filled[0] if filled else end, "Frames:")
    if frames < 1 or frames != int(frames):
        raise FileFormatError(path, f"the number of frames is {frames:g}", line)
    has_time = bool(filled[1:]) and ":" in filled[1][1]
    if has_time or rate_hz is None:
        line, step = _labelled_number(path, filled[1] if filled[1:] else end, "Frame Time:")
        if rate_hz is None and not 1e-6 < step < 1e6:
            problem = f"the frame time is {step:g} s; declare the rate, e.g. rate_hz=60"
            raise FileFormatError(path, problem, line)
        rate_hz = 1 / step if rate_hz is None else rate_hz
    rows = filled[1 + has_time :]
    if len(rows) != frames:
        problem = f"{frames:g} frames are announced, {len(rows)} lines of values follow"
        raise FileFormatError(path, problem, len(lines))
    values = np.empty((len(rows), width))
    for own, (number, text) in zip(values, rows, strict=True):
        own[:] = numbers_of(path, number, text.split(), width, "values of the channels")
    return rate_hz, values


def _labelled_number(path: Path, row: Row, label: str) -> tuple[int, float]:
    """Return the line and the number after a label such as 'Frame Time:', with any spaces between."""
    line, text = row
    head, _, tail = text.partition(":")
    if " ".join(head.split()).lower() + ":" != label.lower():
        hint = "; declare the rate, e.g. rate_hz=60, if it is missing" if "Time" in label else ""
        raise FileFormatError(path, f"expected {label!r}, found {text.strip()[:40]!r}{hint}", line)
    value = _float_or_nan(tail)
    if not np.isfinite(value):
        raise FileFormatError(path, f"no number follows {label!r}", line)
    return line, value


def _assemble(nodes: list[_Joint], values: Array, rate_hz: float) -> ArticulatedMotion:
    """Joints whose position channels are all zero, or are their offset, stay at their offsets."""
    joints = [n for n in nodes if not n.is_end]
    ends = [n for n in nodes if n.is_end]
    number = {id(n): j for j, n in enumerate(joints)}
    T, J = len(values), len(joints)
    offsets = np.array([n.offset for n in joints])
    R = np.broadcast_to(np.eye(3), (T, J, 3, 3)).copy()
    p = np.broadcast_to(offsets, (T, J, 3)).copy()
    column = 0
    for j, node in enumerate(joints):
        for kind, axis in node.channels:
            if kind == "position":
                p[:, j, "xyz".index(axis)] = values[:, column]
            else:
                R[:, j] = R[:, j] @ so3.about_axis(axis, np.deg2rad(values[:, column]))
            column += 1
    still = np.asarray(~p.any(axis=(0, 2)))
    still[0] = False  # the root stands where the file says
    p[:, still] = offsets[still]
    shared(R, p)
    return ArticulatedMotion(
        names=tuple(n.name for n in joints),
        parents=tuple(-1 if n.parent < 0 else number[id(nodes[n.parent])] for n in joints),
        offsets=offsets,
        R_parent_joint=R,
        p_root=p[:, 0],
        rate_hz=rate_hz,
        p_parent_joint=p if np.any(p[:, 1:] != offsets[1:]) else None,
        end_parents=tuple(number[id(nodes[n.parent])] for n in ends),
        end_offsets=np.array([n.offset for n in ends]).reshape(-1, 3),
    )


# --- writing -------------------------------------------------------------------------------------


def write_bvh(
    path: str | Path,
    motion: ArticulatedMotion | Iterable[ArticulatedMotion],
    frames: int | None = None,
    *,
    order: str = "zxy",
    overwrite: bool = False,
) -> None:
    """Write a motion that `read_bvh` reads back, in its own axes and length unit. `InvalidInputError`: no such order, a
    name with a line end or a brace, or a value that is not finite; `OutputExistsError`: the file exists and `overwrite`
    is False; `RtofError`: it cannot be written.

    Args:
        motion: whole, or blocks of consecutive frames of one tree, at least one. frames: number of all in blocks.
        order: order of the rotation channels, the same for all joints, since some readers take the first joint's for
            all, and others always z x y.
    """
    blocks = [motion] if isinstance(motion, ArticulatedMotion) else motion
    frames = len(motion) if isinstance(motion, ArticulatedMotion) else frames or 0
    if sorted(order) != ["x", "y", "z"]:
        raise InvalidInputError(f"order: {order!r}; give x, y and z in some order")
    last: Array | None = None
    with new_file(path, overwrite) as whole, whole.open("w", encoding="utf-8", newline="") as stream:
        for block in blocks:
            raw = so3.matrix_to_euler(order, block.R_parent_joint)
            if last is None:
                stream.write("\n".join(_head(block, order, frames)) + "\n")
                angles = so3.euler_continuous(raw)
            else:
                angles = so3.euler_continuous(np.concatenate([last, raw]))[1:]
            last = angles[-1:]
            rows = _values(block, np.rad2deg(angles)).tolist()
            stream.writelines(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def _head(motion: ArticulatedMotion, order: str, frames: int) -> list[str]:
    """Return the lines above the first frame."""
    odd = [n for n in motion.names if not n.strip() or set(n) & set("{}") or len(n.splitlines()) > 1]
    if odd:
        raise InvalidInputError(f"joint name {odd[0]!r}: empty, or a brace or a line's end in it; rename it")
    lines = ["HIERARCHY", *_hierarchy(motion, order, 0, "")]
    return [*lines, "MOTION", f"Frames: {frames}", f"Frame Time: {1 / float(motion.rate_hz)!r}"]


def _values(motion: ArticulatedMotion, angles: Array) -> Array:
    """Return the channels (T, width) from angles (T, J, 3), degrees."""
    moving, columns = motion.p_parent_joint, []
    for j in _depth_first(motion.parents, 0):
        if j == 0:
            columns.append(motion.p_root)
        elif moving is not None:
            columns.append(moving[:, j])
        columns.append(angles[:, j])
    values = np.concatenate(columns, axis=1)
    if not np.isfinite(values).all():
        raise InvalidInputError("motion: a value is not finite; BVH has no gaps, write a file for each piece")
    return values


def _depth_first(parents: tuple[int, ...], joint: int) -> list[int]:
    """Return a joint and all below it, in the order of a file."""
    below = [_depth_first(parents, child) for child in children_of(parents, joint)]
    return [joint, *(j for branch in below for j in branch)]


def _hierarchy(motion: ArticulatedMotion, order: str, joint: int, margin: str) -> list[str]:
    """Return the lines of a joint and of all below it; a leaf gets an end site."""
    places = joint == 0 or motion.p_parent_joint is not None
    channels = [f"{axis}position" for axis in "XYZ"] if places else []
    channels += [f"{axis.upper()}rotation" for axis in order]
    lines = [f"{'JOINT' if joint else 'ROOT'} {motion.names[joint]}", "{"]
    lines += ["\t" + _offset(motion.offsets[joint]), f"\tCHANNELS {len(channels)} {' '.join(channels)}"]
    for child in (children := children_of(motion.parents, joint)):
        lines += _hierarchy(motion, order, child, "\t")
    ends = [p for e, p in zip(motion.end_parents, motion.end_offsets, strict=True) if e == joint]
    for end in ends if ends or children else [np.zeros(3)]:
        lines += ["\tEnd Site", "\t{", "\t\t" + _offset(end), "\t}"]
    return [margin + line for line in [*lines, "}"]]


def _offset(point: Array) -> str:
    return "OFFSET " + " ".join(f"{value:.9f}" for value in point)
