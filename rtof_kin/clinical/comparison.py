"""Comparison of the clinical angles of two motions, or of the left and right side of one.

How the two are put on one axis (`By`):

==========  =====================================================================================
time        the same instants: two methods, or another system, on the same take
cycle       phases of the gait cycle, mean over strides
repetition  phases of a squat or a rise from a seat, mean over repetitions
range       no common axis: ranges of motion of the whole recordings alone
==========  =====================================================================================

`comparison_change` has the mathematics of the differences, `comparison_samples` that of clocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import Final, Literal

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.agreement import Agreement, agreement_of
from rtof_kin.clinical.angle_table import SIDES, AngleRow, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, angles_and_paths
from rtof_kin.clinical.comparison_change import Change, Made, Repeats, Verdict, adjusted, change, error_of, shared_of
from rtof_kin.clinical.comparison_samples import Alignment, Pair, Spans, align, in_both, in_range, in_time, over_phases
from rtof_kin.clinical.gait import PHASES, GaitAnalysis, analyse_gait
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.clinical.repetitions import KINDS, find_repetitions
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.formats.motion_views import AnyMotion


@dataclass(frozen=True)
class CurveErrors:
    """Differences d = B - A of two curves over their common samples, rad."""

    rmse: float
    """Root mean square of d."""
    mae: float
    """Mean of its size."""
    median: float
    """Median of its size."""
    offset_removed: float
    """Root mean square of d without its mean."""
    largest: float
    """Difference of the largest size, with its sign."""
    at: float
    """Place of it on the axis: s, or share of the cycle or repetition."""
    correlation: float
    """Pearson's, of the curves; NaN if one is constant."""
    agreement: Agreement
    """With A as the reference."""


def error_sizes(curves: Sequence[Array]) -> dict[str, float]:
    """Return root mean square, mean and median size of differences (n,), at least one curve, and their root mean square
    without the mean of each curve. In little more memory than they take, as they may be of hours.
    """
    d = np.concatenate(curves)
    sizes = {"rmse": float(np.sqrt(np.mean(d**2)))}
    sizes["mae"] = float(np.mean(np.abs(d, out=d)))
    sizes["median"] = float(np.median(d, overwrite_input=True))
    np.concatenate([one - one.mean() for one in curves], out=d)
    return sizes | {"offset_removed": float(np.sqrt(np.mean(np.square(d, out=d))))}


def curve_errors(axis: Array, a: Array, b: Array) -> CurveErrors:
    """Compare two curves where both are known; axis: (P,) of the samples; a, b: (P,) rad, with at least one common
    sample.
    """
    known = np.isfinite(a) & np.isfinite(b)
    difference = (b - a)[known]
    worst = int(np.abs(difference).argmax())
    own, other = a[known] - a[known].mean(), b[known] - b[known].mean()
    size = float(np.sqrt(np.sum(own**2) * np.sum(other**2)))
    return CurveErrors(
        **error_sizes([difference]),
        largest=float(difference[worst]),
        at=float(axis[known][worst]),
        correlation=float(np.sum(own * other) / size) if size > 1e-12 else float("nan"),
        agreement=agreement_of([("", a[known], difference)]),
    )


By = Literal["time", "cycle", "repetition", "range"]
Pairs = Mapping[str, Callable[[], Pair]]  #: Angle -> what makes its samples
LEAST_SHARE: Final = 0.1  #: Smallest share of the common frames, or of all repeats, with which an angle is compared
LEAST_OF_RANGE: Final = 0.8
"""Smallest share of the common frames with which a range in time is tested: gaps are where angles are largest
or near a singular posture. Ranges of whole recordings: `RangeOfMotion.is_comparable`."""
HEADINGS: Final = ("pelvis_rotation", "pelvis_opensim_tilt", "pelvis_opensim_list", "pelvis_opensim_rotation")
"""Angles that depend on the direction of the world's axes, which two recordings do not share."""


