"""Comparison of a result with the one in a bundle: bit by bit, and where that fails in mm and degrees."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_file import MOTION, read_motion_npz
from rtof_kin.core import rotations as so3
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.files.text import load_json
from rtof_kin.formats.measurements_file import MEASUREMENTS

REDACTED: Final = "[left out: it named a person or a place in the file system]"
_OF_A_RUN: Final = frozenset({"recording", "run", "lifter", "threads", "seconds"})
"""Fields of a summary that repeat what the bundle's manifest has, or differ from run to run."""
CLOSE_MM, CLOSE_DEG = 1.0, 0.1
"""Largest differences of joints' positions and segments' orientations of a result that counts as the same."""


class Agreement(Enum):
    """How a result agrees with the bundled one."""

    EXACT = "reproduced bit by bit"
    CLOSE = "reproduced, not bit by bit"
    DIFFERENT = "NOT reproduced"


@dataclass(frozen=True)
class Comparison:
    """Comparison of one result."""

    agreement: Agreement
    frames: int
    """Of the new result."""
    position_mm: float = 0.0
    """Largest difference of a joint's position; NaN where the frames differ."""
    turn_deg: float = 0.0
    """Largest difference of a segment's orientation."""
    arrays: tuple[str, ...] = ()
    """Arrays, texts and fields of the summary that are not equal."""

    def sentence(self, causes: Sequence[str]) -> str:
        """Return the verdict in one line.

        Args:
            causes: versions that differ, see `core.environment.differences`.
        """
        if self.agreement is Agreement.EXACT:
            return str(self.agreement.value)
        differ = "numbers or flags of frames differ"
        if self.arrays and not any(".npz " in name for name in self.arrays):
            differ = f"the motion is the same, but not {', '.join(self.arrays)}: changed after the run"
        elif np.isfinite(self.position_mm):
            differ = f"joints differ by up to {self.position_mm:.2g} mm, segments by up to {self.turn_deg:.2g} deg"
        why = "; likely since " + ", ".join(causes) if causes else ", though code, libraries and processor agree"
        return f"{self.agreement.value}: {differ}{why}"


def compare_results(bundled: Path, again: Path) -> Comparison:
    """Compare a result with the bundled one.

    Raises:
        FileFormatError: a file is missing or damaged.
    """
    arrays = tuple(name for file in (MOTION, MEASUREMENTS) for name in _unequal(bundled / file, again / file))
    texts = tuple(_changed_texts(bundled, again))
    after = read_motion_npz(again / MOTION)
    frames = len(after.q)
    if not arrays:
        exact = Agreement.DIFFERENT if texts else Agreement.EXACT
        return Comparison(exact, frames, arrays=texts)
    before = read_motion_npz(bundled / MOTION)
    a, b = before.poses, after.poses
    if a.names != b.names or len(a) != len(b) or not np.allclose(a.times, b.times, rtol=0, atol=1e-6):
        return Comparison(Agreement.DIFFERENT, frames, np.nan, np.nan, arrays)
    finite = [np.isfinite(one.p_world_joint).all(-1) & np.isfinite(one.R_world_bone).all((-2, -1)) for one in (a, b)]
    known = finite[0] & finite[1]
    same_flags = np.array_equal(a.valid, b.valid) and np.array_equal(finite[0], finite[1])
    apart = np.linalg.norm(a.p_world_joint[known] - b.p_world_joint[known], axis=-1)
    turns = so3.angle_between(a.R_world_bone[known], b.R_world_bone[known])
    mm, deg = (float(np.max(part, initial=0.0)) for part in (1000 * apart, np.degrees(turns)))
    close = mm <= CLOSE_MM and deg <= CLOSE_DEG and same_flags
    return Comparison(Agreement.CLOSE if close else Agreement.DIFFERENT, frames, mm, deg, arrays)


def _changed_texts(bundled: Path, again: Path) -> Iterator[str]:
    """Yield the URDF, and fields of the summary, that differ beside the same motion."""
    urdf = [folder / "skeleton.urdf" for folder in (bundled, again)]
    if urdf[0].is_file() and urdf[0].read_bytes() != urdf[1].read_bytes():
        yield urdf[0].name
    before, after = (load_json(folder / "summary.json") for folder in (bundled, again))
    for field in before:
        if field not in _OF_A_RUN and not _same(before[field], after.get(field)):
            yield f"summary.json {field}"


def _same(before: Any, after: Any) -> bool:
    """Whether what a bundle keeps of a value is in another; times of computation do not count."""
    if isinstance(before, dict) and isinstance(after, dict):
        return all(key in _OF_A_RUN or (key in after and _same(before[key], after[key])) for key in before)
    if isinstance(before, list) and isinstance(after, list):
        return len(before) == len(after) and all(map(_same, before, after))
    if isinstance(before, float) and isinstance(after, float):  # sums of figures depend on the threads
        return math.isclose(before, after, rel_tol=1e-6, abs_tol=1e-9)
    return bool(before in (after, REDACTED))


def _unequal(bundled: Path, again: Path) -> list[str]:
    """Return the names of arrays that are not the same bits."""
    if not bundled.is_file():
        return []
    before, after = (read_npz_as_saved(path, kinds="fiubU") for path in (bundled, again))
    return [
        f"{bundled.name} {name}"
        for name in sorted({*before, *after})
        if name not in before
        or name not in after
        or (before[name].dtype, before[name].shape) != (after[name].dtype, after[name].shape)
        or before[name].tobytes() != after[name].tobytes()
    ]
