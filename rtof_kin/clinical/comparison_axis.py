"""Choice of the axis of a comparison from the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from rtof_kin.clinical.comparison import By, Compared, Comparison, common_angles, compare, sides_of
from rtof_kin.clinical.comparison_alignment import Alignment, align
from rtof_kin.clinical.repetitions import KINDS
from rtof_kin.core.errors import InvalidInputError

_LEAST_REPEATS: Final = 2  # strides of one side, or repetitions, of each motion
_SAME_ENDS: Final = 0.25  # [s] by which the ends of two results of one take may differ
_ALIKE: Final = 0.8  # agreement of motions of unknown recordings that count as one take
_LEAST_COMMON: Final = 0.5  # share of the shorter motion that overlaps with another system's


@dataclass(frozen=True)
class Choice:
    """An axis, and why it was chosen."""

    by: By
    why: str
    kind: str = "squat"
    """Of the repetitions."""


def agreement(a: Compared, b: Compared, shift: float = 0.0) -> Alignment | None:
    """Return the best shift of B beyond a given one; None if no common angle moves.

    Args:
        shift: s, added to the times of B before.
    """
    moved = replace(b.angles, times=b.angles.times + shift)
    try:
        return align(a.angles, moved, common_angles(a, b))
    except InvalidInputError:
        return None


def choose_axis(a: Compared, b: Compared, clocks: Alignment | None, asked: By | None = None) -> Choice:
    """Return the axis on which two motions are compared; the reason is empty if it was asked for.

    Args:
        clocks: their `agreement`.
    """
    if asked is not None:
        return _asked(a, b, asked)
    if a.other_system or b.other_system:
        if _overlap(a, b) >= _LEAST_COMMON:
            return Choice("time", "a table of coordinates is compared at the same instants")
        return Choice("range", "the time spans hardly overlap; --align finds a shift")
    if (reason := _one_take(a, b, clocks)) is not None:
        return Choice("time", reason)
    return repeated_axis(a, b) or Choice(
        "range", "they are different recordings, and not both have gait cycles or repetitions"
    )


def compare_sides(
    one: Compared, asked: By | None = None, *, names: Sequence[str] = (), kind: str = ""
) -> tuple[Comparison, str]:
    """Return left (A) against right (B) of a motion, and why on this axis, for the command and the report.

    Unless asked, it is by gait cycle if the motion is walking with two strides of each side, else by the
    ranges of the whole recording: its repetitions may be of both legs, of the right or of the left one.

    Args:
        names, kind: see `compare`.

    Raises:
        InvalidInputError, UnknownNameError: see `compare`.
    """
    left, right = sides_of(one)
    if asked is not None:
        choice = _asked(left, right, asked)
    elif not one.not_gait and min(map(len, one.strides.values()), default=0) >= _LEAST_REPEATS:
        choice = Choice("cycle", "the motion is walking, with complete gait cycles of both sides")
    else:
        choice = Choice("range", "the motion is not walking with two strides or more of each side")
    return compare(left, right, choice.by, names=names, kind=kind or choice.kind), choice.why


def repeated_axis(a: Compared, b: Compared) -> Choice | None:
    """Return the axis of the repeats that both have at least two of; None if there are none."""
    cycles = [min(len(own), len(b.strides.get(side, ()))) for side, own in a.strides.items()]
    if max(cycles, default=0) >= _LEAST_REPEATS and not (a.not_gait or b.not_gait):
        return Choice("cycle", "both are walking, with complete gait cycles")
    for kind in KINDS:
        if min(len(x.repetitions.get(kind, ())) for x in (a, b)) >= _LEAST_REPEATS:
            return Choice("repetition", "both have two repetitions or more", kind)
    return None


def _asked(a: Compared, b: Compared, by: By) -> Choice:
    """Axis that was asked for; of repetitions the kind that both have most of."""
    least = {kind: min(len(x.repetitions.get(kind, ())) for x in (a, b)) for kind in KINDS}
    return Choice(by, "", max(KINDS, key=lambda kind: least[kind]))


def _one_take(a: Compared, b: Compared, clocks: Alignment | None) -> str | None:
    """Why two motions count as results of the same take; None if they do not."""
    ends = zip(_ends(a), _ends(b), strict=True)
    if clocks is None or not max(abs(x - y) for x, y in ends) <= _SAME_ENDS:
        return None
    if a.recording and a.recording == b.recording and not clocks.poor:
        return f"both are results of a recording {a.recording!r} of the same length that agree"
    if not (a.recording and b.recording) and clocks.unshifted >= _ALIKE:
        return "both have the same length and move alike at the same instants"
    return None


def _ends(one: Compared) -> tuple[float, float]:
    return float(one.angles.times[0]), float(one.angles.times[-1])


def _overlap(a: Compared, b: Compared) -> float:
    """Share of the shorter one that overlaps."""
    (start_a, stop_a), (start_b, stop_b) = _ends(a), _ends(b)
    shorter = max(min(stop_a - start_a, stop_b - start_b), 1e-9)
    return (min(stop_a, stop_b) - max(start_a, start_b)) / shorter