@dataclass(frozen=True)
class Compared:
    """One side of a comparison."""

    name: str  #: How it is called in all output
    angles: ClinicalAngles
    strides: Spans = field(default_factory=dict)  #: Of the gait cycles, by side
    repetitions: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    """Kind ('squat', 'sit_to_stand') -> start and stop of each, s."""
    recording: str = ""  #: Name of the recording it was computed from; '' if unknown
    other_system: bool = False
    """Whether it is a table of coordinates: without bands, strides and, maybe, with a clock of its own."""
    own_export: bool = False  #: Whether such a table is of this package's own model, so that its zeros are the same
    notes: tuple[str, ...] = ()  #: What its gait cycles and angles do not show, and why
    not_gait: str = ""  #: Why its strides are not those of walking; '' if they are
    made: Made | None = None  #: How it was made, where the person is known
    side: str = ""  #: 'left' or 'right' where only the angles of that side count, by their names without it

    @property
    def columns(self) -> dict[str, int]:
        """Its angles by name, with their columns in `angles`."""
        prefix = f"{self.side}_" if self.side else ""
        return {name.removeprefix(prefix): k for k, name in enumerate(self.angles.names) if name.startswith(prefix)}

    @property
    def rows(self) -> tuple[AngleRow, ...]:
        """Those of its angles."""
        return tuple(replace(self.angles.rows[k], name=name) for name, k in self.columns.items())

    @property
    def known(self) -> frozenset[str]:
        """Names of its angles that have a value."""
        return frozenset(name for name, k in self.columns.items() if np.isfinite(self.angles.values[:, k]).any())

    def angle(self, name: str) -> ClinicalAngles:
        """Return one of its angles."""
        row = self.angles.rows[self.columns[name]]
        return replace(self.angles.select([row.name]), rows=(replace(row, name=name),))


@dataclass(frozen=True)
class AngleComparison:
    """One angle of A against B."""

    name: str  #: Name of the angle
    pair: Callable[[], Pair]
    """Makes the samples of A and B, which are too large to keep: curves over time, strides or repetitions, or the ends
    of the ranges of recordings."""
    share: float  #: As of the pair
    repeats: tuple[int, int]  #: Strides or repetitions of A and B that are compared; 1 for other axes
    positive: str  #: The movement that is positive
    changes: tuple[Change, ...]
    """Of the mean angle and of the range of motion; of the range alone without a common axis."""
    errors: CurveErrors | None  #: Of the curves; None without a common axis
    outside: float
    """Share of the samples in which 0 is outside the 95 % band of B - A; NaN without curves or bands."""

    @property
    def verdict(self) -> Verdict:
        """Changed if the mean or the range has."""
        verdicts = [found.verdict for found in self.changes]
        return next((v for v in Verdict if v in verdicts), Verdict.NOT_TESTED)

    @property
    def largest(self) -> Change:
        """The larger change among those with the verdict of the angle."""
        own = [found for found in self.changes if found.verdict is self.verdict]
        return max(own, key=lambda found: abs(found.difference))


@dataclass(frozen=True)
class Comparison:
    """Comparison of two motions."""

    a: Compared
    b: Compared
    by: By
    axis: Array | None  #: (P,) s or share of the cycle; None for ranges
    angles: tuple[AngleComparison, ...]  #: Compared angles, the largest difference first
    left_out: Mapping[str, str]  #: Angles that are not compared -> why
    shift: float = 0.0  #: [s] added to the times of B
    alignment: Alignment | None = None  #: Agreement of the two clocks; None without a common clock
    kind: str = ""  #: Kind of the repetitions
    shared: Mapping[str, float] = field(default_factory=dict)  #: Angle -> share of its variance that both have

    @property
    def changed(self) -> tuple[AngleComparison, ...]:
        """Angles that have changed."""
        return tuple(found for found in self.angles if found.verdict is Verdict.CHANGED)

    @property
    def identical(self) -> bool:
        """Whether the curves have the same values, to 0.01 deg, wherever they are compared."""
        every = [one.errors.largest for one in self.angles if one.errors is not None]
        every = every or [found.difference for one in self.angles for found in one.changes]
        return bool(max(map(abs, every)) < _SAME)


def compared(name: str, motion: AnyMotion, recording: str = "") -> Compared:
    """Return a motion, read in blocks, with its angles, strides and repetitions."""
    (angles,), paths = angles_and_paths(MotionSource.of(motion), angle_table(motion.skeleton.table))
    found = with_strides(name, angles, analyse_gait(gait_events(paths), angles))
    return replace(found, repetitions=repetition_spans(paths, angles), recording=recording)


def with_strides(name: str, angles: ClinicalAngles, gait: GaitAnalysis) -> Compared:
    """Return angles with their strides, without repetitions."""
    strides = {side: [(s.start, s.stop) for s in gait.counted if s.side == side] for side in SIDES}
    return Compared(name, angles, strides, notes=gait.notes, not_gait=gait.why_not)


def repetition_spans(paths: BodyPaths, angles: ClinicalAngles) -> dict[str, list[tuple[float, float]]]:
    """Return start and stop, s, of each repetition by its kind ('squat', 'sit_to_stand')."""
    spans: dict[str, list[tuple[float, float]]] = {}
    for kind in KINDS:
        found = find_repetitions(paths, angles, kind).repetitions
        ways = [(r.descent if kind == "squat" else r.ascent, r.ascent) for r in found]
        spans[kind] = [(first[0], last[1]) for first, last in ways if first and last]
    return spans


