"""Findings of a summary: differences that exceed their errors, by their size in standard deviations.

Compared are the two sides, by the same computation as ``compare --sides``, the ends of ranges with anatomical
limits, and the measures of gait of the two sides. Angles that were unobserved, unreliable or near a singular
posture for a part of the recording have no findings. A finding names a difference, never its cause.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton_table import SkeletonTable
from rtof_kin.clinical.analysis import MotionAnalysis
from rtof_kin.clinical.angle_table import SIDES, AngleTable
from rtof_kin.clinical.comparison import Comparison, compare_sides, with_strides
from rtof_kin.clinical.comparison_change import LEVEL
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.range_of_motion import RangeOfMotion
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reporting.angle_names import SECOND_SHOULDER, label
from rtof_kin.reporting.clinical_findings import SECOND_PELVIS

LEAST_DIFFERENCE: Final = np.radians(5.0)  # [rad] smaller differences are no findings, however certain
FEWEST_STRIDES: Final = 3  # of each side, for their standard deviation
EVENT_SIGMA: Final = 0.015
"""Standard deviation of a side's mean stance, share of the stride, that more strides do not reduce."""


@dataclass(frozen=True)
class Finding:
    """A difference that exceeds its 95 % band."""

    subject: str
    """Joint or measure; of one subject only the largest finding is shown."""
    text: str
    """Sentence with the figures and their 95 % bands."""
    size: float
    """Difference divided by its standard deviation."""


def findings(analysis: MotionAnalysis, skeleton: SkeletonTable, sides: Comparison | None) -> tuple[Finding, ...]:
    """Return the findings of an analysis, the largest first, at most one for each joint and measure.

    Args:
        sides: `compared_sides` of the analysis.
    """
    rows = {row.name: row for row in analysis.ranges if is_comparable(row)}
    found = [*_side_differences(sides), *_beyond_limits(rows, analysis.table, skeleton), *_asymmetries(analysis.gait)]
    out: dict[str, Finding] = {}
    for finding in sorted(found, key=lambda finding: -finding.size):
        out.setdefault(finding.subject, finding)
    return tuple(out.values())


def compared_sides(analysis: MotionAnalysis) -> Comparison | None:
    """Return left against right as `compare --sides` has it; None if nothing can be compared."""
    try:
        return compare_sides(with_strides("", analysis.angles, analysis.gait))[0]
    except InvalidInputError:
        return None


def is_comparable(row: RangeOfMotion) -> bool:
    """Return whether a range has a band, may be compared, and is not of a second sequence."""
    return row.is_comparable and bool(np.isfinite(row.range_sigma)) and not is_second_sequence(row.name)


def is_second_sequence(name: str) -> bool:
    """Return whether an angle is one of another sequence of the same rotation, which a summary omits."""
    return name.startswith(SECOND_PELVIS) or SECOND_SHOULDER in name


def with_band(value: float, sigma: float) -> str:
    """Return an angle with the half width of its 95 % band, in degrees.

    Args:
        value, sigma: rad.
    """
    return f"{np.degrees(value):.0f} ± {np.degrees(BAND_95 * sigma):.0f}°"


def _side_differences(sides: Comparison | None) -> Iterator[Finding]:
    """Angles that differ between the sides, after Holm's correction for all that were compared."""
    for one in sides.changed if sides is not None else ():
        change = one.largest
        if abs(change.difference) > LEAST_DIFFERENCE:
            name, less = label(one.name), "left" if change.difference > 0 else "right"
            over = " over the gait cycle" if sides is not None and sides.by == "cycle" else ""
            right, left = (f"{np.degrees(value):.0f}°" for value in (change.b, change.a))
            by = with_band(abs(change.difference), change.half_width(LEVEL) / BAND_95)
            text = f"{name}: {change.measure}{over} {right} right, {left} left, that is {by} less on the {less}"
            yield Finding(name.split()[0], text, abs(change.difference) / change.sigma)


def _beyond_limits(rows: dict[str, RangeOfMotion], table: AngleTable, skeleton: SkeletonTable) -> Iterator[Finding]:
    """Ends of ranges beyond the anatomical limits of the skeleton by more than their band."""
    limits = anatomical_limits(skeleton)
    joints = {angle.name: joint for joint in table.joints for angle in joint.angles}
    for name, row in rows.items():
        if name not in limits:
            continue
        low, high = limits[name]
        for end, sigma, excess, limit in (
            (row.low, row.low_sigma, low - row.low, low),
            (row.high, row.high_sigma, row.high - high, high),
        ):
            if excess > max(LEAST_DIFFERENCE, BAND_95 * sigma):
                text = (
                    f"{label(name)}: {'lowest' if end == row.low else 'highest'} angle "
                    f"{with_band(end, sigma)}, beyond the anatomical limit of {np.degrees(limit):.0f}°"
                )
                yield Finding(joints[name].name.removeprefix(f"{joints[name].side}_"), text, excess / sigma)


def anatomical_limits(skeleton: SkeletonTable) -> dict[str, tuple[float, float]]:
    """Return the limits, rad, of those clinical angles that are single revolutes of the skeleton."""
    out = {}
    for joint in skeleton.joints:
        for dof, (low, high) in zip(joint.dofs, joint.limits, strict=True):
            if not dof.clinical.startswith(tuple(f"{sign}{side}" for sign in ("", "-") for side in SIDES)):
                continue
            ends = (-high, -low) if dof.clinical.startswith("-") else (low, high)
            out[dof.clinical.removeprefix("-").replace(" ", "_")] = (float(ends[0]), float(ends[1]))
    return out


def _asymmetries(gait: GaitAnalysis) -> Iterator[Finding]:
    """Stance of the two sides, if its means differ by more than their band."""
    by_ankle = {foot.by_ankle for foot in gait.events.feet.values()}
    if not gait.is_gait or len(gait.summary) < 2 or len(by_ankle) > 1:
        return
    (right, sd_right, n_right), (left, sd_left, n_left) = (gait.summary[s]["stance_share"] for s in SIDES)
    if min(n_right, n_left) < FEWEST_STRIDES:
        return
    errors = [float(np.hypot(sd / np.sqrt(n), EVENT_SIGMA)) for sd, n in ((sd_right, n_right), (sd_left, n_left))]
    sigma = float(np.hypot(errors[0], errors[1]))
    if abs(right - left) > BAND_95 * sigma:
        ends = [
            f"{100 * mean:.0f} ± {100 * BAND_95 * error:.0f} %"
            for mean, error in zip((right, left), errors, strict=True)
        ]
        text = f"stance: {ends[0]} of the stride right, {ends[1]} left"
        yield Finding("stance", text, abs(right - left) / sigma)
