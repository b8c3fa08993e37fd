"""Errors of clinical joint angles against a reference, pooled over takes, joints and classes of movement.

With the differences d = estimate - reference of n samples:

=================  ==============================================================================
rmse               sqrt(mean d^2)
mae                mean |d|
median             median |d|
offset             mean d
offset_removed     sqrt(mean (d - m)^2), m the mean of d over each take's own curve of each angle
within             share of the samples with |d| <= 1.96 s, s the estimate's own standard deviation
agreement          NRMSE, CMC, range of motion and limits, see `rtof_kin.clinical.agreement`
=================  ==============================================================================

Samples are pooled: a longer take counts more. They are not independent; the number of takes says more about
how sure a value is than the number of samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.agreement import NO_AGREEMENT, Agreement, agreement_of
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles
from rtof_kin.clinical.comparison import HEADINGS, error_sizes
from rtof_kin.clinical.comparison_samples import in_time
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95

ALL: Final = "all"  #: Stands for every angle, or every class of movement
_FIXED: Final = np.radians(0.05)  #: Range of a reference over a take below which its model holds it fixed


@dataclass(frozen=True)
class AngleDifferences:
    """Differences of one angle in one take."""

    angle: str  #: Clinical name with its side
    movement: str  #: Class of the movement
    take: str
    difference: Array  #: (n,) rad, estimate - reference, n > 0
    sigma: NDArray[np.floating[Any]] | None = None
    """(n,) rad, the estimate's own standard deviation; None without bands."""
    reference: Array | None = None  #: (n,) rad; None where it is not kept
    person: str = ""  #: '' where people are not known

    @property
    def joint_angle(self) -> str:
        """The name without its side: both sides are one row of a table."""
        return self.angle.removeprefix(f"{SIDES[0]}_").removeprefix(f"{SIDES[1]}_")


@dataclass(frozen=True)
class AngleErrors:
    """Errors of a set of differences; angles in rad."""

    angle: str
    """Joint angle, or `ALL`."""
    movement: str
    """Class, or `ALL`."""
    takes: int
    samples: int
    rmse: float
    mae: float
    median: float
    offset_removed: float
    offset: float
    within: float
    """NaN where the estimate has no bands."""
    agreement: Agreement = NO_AGREEMENT


def angle_differences(
    estimate: ClinicalAngles,
    reference: ClinicalAngles,
    movement: str,
    take: str,
    names: Sequence[str] = (),
    shift: float = 0.0,
) -> tuple[tuple[AngleDifferences, ...], dict[str, str]]:
    """Return the differences of the angles that both have at the same instants, and why others are left out.

    Samples that are unobserved, unreliable or singular in either do not count; names: angles of the reference to use,
    all without any; shift: s, added to the times of the reference.
    """
    left_out: dict[str, str] = {}
    chosen = []
    for name in names or reference.names:
        known = reference[name][np.isfinite(reference[name])] if name in reference.names else np.empty(0)
        if name in HEADINGS:
            left_out[name] = "depends on the direction of the world's axes"
        elif not len(known):
            left_out[name] = "not in the reference"
        elif np.ptp(known) < _FIXED:
            left_out[name] = "does not move in the reference: its model holds it fixed"
        elif name not in estimate.names or not np.isfinite(estimate[name]).any():
            left_out[name] = "not observed in the estimate"
        else:
            chosen.append(name)
    found = []
    for name in chosen:
        pair = in_time(estimate.select([name]), reference.select([name]), shift)
        if not pair.share:
            left_out[name] = "no common instant is observed and reliable in both"
            continue
        difference = (pair.a.values - pair.b.values)[0]
        known = np.isfinite(difference)
        sigma = None if pair.a.sigma is None else pair.a.sigma[0][known].astype(np.float32)  # as the estimate has it
        own, whole = pair.b.values[0][known], reference[name]
        own = whole if np.array_equal(own, whole) else own  # shared, as it may be of hours
        found.append(AngleDifferences(name, movement, take, difference[known], sigma, own))
    return tuple(found), left_out


def angle_errors(differences: Iterable[AngleDifferences], angle: str = ALL, movement: str = ALL) -> AngleErrors:
    """Return the errors of a set of differences, at least one."""
    own = list(differences)
    banded = ((one.difference, sigma.astype(float)) for one in own if (sigma := one.sigma) is not None)
    within = [(np.abs(difference) <= BAND_95 * sigma)[np.isfinite(sigma)] for difference, sigma in banded]
    curves = [(o.person, o.reference, o.difference) for o in own if o.reference is not None]
    return AngleErrors(
        angle,
        movement,
        len({one.take for one in own}),
        sum(len(one.difference) for one in own),
        **error_sizes([one.difference for one in own]),
        offset=float(np.mean(np.concatenate([one.difference for one in own]))),
        within=float(np.mean(np.concatenate(within))) if any(map(len, within)) else float("nan"),
        agreement=agreement_of(curves),
    )


def error_rows(differences: Sequence[AngleDifferences], movements: Sequence[str]) -> tuple[AngleErrors, ...]:
    """Return the errors of everything, of each class, of each joint angle, and of each angle in each class."""
    names = list(dict.fromkeys(one.joint_angle for one in differences))
    classes = [m for m in movements if any(one.movement == m for one in differences)]
    wanted: list[tuple[str, str]] = [(ALL, ALL), *((ALL, m) for m in classes)]
    for name in names:
        wanted += [(name, ALL), *((name, m) for m in classes)]
    rows = []
    for name, movement in wanted:
        of_angle = [one for one in differences if name in (ALL, one.joint_angle)]
        if own := [one for one in of_angle if movement in (ALL, one.movement)]:
            rows.append(angle_errors(own, name, movement))
    return tuple(rows)