def sides_of(one: Compared) -> tuple[Compared, Compared]:
    """Return the left and the right side of a motion."""
    own = {side: {"": one.strides.get(side, [])} for side in ("left", "right")}
    left, right = (replace(one, name=side, side=side, strides=strides, made=None) for side, strides in own.items())
    return left, right


def compare(
    a: Compared,
    b: Compared,
    by: By,
    *,
    names: Sequence[str] = (),
    shift: float = 0.0,
    alignment: Alignment | None = None,
    kind: str = "squat",
) -> Comparison:
    """Compare two motions on one axis.

    Args:
        names: angles to compare; none for all that both have.
        shift: s, added to the times of B; of a comparison in time.

    Raises:
        InvalidInputError: the motions have no such axis, or no angle in common on it.
        UnknownNameError: a name that is none of an angle.
    """
    left_out = _left_out(a, b, by, names)
    common = common_angles(a, b)
    chosen = [name for name in (names or common) if name in common and name not in left_out]
    if by == "range":
        rows = [(one.name, row) for one in (a, b) for name in chosen for row in ranges_of_motion(one.angle(name))]
        left_out |= {row.name: f"{name}: {why}" for name, row in rows if (why := row.why_not_comparable)}
        chosen = [name for name in chosen if name not in left_out]
    axis, pair = _pairs(a, b, by, shift, kind)
    shared = shared_of((a.made, b.made), a.rows) if by in ("cycle", "repetition") else {}
    positive = {row.name: row.positive for row in a.rows}
    angles = _tested({name: partial(pair, name) for name in chosen}, by, axis, positive, shared)
    few = [name for name in chosen if name not in [one.name for one in angles]]
    left_out |= dict.fromkeys(few, "hardly any common sample is observed and reliable in both")
    if not angles:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
        raise InvalidInputError(f"compare: {a.name} and {b.name} have no common angle by {by} ({why})")
    ordered = tuple(sorted(angles, key=lambda one: -abs(one.changes[0].difference)))
    kind = kind if by == "repetition" else ""
    return Comparison(a, b, by, axis, ordered, left_out, shift, alignment, kind, shared)


def common_angles(a: Compared, b: Compared) -> tuple[str, ...]:
    """Return the angles that both have a value of."""
    both = a.known & b.known
    return tuple(row.name for row in a.rows if row.name in both)


def _left_out(a: Compared, b: Compared, by: By, names: Sequence[str]) -> dict[str, str]:
    """Angles that are not compared, and why; those that neither has are not mentioned."""
    known, every, out = (a.known, b.known), [row.name for row in a.rows], {}
    for one in (a, b):
        indices_of("clinical angle", names, [row.name for row in one.rows])  # raises for an unknown name
    for name in names or every:
        has = [name in own for own in known]
        if has[0] != has[1] or (names and not all(has)):
            missing = " and ".join(x.name for x, own in zip((a, b), has, strict=True) if not own)
            out[name] = f"not observed in {missing}"
        elif all(has) and not names and name in HEADINGS:
            if name.startswith("pelvis_opensim") and not (a.other_system or b.other_system):
                continue  # the same orientation as the pelvis angles
            if by != "time" or a.other_system or b.other_system:
                out[name] = "depends on the direction of the world's axes; name it in --angles to compare it"
    if not names:
        second = [n for n in every if n.startswith("pelvis_opensim") and n not in out]
        out |= dict.fromkeys(second, "the same orientation as the other pelvis angles, in another order")
    return out


def _pairs(a: Compared, b: Compared, by: By, shift: float, kind: str) -> tuple[Array | None, Callable[[str], Pair]]:
    """Common axis, and what makes the samples of an angle by its name."""
    if by == "time":
        times = a.angles.times[in_both(a.angles, b.angles, shift)]
        if not len(times):
            raise InvalidInputError(
                f"compare: {a.name} ({_span(a)}) and {b.name} ({_span(b)}) have no instant in common; "
                "give --shift or --align, or compare by cycle, repetition or range"
            )
        return times, lambda name: in_time(a.angle(name), b.angle(name), shift)
    if by == "range":
        return None, lambda name: in_range(a.angle(name), b.angle(name))
    spans = [x.strides if by == "cycle" else {"": x.repetitions.get(kind, ())} for x in (a, b)]
    for one, own in zip((a, b), spans, strict=True):
        if not any(own.values()):
            what = "complete gait cycle" if by == "cycle" else kind.replace("_", " ")
            raise InvalidInputError(f"compare: {one.name} has no {what}; compare by another axis (--by)")
    return PHASES, lambda name: over_phases(a.angle(name), b.angle(name), *spans)


