"""A comparison in words: what against what, on which axis, what has changed, and what to be careful about."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.clinical.comparison import AngleComparison, Comparison
from rtof_kin.clinical.comparison_alignment import POOR, Alignment
from rtof_kin.clinical.comparison_change import LEVEL, Change, Verdict
from rtof_kin.clinical.gait import PHASES
from rtof_kin.reporting.angle_names import label

_REPEATED: Final = {"squat": "bend of the knees (squat or lunge)", "sit_to_stand": "rise from a seat"}
_MOST: Final = 3  # changes that are named
_LATE: Final = 0.04  # [s] a better shift than this is pointed out
_BETTER: Final = 0.02  # if the agreement is better by this
_SAME: Final = np.radians(0.005)
_OFTEN: Final = 0.2  # share of the samples outside the band of the difference, of which 0.05 are expected


def opening(found: Comparison, why: str) -> list[str]:
    """Return the first lines: identity, what against what, the axis, and the changes.

    Args:
        why: of the choice of the axis; '' if it was asked for.
    """
    lines = ["A and B are identical: the same angles at the same times."] if found.identical else []
    if _same_values(found) and not lines:
        lines = ["A and B have the same values, to 0.01 deg, wherever they are compared."]
    doubt = _doubt(found)
    lines += [doubt] if doubt else []
    lines.append(f"A is {found.a.name}, B is {found.b.name}; differences are B - A{_meaning(found)}.")
    lines.append(_axis(found) + (f" Chosen because {why}." if why else ""))
    return [*lines, *_changes(found)]


def cautions(found: Comparison) -> list[str]:
    """Return what to be careful about."""
    lines = [*_clock_cautions(found), *_band_cautions(found)]
    a, b = found.a, found.b
    if found.by == "range":
        lines.append(
            "Ranges are those of the whole recordings: they differ if the person did something else, and how "
            "much they vary from one recording to the next is not known and not included"
        )
    for one in (a, b):
        if one.other_system and not one.own_export:
            lines.append(
                f"The zero of {one.name} is that of its own model: a constant difference may be one of "
                "definition; see the errors without offset and the ranges"
            )
    lines += _outside(found)
    single = [n for n, x in zip("AB", (a, b), strict=True) if _single(found, n == "B")]
    if found.by in ("cycle", "repetition") and single:
        lines.append(
            f"{' and '.join(single)} has angles with a single repeat, whose spread is taken from the other"
            if len(single) == 1
            else "Some angles have a single repeat in both: how much repeats vary is not included there"
        )
    little = [one.name for one in found.angles if one.share < 0.5]
    if little:
        what = "frames" if found.by in ("time", "range") else "repeats"
        names = ", ".join(label(name) for name in little[:_MOST])
        more = f" and {len(little) - _MOST} more" if len(little) > _MOST else ""
        lines.append(f"Less than half of the {what} is observed and reliable in both: {names}{more}")
    noted = (a,) if a.notes == b.notes else (a, b)
    if found.by == "cycle":
        lines += [f"{one.name} is probably not walking: {one.not_gait}" for one in noted if one.not_gait]
    if found.by == "cycle" or a.other_system or b.other_system:
        lines += [f"{one.name}: {note}" for one in noted for note in one.notes]
    return lines


def degrees(value: float, sign: bool = False, digits: int = 1) -> str:
    """Return an angle in degrees; '' for NaN.

    Args:
        value: rad.
    """
    if not np.isfinite(value):
        return ""
    text = f"{np.degrees(value):{'+' if sign else ''}.{digits}f}"
    return text if float(text) else text.replace("-", "").replace("+", "")


def change_text(one: AngleComparison, change: Change) -> str:
    """Return a change in words, e.g. 'right knee flexion (mean) by -12.1 \u00b1 6.0 deg'."""
    return f"{label(one.name)} ({change.measure}) by {difference_text(change)} deg"


def difference_text(change: Change) -> str:
    """Return a difference with half of its 95 % interval, degrees, as in the report, e.g. '-12.1 \u00b1 6.0'."""
    half = change.interval[1] - change.difference
    band = f" \u00b1 {degrees(half)}" if np.isfinite(half) else ""
    return degrees(change.difference, True) + band


def place(found: Comparison, at: float) -> str:
    """Return a place on the axis with its unit.

    Args:
        at: s, or share.
    """
    return f"{at:.2f} s" if found.by == "time" else f"{100 * at:.0f} %"


def _meaning(found: Comparison) -> str:
    """What follows a difference after \u00b1, where anything does."""
    stated = any(np.isfinite(change.sigma) for one in found.angles for change in one.changes)
    return ", \u00b1 half of the 95 % interval of the angle alone" if stated else ""


def _same_values(found: Comparison) -> bool:
    return all(one.errors is not None and abs(one.errors.largest) < _SAME for one in found.angles)


def _doubt(found: Comparison) -> str | None:
    """Doubt that the two clocks or movements belong together."""
    clocks = found.alignment
    if found.by == "time" and clocks is not None and not found.identical and not _agreement(clocks) >= POOR:
        return (
            f"The curves hardly agree (agreement {_agreement(clocks):.2f} of 1): they may be different "
            "movements, or their clocks may differ."
        )
    return None


def _agreement(clocks: Alignment) -> float:
    """Agreement at the shift that is used, which is the zero of the clocks that were compared."""
    return clocks.unshifted if np.isfinite(clocks.unshifted) else 0.0


def _axis(found: Comparison) -> str:
    if found.by == "time":
        assert found.axis is not None
        text = f"Compared at the same instants, {found.axis[0]:.2f} to {found.axis[-1]:.2f} s of A's clock"
        if found.shift:
            text += f", with B shifted by {found.shift:+.3f} s"
        if found.alignment is not None and not found.identical:
            text += f" (agreement of angular velocities {_agreement(found.alignment):.2f} of 1)"
        return f"{text}; {_used(found)}."
    if found.by == "range":
        return "Compared by the ranges of motion of the whole recordings, without a common axis."
    what = "gait cycle, heel strike to heel strike" if found.by == "cycle" else _REPEATED[found.kind]
    counts = [max(one.repeats[i] for one in found.angles) for i in (0, 1)]
    times, each = ("stride", " on each side") if found.by == "cycle" else ("repetition", "")
    means = f"{_count(counts[0], times)} of A and {_count(counts[1], times)} of B{each}"
    return f"Compared over the {what}, at {len(PHASES)} phases; means over up to {means}."


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def _used(found: Comparison) -> str:
    """Share of the common frames that is compared, of all angles."""
    shares = [f"{100 * find(one.share for one in found.angles):.0f}" for find in (min, max)]
    span = shares[0] if shares[0] == shares[1] else " to ".join(shares)
    return f"{span} % of the frames, by angle, are observed and reliable in both"


def _changes(found: Comparison) -> list[str]:
    tested = [one for one in found.angles if one.verdict is not Verdict.NOT_TESTED]
    if not tested:
        return [f"{len(found.angles)} angles are compared; none is tested, because nothing states its error."]
    changed = found.changed
    level = f"two-sided, {100 * LEVEL:.0f} % for all angles together"
    if changed:
        largest = sorted(changed, key=lambda one: -abs(one.largest.difference))[:_MOST]
        names = "; ".join(change_text(one, one.largest) for one in largest)
        which = "the largest: " if len(changed) > _MOST else ""
        verb = "has" if len(changed) == 1 else "have"
        return [f"{len(changed)} of {len(tested)} angles {verb} changed ({level}): {which}{names}."]
    lines = [f"None of {len(tested)} angles is shown to have changed ({level})."]
    if not _same_values(found):
        sizes = [one.changes[0].detectable for one in tested if np.isfinite(one.changes[0].detectable)]
        largest = sorted(tested, key=lambda one: -abs(one.changes[0].difference))[:_MOST]
        names = "; ".join(change_text(one, one.changes[0]) for one in largest)
        lines.append(f"The largest differences: {names}.")
        span = " to ".join(degrees(size, digits=0) for size in (min(sizes), max(sizes)))
        measure = tested[0].changes[0].measure
        lines.append(
            f"That is not the same as equal: a change of the {measure} below {span} deg, by angle, could be missed."
        )
    return lines


def _clock_cautions(found: Comparison) -> list[str]:
    clocks = found.alignment
    if found.by != "time" or clocks is None or found.identical:
        return []
    lines = []
    better = clocks.agreement > _agreement(clocks) + _BETTER and abs(clocks.shift) > _LATE
    if better and clocks.poor:
        lines.append(
            f"No shift makes the curves agree (at most {clocks.agreement:.2f}, where B is shifted by "
            f"{found.shift + clocks.shift:+.2f} s): different movements, or different people"
        )
    elif better:
        lines.append(
            f"The curves agree better ({clocks.agreement:.2f}) with B shifted by "
            f"{found.shift + clocks.shift:+.2f} s: if the clocks differ, use --align"
        )
    if found.shift:
        lines.append(_sharpness(clocks, found.shift))
    return lines


def _sharpness(clocks: Alignment, shift: float) -> str:
    sd = f" \u00b1 {clocks.sigma:.3f} s" if np.isfinite(clocks.sigma) else ""
    text = f"The shift of B is {shift:+.3f}{sd or ' s'}"
    if np.isfinite(clocks.rival):
        text += f"; the second best is {shift + clocks.rival:+.2f} s (agreement {clocks.rival_agreement:.2f})"
    if clocks.ambiguous:
        text += ", nearly as good, as in a periodic movement: check it by an event that both show"
    return text


def _band_cautions(found: Comparison) -> list[str]:
    bands = [one.angles.sigma is not None for one in (found.a, found.b)]
    lines = []
    if not any(bands):
        lines.append(
            "Neither has bands: the errors of measurement are not included"
            + (", only the spread between repeats" if found.by in ("cycle", "repetition") else "")
        )
    for letter, one, own in zip("AB", (found.a, found.b), bands, strict=True):
        if not own and any(bands):
            lines.append(
                f"{letter} ({one.name}) has no bands and is taken as exact. Against an exact reference about "
                "one comparison in five has a false 'changed' (docs/compare.md)"
            )
    same = found.a.recording != "" and found.a.recording == found.b.recording
    sides = (found.a.name, found.b.name) == ("left", "right")
    if all(bands) and same and not sides and not found.identical:
        lines.append(
            f"Both are of a recording called {found.a.recording!r}. If it is the same one, they share errors "
            "(of video, sensors and mounting), which cancel: the standard deviations, as of independent "
            "errors, are then too large rather than too small"
        )
    return lines


def _outside(found: Comparison) -> list[str]:
    """Angles whose curves differ by more than the stated errors for long."""
    often = sorted((one for one in found.angles if one.outside > _OFTEN), key=lambda one: -one.outside)
    if not often:
        return []
    names = ", ".join(f"{label(one.name)} ({100 * one.outside:.0f} %)" for one in often[:_MOST])
    more = f" and {len(often) - _MOST} more" if len(often) > _MOST else ""
    return [
        "The curves differ by more than their 95 % bands allow in a large share of the samples, whatever "
        f"their means: {names}{more}"
    ]


def _single(found: Comparison, second: bool) -> bool:
    return any(one.repeats[int(second)] == 1 for one in found.angles)