def _span(one: Compared) -> str:
    return f"{one.angles.times[0]:.2f} to {one.angles.times[-1]:.2f} s"


def _tested(
    pairs: Pairs, by: By, axis: Array | None, positive: Mapping[str, str], shared: Mapping[str, float]
) -> list[AngleComparison]:
    """Differences of all angles with enough samples, tested together."""
    repeated, measures = by in ("cycle", "repetition"), ("range",) if axis is None else ("mean", "range")
    changes, out = [], []
    for name, make in pairs.items():
        pair = make()
        if pair.share < LEAST_SHARE:
            continue
        kind: Repeats = "none" if not repeated else "paired" if pair.paired else "independent"
        for measure in measures:
            a, b = (getattr(one, measure)() for one in (pair.a, pair.b))
            tested = repeated or axis is None or measure == "mean" or pair.share >= LEAST_OF_RANGE
            error, apart = (error_of(a, b, kind, share) for share in (shared.get(name, 0.0), 0.0))
            changes.append(change(measure, a.mean, b.mean, error, tested, apart))
        errors = None if axis is None else curve_errors(axis, pair.a.curve, pair.b.curve)
        repeats = len(pair.a.values), len(pair.b.values)
        outside = float("nan") if axis is None else _outside(pair)
        out.append(AngleComparison(name, make, pair.share, repeats, positive[name], (), errors, outside))
    found = iter(adjusted(changes))
    return [replace(one, changes=tuple(islice(found, len(measures)))) for one in out]


def _outside(pair: Pair) -> float:
    """`AngleComparison.outside` of curves."""
    if (sigma := pair.difference_sigma) is None:
        return float("nan")
    size = np.abs(pair.b.curve - pair.a.curve)
    known = np.isfinite(size)
    return float(np.mean(size[known] > BAND_95 * sigma[known]))


_SAME: Final = np.radians(0.005)
_LEAST_REPEATS: Final = 2  # strides of one side, or repetitions, of each motion
_SAME_ENDS: Final = 0.25  # [s] by which the ends of two results of one take may differ
_ALIKE: Final = 0.8  # agreement of motions of unknown recordings that count as one take
_LEAST_COMMON: Final = 0.5  # share of the shorter motion that overlaps with another system's


@dataclass(frozen=True)
class Choice:
    """An axis, and why it was chosen."""

    by: By
    why: str
    kind: str = "squat"  #: Of the repetitions


def agreement(a: Compared, b: Compared, shift: float = 0.0) -> Alignment | None:
    """Return the best shift of B beyond a given one; None if no common angle moves; shift: s, added to the times of B
    before.
    """
    moved = replace(b.angles, times=b.angles.times + shift)
    try:
        return align(a.angles, moved, common_angles(a, b))
    except InvalidInputError:
        return None


def choose_axis(a: Compared, b: Compared, clocks: Alignment | None, by: By | None = None) -> Choice:
    """Return the axis on which two motions of some `agreement` are compared; the reason is empty if it is given."""
    if by is not None:
        return _requested(a, b, by)
    if a.other_system or b.other_system:
        (start_a, stop_a), (start_b, stop_b) = _ends(a), _ends(b)
        shorter = max(min(stop_a - start_a, stop_b - start_b), 1e-9)
        if (min(stop_a, stop_b) - max(start_a, start_b)) / shorter >= _LEAST_COMMON:
            return Choice("time", "a table of coordinates is compared at the same instants")
        return Choice("range", "the time spans hardly overlap; --align finds a shift")
    if (reason := _one_take(a, b, clocks)) is not None:
        return Choice("time", reason)
    return repeated_axis(a, b) or Choice(
        "range", "they are different recordings, and not both have gait cycles or repetitions"
    )


def compare_sides(
    one: Compared, by: By | None = None, *, names: Sequence[str] = (), kind: str = ""
) -> tuple[Comparison, str]:
    """Return left (A) against right (B) of a motion, and why on this axis, for the command and the report.

    Without one it is by gait cycle if the motion is walking with two strides of each side, else by the ranges of the
    whole recording: its repetitions may be of both legs, of the right or of the left one. `InvalidInputError`,
    `UnknownNameError`: see `compare`.

    Args:
        names, kind: see `compare`.
    """
    left, right = sides_of(one)
    if by is not None:
        choice = _requested(left, right, by)
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


def _requested(a: Compared, b: Compared, by: By) -> Choice:
    """Axis of a request; of repetitions the kind that both have most of."""
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
