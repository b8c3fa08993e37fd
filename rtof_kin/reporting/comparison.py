"""A comparison as a document: what against what, on which axis, what has changed, and what to be careful about.

``comparison.csv`` has a row for each angle and measure, with units in the names of its columns and empty cells where
there is no value; ``comparison.json`` the sentences, the settings and the same numbers; ``spm.json`` and ``spm.png``
the statistical parametric mapping, on request.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from rtof_kin.body.motion_file import EARLIER, MOTION, MotionReader, motion_path
from rtof_kin.clinical import comparison as clinical
from rtof_kin.clinical.agreement import NO_AGREEMENT
from rtof_kin.clinical.angles import opensim_angles
from rtof_kin.clinical.comparison import AngleComparison, By, Compared, Comparison
from rtof_kin.clinical.comparison_change import LEVEL, Change, Verdict
from rtof_kin.clinical.comparison_samples import POOR, Alignment
from rtof_kin.clinical.comparison_spm import ComparisonSpm, compare_spm
from rtof_kin.clinical.gait import PHASES
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import some
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.data.confidence import BAND_95
from rtof_kin.formats.opensim import SUFFIXES, read_opensim_table
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.document import (
    Badge,
    Cell,
    Document,
    Figure,
    Section,
    Table,
    fixed,
    label_panel,
    number,
    subplots,
)
from rtof_kin.reporting.plot_data import MOST_SAMPLES, Data, packed, shown_frames
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.reporting.visit_folders import setup_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

_REPEATED: Final = {"squat": "bend of the knees (squat or lunge)", "sit_to_stand": "rise from a seat"}
_MOST: Final = 3  # changes that are named
_PRINTED: Final = 12  # angles in the printed table, unless they are chosen
_LATE: Final = 0.04  # [s] a better shift than this is pointed out
_BETTER: Final = 0.02  # if the agreement is better by this
_OFTEN: Final = 0.2  # share of the samples outside the band of the difference, of which 0.05 are expected
_LISTED: Final = 6  # coordinates that a note lists
_TENTHS: Final = 10  # packed numbers are tenths of a degree


def compare(
    a: str | Path,
    b: str | Path | None = None,
    *,
    by: By | None = None,
    shift: float | None = None,
    align: bool = False,
    repetitions: str = "",
    angles: Sequence[str] = (),
    spm: bool = False,
) -> Document:
    """Compare two motions, or the left (A) and right (B) side of one, angle by angle.

    >>> from rtof_kin import compare
    >>> found = compare("out/motion", angles=["knee_flexion"], by="range")
    >>> "right" in found.headline
    True

    Args:
        a, b: see `read_compared`; without b the sides of a are compared.
        by: common axis; default: chosen from the data, and said.
        shift: s, to add to the times of b. align: estimate it.
        repetitions: what is repeated, 'squat' or 'sit_to_stand'. angles: to compare; fewer are tested more sharply.
        spm: add statistical parametric mapping.

    Raises:
        FileFormatError: a file is missing or damaged. InvalidInputError: nothing can be compared.
    """
    shifted = align or shift is not None
    if shifted and (b is None or by not in (None, "time")):
        raise InvalidInputError("compare: --shift and --align are for two motions compared --by time")
    if b is None:
        found, why = clinical.compare_sides(read_compared(a), by, names=angles, kind=repetitions)
    else:
        first, second = read_compared(a), read_compared(b)
        names = distinct(first, second, (a, b))
        first, second = replace(first, name=names[0]), replace(second, name=names[1])
        clocks = clinical.agreement(first, second)
        choice = clinical.choose_axis(first, second, clocks, "time" if shifted else by)
        if align and clocks is None:
            raise InvalidInputError("compare: no common angle moves, so that --align finds no shift; give --shift")
        added = clocks.shift if align and clocks is not None else shift or 0.0
        if choice.by != "time":
            clocks = None
        elif added:
            clocks = clinical.agreement(first, second, added)
        kind, why = repetitions or choice.kind, choice.why
        found = clinical.compare(first, second, choice.by, names=angles, shift=added, alignment=clocks, kind=kind)
    return document(found, why, compare_spm(found) if spm else None, all_printed=bool(angles))


def document(
    found: Comparison, why: str = "", mapped: ComparisonSpm | None = None, all_printed: bool = False
) -> Document:
    """Return a comparison as a document; why: of the choice of the axis; '' if it was given; mapped: its SPM;
    all_printed: whether the terminal shows all angles.
    """
    headline, *others = _opening(found, why)
    names = Markup('<p class="legend"><span class="key A"></span> A: {} <span class="key B"></span> B: {}</p>')
    errors = [_error_cells(found, one) for one in found.angles if one.errors is not None]
    no_axis = "The two have no common axis, so there are no curves: see the ranges above."
    left_out = tuple(_by_reason(found.left_out))
    return Document(
        "comparison",
        f"{found.a.name} and {found.b.name}: comparison of joint angles",
        headline,
        others,
        _cautions(found),
        printed=[*_printed(found, all_printed), *(spm_lines(mapped) if mapped else ())],
        sections=[
            Section("differences", "Differences", [_ABOUT_DIFFERENCES, _differences(found)]),
            Section(
                "errors",
                "Errors of the curves",
                [_ABOUT_ERRORS, Table(_ERRORS, errors, kind="errors") if errors else no_axis],
            ),
            Section("curves", "Curves", [*([] if found.axis is not None else [no_axis]), _ABOUT_CURVES]),
            Section("left-out", "Not compared", [left_out or "Every angle that is observed in either is compared."]),
        ],
        figures=[Figure("spm", "SPM{t} of each angle over the cycle", lambda: spm_figure(mapped, found))]
        if mapped and mapped.angles
        else [],
        tables={"comparison.csv": table(found)},
        facts=_facts(found),
        data={"spm.json": _spm_facts(mapped)} if mapped else {},
        lead=names.format(found.a.name, found.b.name),
        charts=_charts(found),
    )


def _by_reason(reasons: Mapping[str, str]) -> list[str]:
    """Reason: the angles that have it."""
    out: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        out.setdefault(reason, []).append(label(name))
    return [f"{reason}: {', '.join(names)}" for reason, names in out.items()]


# --- what is compared ----------------------------------------------------------------------------


def read_compared(path: str | Path) -> Compared:
    """Read one side of a comparison. `FileFormatError`: it is none of these, or damaged.

    Args:
        path: output folder of reconstruct or run, a ``motion.h5``, or an OpenSim ``.mot`` or ``.sto``.
    """
    path = Path(path)
    if path.suffix.lower() in SUFFIXES:
        return _other_system(path)
    file = motion_path(path)
    recording, mode, certified, made = "", "", tuple[str, ...](), None
    if (summary := file.parent / SUMMARY).is_file():
        found = read_summary(summary)
        recording, mode, made = found.recording, found.mode, setup_of(found).made
        if found.certificate is not None:
            certified = found.certificate.sentences[:1]
    named = path.resolve().parent if path.name in (MOTION, EARLIER) and not path.is_dir() else path.resolve()
    with MotionReader(file) as reader:
        mode = mode or reader.mode
        sides = clinical.compared(named.name + (f" ({mode})" if mode else ""), reader, recording)
    return_free_memory()  # before another one is read
    return replace(sides, notes=(*sides.notes, *certified), made=made)


def distinct(a: Compared, b: Compared, paths: tuple[str | Path, str | Path]) -> tuple[str, str]:
    """Return names of both that differ, with as many of their folders as tell them apart."""
    if a.name != b.name:
        return a.name, b.name
    parts = [Path(path).resolve().parts[1:] for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        first, second = ("/".join(own[-count:]) for own in parts)
        if first != second:
            return first, second
    return f"{a.name}, first", f"{b.name}, second"


def _other_system(path: Path) -> Compared:
    table = read_opensim_table(path)
    with reading(path):
        angles, others = opensim_angles(table)
    notes: tuple[str, ...] = ()
    if others:
        notes = (f"coordinates that are no clinical angle of this package: {some(others, _LISTED)}",)
    return Compared(path.name, angles, other_system=True, own_export=bool(table.skeleton), notes=notes)


# --- words ---------------------------------------------------------------------------------------


def _opening(found: Comparison, why: str) -> list[str]:
    """Return the first lines: identity, what against what, the axis (and why, if it was chosen), and the changes."""
    lines = ["A and B have the same values, to 0.01 deg, wherever they are compared."] if found.identical else []
    clocks = found.alignment
    if found.by == "time" and clocks is not None and not found.identical and not _agreement(clocks) >= POOR:
        lines.append(
            f"The curves hardly agree (agreement {_agreement(clocks):.2f} of 1): they may be different "
            "movements, or their clocks may differ."
        )
    stated = any(np.isfinite(change.sigma) for one in found.angles for change in one.changes)
    meaning = ", \u00b1 half of the 95 % interval of the angle alone" if stated else ""
    lines.append(f"A is {found.a.name}, B is {found.b.name}; differences are B - A{meaning}.")
    lines.append(_axis(found) + (f" Chosen because {why}." if why else ""))
    return [*lines, *_changes(found), *shared_line(found.shared, (c for one in found.angles for c in one.changes))]


def shared_line(shared: Mapping[str, float], changes: Iterable[Change | None]) -> list[str]:
    """Return by how much errors that recordings of a known person share lower the detectable change; empty where none
    are shared.
    """
    both = [(c.detectable, c.detectable_independent) for c in changes if c is not None]
    sizes = [pair for pair in both if np.isfinite(pair).all()]
    if not (shared and sizes):
        return []
    now, apart = (degrees(float(np.median(own))) for own in zip(*sizes, strict=True))
    return [
        "All were made with the same bones and posture of the person's file: in angles that are not up to the mounting "
        f"of sensors {100 * max(shared.values()):.0f} % of the variance of the stated errors is shared and cancels. "
        f"Smallest detectable change {now} deg (median of {len(sizes)}); of independent recordings it would be "
        f"{apart} deg."
    ]


def _cautions(found: Comparison) -> list[str]:
    """Return what to be careful about."""
    lines = [*_clock_cautions(found), *_band_cautions(found)]
    a, b = found.a, found.b
    if found.by == "range":
        lines.append(
            "Ranges are those of the whole recordings: they differ if the person did something else, and how "
            "much they vary from one recording to the next is not known and not included"
        )
    lines += [
        f"The zero of {one.name} is that of its own model: a constant difference may be one of "
        "definition; see the errors without offset and the ranges"
        for one in (a, b)
        if one.other_system and not one.own_export
    ]
    if often := sorted((one for one in found.angles if one.outside > _OFTEN), key=lambda one: -one.outside):
        names = some([f"{label(one.name)} ({100 * one.outside:.0f} %)" for one in often])
        lines.append(
            "The curves differ by more than their 95 % bands allow in a large share of the samples, whatever "
            f"their means: {names}"
        )
    single = [letter for k, letter in enumerate("AB") if any(one.repeats[k] == 1 for one in found.angles)]
    if found.by in ("cycle", "repetition") and single:
        lines.append(
            f"{' and '.join(single)} has angles with a single repeat, whose spread is taken from the other"
            if len(single) == 1
            else "Some angles have a single repeat in both: how much repeats vary is not included there"
        )
    little = [one.name for one in found.angles if one.share < 0.5]
    if little:
        what = "frames" if found.by in ("time", "range") else "repeats"
        names = some([label(name) for name in little])
        lines.append(f"Less than half of the {what} is observed and reliable in both: {names}")
    noted = (a,) if a.notes == b.notes else (a, b)
    if found.by == "cycle":
        lines += [f"{one.name} is probably not walking: {one.not_gait}" for one in noted if one.not_gait]
    if found.by == "cycle" or a.other_system or b.other_system:
        lines += [f"{one.name}: {note}" for one in noted for note in one.notes]
    return lines


def degrees(value: float, sign: bool = False, digits: int = 1) -> str:
    """Return an angle, rad, in degrees; '' for NaN."""
    return fixed(float(np.degrees(value)), digits, sign)


def change_text(one: AngleComparison, change: Change) -> str:
    """Return a change in words, e.g. 'right knee flexion (mean) by -12.1 \u00b1 6.0 deg'."""
    return f"{label(one.name)} ({change.measure}) by {difference_text(change)} deg"


def difference_text(change: Change) -> str:
    """Return a difference with half of its 95 % interval, degrees, as in the report, e.g. '-12.1 \u00b1 6.0'."""
    half = change.interval[1] - change.difference
    band = f" \u00b1 {degrees(half)}" if np.isfinite(half) else ""
    return degrees(change.difference, True) + band


def _agreement(clocks: Alignment) -> float:
    """Agreement at the shift that is used, which is the zero of the clocks that were compared."""
    return clocks.unshifted if np.isfinite(clocks.unshifted) else 0.0


def _axis(found: Comparison) -> str:
    if found.by == "time":
        assert found.axis is not None
        text = f"Compared at the same instants, {found.axis[0]:.2f} to {found.axis[-1]:.2f} s of A's clock"
        if found.shift:
            text += f", with B shifted by {found.shift:+.3f} s"
        if found.alignment is not None:
            text += f" (agreement of angular velocities {_agreement(found.alignment):.2f} of 1)"
        shares = [f"{100 * find(one.share for one in found.angles):.0f}" for find in (min, max)]
        span = " to ".join(dict.fromkeys(shares))
        return f"{text}; {span} % of the frames, by angle, are observed and reliable in both."
    if found.by == "range":
        return "Compared by the ranges of motion of the whole recordings, without a common axis."
    what = "gait cycle, heel strike to heel strike" if found.by == "cycle" else _REPEATED[found.kind]
    times, each = ("stride", " on each side") if found.by == "cycle" else ("repetition", "")
    counts = [max(one.repeats[i] for one in found.angles) for i in (0, 1)]
    first, second = (f"{count} {times}" + ("s" if count != 1 else "") for count in counts)
    return f"Compared over the {what}, at {len(PHASES)} phases; means over up to {first} of A and {second} of B{each}."


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
    if not found.identical:
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
    if found.by != "time" or clocks is None:
        return []
    lines, best = [], f"B shifted by {found.shift + clocks.shift:+.2f} s"
    if clocks.agreement > _agreement(clocks) + _BETTER and abs(clocks.shift) > _LATE:
        lines.append(
            f"No shift makes the curves agree (at most {clocks.agreement:.2f}, with {best}): different movements, or "
            "different people"
            if clocks.poor
            else f"The curves agree better ({clocks.agreement:.2f}) with {best}: if the clocks differ, use --align"
        )
    if found.shift:
        text = f"The shift of B is {found.shift:+.3f}"
        text += f" \u00b1 {clocks.sigma:.3f} s" if np.isfinite(clocks.sigma) else " s"
        if np.isfinite(clocks.rival):
            text += f"; the second best is {found.shift + clocks.rival:+.2f} s (agreement {clocks.rival_agreement:.2f})"
        if clocks.ambiguous:
            text += ", nearly as good, as in a periodic movement: check it by an event that both show"
        lines.append(text)
    return lines


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


# --- tables --------------------------------------------------------------------------------------

_DIFFERENCES: Final = ("angle", "measure", "B - A", "verdict", "95 % interval", "detectable", "p (Holm)", "A", "B")
_ERRORS: Final = (
    *("angle", "RMSE", "MAE", "median", "without offset", "NRMSE", "range error", "bias", "limits of agreement"),
    *("largest", "at", "correlation", "CMC", "outside band", "compared"),
)
_ABOUT_DIFFERENCES: Final = Markup(
    '<p class="note">Degrees. Mean angle, and range of motion, of A and B; their difference with the 95 % interval of '
    "this angle alone (&plusmn; is half of it). The verdict is that of a two-sided test at {:.0f} % for all rows "
    "together (Holm): a difference of the size <i>detectable</i> is called changed whatever the others show, and below "
    "it a change could be missed.</p>"
).format(100 * LEVEL)
_ABOUT_ERRORS: Final = Markup(
    '<p class="note">Degrees, of B - A over the samples that are observed and reliable in both: root mean square, mean '
    "and median of the size, root mean square without the mean difference, and the largest. NRMSE: of the range of A. "
    "Range error: difference of the ranges of both. Limits: bias &plusmn; 1.96 standard deviations of these samples "
    "(Bland and Altman 1986). CMC: coefficient of multiple correlation (Ferrari et al. 2010); offsets count.</p>"
)
_ABOUT_CURVES: Final = Markup(
    '<p class="note">Bands are 95 % intervals, each of its motion\'s confidence and of the spread between repeats; '
    "those of B - A as of independent errors. Gaps: not compared. Point at a curve to read its values.</p>"
    '<div class="charts pairs" id="curve-charts"></div>'
)


def _printed(found: Comparison, all_of_them: bool) -> list[Table | str]:
    """The largest differences; errors only where there are curves."""
    shown = found.angles if all_of_them else found.angles[:_PRINTED]
    curves = found.axis is not None
    columns = ("B - A,\nmean", "B - A,\nrange") if curves else ("A,\nrange", "B,\nrange", "B - A,\nrange")
    errors = ("RMSE", "MAE", "me-\ndian", "no\noffset") if curves else ()
    rows = []
    for one in shown:
        cells = [difference_text(change) for change in one.changes]
        if one.errors is None:
            cells = [degrees(one.changes[0].a), degrees(one.changes[0].b), *cells]
        else:
            cells += map(degrees, (one.errors.rmse, one.errors.mae, one.errors.median, one.errors.offset_removed))
        changed = [change.measure for change in one.changes if change.verdict is Verdict.CHANGED]
        verdict = "not tested" if one.verdict is Verdict.NOT_TESTED else "not shown"
        rows.append((label(one.name), *cells, "both" if len(changed) > 1 else changed[0] if changed else verdict))
    left = len(found.angles) - len(shown)
    return [
        Table(("angle [deg]", *columns, *errors, "changed"), rows),
        *([f"and {left} smaller ones: -o DIR, or --angles"] if left else []),
    ]


def table(found: Comparison) -> Table:
    """Return the rows of all angles and measures, None for what there is not."""
    return Table.of([_row(one, change) for one in found.angles for change in one.changes])


_SIZES: Final = {
    "rmse_deg": "rmse",
    "mae_deg": "mae",
    "median_absolute_error_deg": "median",
    "rmse_without_offset_deg": "offset_removed",
    "largest_deg": "largest",
}
"""Column -> field of `CurveErrors`."""


def _row(one: AngleComparison, change: Change) -> dict[str, Cell]:
    errors = one.errors

    def deg(radians: float) -> float | None:
        return number(np.degrees(radians))

    low, high = map(deg, change.interval)
    return {
        "angle": one.name,
        "positive": one.positive,
        "measure": change.measure,
        "verdict": change.verdict.value,
        "a_deg": deg(change.a),
        "b_deg": deg(change.b),
        "difference_deg": deg(change.difference),
        "difference_sd_deg": deg(change.sigma),
        "interval_low_deg": low,
        "interval_high_deg": high,
        "detectable_deg": deg(change.detectable),
        "detectable_independent_deg": deg(change.detectable_independent),
        "p": number(change.p),
        "p_holm": number(change.p_adjusted),
        **{name: None if errors is None else deg(getattr(errors, field)) for name, field in _SIZES.items()},
        "largest_at": None if errors is None else number(errors.at),
        "correlation": None if errors is None else number(errors.correlation),
        **{name: number(value) for name, value in (errors.agreement if errors else NO_AGREEMENT).figures.items()},
        "outside_band_share": number(one.outside),
        "share": number(one.share),
        "repeats_a": one.repeats[0],
        "repeats_b": one.repeats[1],
    }


def _differences(found: Comparison) -> Table:
    rows = []
    for one in found.angles:
        name = Markup("{} <small>{}</small>").format(label(one.name), one.positive)
        again = Markup('<span class="again">{}</span>').format(name)
        rows += [(again if k else name, *_change_cells(change)) for k, change in enumerate(one.changes)]
    return Table(_DIFFERENCES, rows, kind="differences")


def _change_cells(change: Change) -> tuple[Cell, ...]:
    size, *half = difference_text(change).partition(" ")
    low, high = (degrees(end, True) for end in change.interval)
    p = fixed(change.p_adjusted, 3)
    return (
        change.measure,
        Markup("<b>{}</b>{}").format(size, "".join(half)),
        Badge(change.verdict.value, "warn" if change.verdict is Verdict.CHANGED else "not-checked"),
        f"{low} to {high}" if low else "",
        degrees(change.detectable),
        "< 0.001" if p == "0.000" else p,
        degrees(change.a),
        degrees(change.b),
    )


def _error_cells(found: Comparison, one: AngleComparison) -> tuple[str, ...]:
    errors = one.errors
    assert errors is not None
    agreed = errors.agreement
    share = f"{100 * one.share:.0f} %"
    if found.by != "time":
        share += f" ({one.repeats[0]} and {one.repeats[1]})"
    return (
        label(one.name),
        *map(degrees, (errors.rmse, errors.mae, errors.median, errors.offset_removed)),
        f"{100 * agreed.nrmse:.0f} %" if agreed.nrmse == agreed.nrmse else "",
        degrees(agreed.range_error),
        degrees(agreed.bias, True),
        " to ".join(filter(None, (degrees(end, True) for end in agreed[4:6]))),
        degrees(errors.largest, True),
        f"{errors.at:.2f} s" if found.by == "time" else f"{100 * errors.at:.0f} %",
        fixed(errors.correlation, 2),
        fixed(agreed.cmc, 2),
        f"{100 * one.outside:.0f} %" if one.outside == one.outside else "",
        share,
    )


def _facts(found: Comparison) -> dict[str, Any]:
    clocks, shifts = found.alignment, dict[str, float]()
    if clocks is not None:
        shifts = {
            "at_the_shift": clocks.unshifted,
            "best": clocks.agreement,
            "best_further_shift_s": clocks.shift,
            "best_further_shift_sd_s": clocks.sigma,
            "second_best_further_shift_s": clocks.rival,
            "second_best": clocks.rival_agreement,
        }
    return {
        "a": found.a.name,
        "b": found.b.name,
        "differences": "B - A",
        "by": found.by,
        "repetitions": found.kind,
        "shift_of_b_s": found.shift,
        "agreement": {name: number(value) for name, value in shifts.items()} or None,
        "identical": found.identical,
        "level": LEVEL,
        "correction": "Holm, over all rows with a p",
        "largest_at_is": "s" if found.by == "time" else "share of the cycle or repetition",
        "angles": table(found).records(),
        "not_compared": dict(found.left_out),
    }


def _charts(found: Comparison) -> Data:
    """Each angle of A over B, and their difference, with 95 % bands; none without a common axis."""
    if found.axis is None:
        return {"x": [], "groups": [], "by": found.by}
    shown = slice(None)
    if found.by == "time":
        shown = slice(None, None, max(shown_frames(found.axis).step, math.ceil(len(found.axis) / MOST_SAMPLES)))

    def series(kind: str, values: Array, sigma: Array | None, count: int = 0) -> Data:
        out: Data = {"side": kind, "y": packed(np.degrees(values[shown]), _TENTHS)}
        if sigma is not None:
            out["half"] = packed(BAND_95 * np.degrees(sigma[shown]), _TENTHS)
        return out | ({"n": count} if count else {})

    groups = []
    for one in found.angles:
        pair, name = one.pair(), label(one.name)
        a, b, counts = pair.a.curve, pair.b.curve, one.repeats if max(one.repeats) > 1 else (0, 0)
        both = [series("A", a, pair.a.curve_sigma, counts[0]), series("B", b, pair.b.curve_sigma, counts[1])]
        groups.append({"name": name, "positive": one.positive, "series": both})
        groups.append({"name": f"{name}: B - A", "series": [series("difference", b - a, pair.difference_sigma)]})
    scale = 1.0 if found.by == "time" else 100.0
    return {"x": [round(scale * float(x), 4) for x in found.axis[shown]], "groups": groups, "by": found.by}


# --- statistical parametric mapping ---------------------------------------------------------------

_DRAWN: Final = 12  # angles of the figure
_PANELS: Final = 3


def spm_lines(found: ComparisonSpm) -> list[str]:
    """Return the clusters in words, and what to be careful about."""
    count = len(found.angles)
    lines = []
    for one in found.angles:
        for cluster in one.clusters:
            band = {None: "no bands", True: "beyond the band of B - A", False: "within the band of B - A"}
            p = "p < 0.001" if cluster.p < 0.001 else f"p = {cluster.p:.3f}"
            lines.append(
                f"{label(one.name)}: {100 * cluster.start:.0f} to {100 * cluster.stop:.0f} % of the cycle, "
                f"{'B' if cluster.sign > 0 else 'A'} larger, {p}, {band[cluster.beyond_bands]}"
            )
    head = f"SPM{{t}} of {count} angles, each at level {found.level:.2g}: {len(lines) or 'no'} clusters"
    if not count:
        head = "SPM{t}: no angle can be tested"
    caution = (
        "SPM knows the spread between repeats alone: errors that last through a recording make clusters "
        "too, so a cluster within the band of B - A is no change that was shown"
    )
    missing = [f"SPM not computed: {text}" for text in _by_reason(found.not_tested)]
    return [head, *lines, *([caution] if lines else []), *missing]


def _spm_facts(found: ComparisonSpm) -> dict[str, Any]:
    angles = [
        {
            "angle": one.name,
            "test": "paired" if one.paired else "two-sample, Welch",
            "repeats": list(one.repeats),
            "degrees_of_freedom": one.dof,
            "threshold": one.threshold,
            "t": list(map(number, one.t)),
            "clusters": [
                {"start": c.start, "stop": c.stop, "p": c.p, "larger": "B" if c.sign > 0 else "A"}
                | {"beyond_bands": c.beyond_bands}
                for c in one.clusters
            ],
        }
        for one in found.angles
    ]
    return {
        "differences": "B - A",
        "level_of_each_angle": found.level,
        "correction": "Bonferroni over angles",
        "phases": found.phases.tolist(),
        "sentences": spm_lines(found),
        "angles": angles,
        "not_tested": found.not_tested,
    }


def spm_figure(found: ComparisonSpm, comparison: Comparison) -> Plot:
    """Plot t over the cycle with threshold and clusters; angles with clusters first, a dozen at most."""
    shown = sorted(found.angles, key=lambda one: (not one.clusters, -float(np.abs(one.t).max())))[:_DRAWN]
    height = math.ceil(len(shown) / _PANELS)
    figure, axes = subplots(height, _PANELS, (12, 0.8 + 2.6 * height), sharex=True)
    x = 100 * found.phases
    for ax, one in zip(axes.flat, shown, strict=False):
        ax.plot(x, one.t, color="0.15", lw=1.2)
        for sign in (-1, 1):
            ax.axhline(sign * one.threshold, color="#c0392b", lw=0.8, ls="--")
        for cluster in one.clusters:
            color = "#c0392b" if cluster.beyond_bands else "0.5"
            ax.axvspan(100 * cluster.start, 100 * cluster.stop, color=color, alpha=0.3, lw=0)
        label_panel(ax, label(one.name), "SPM{t}, B - A")
    for ax in axes.flat[len(shown) :]:
        ax.set_visible(False)
    figure.suptitle(
        f"{comparison.a.name} (A) and {comparison.b.name} (B) over the cycle [%]: dashed, threshold; "
        "clusters: red beyond the band of B - A, grey not"
    )
    return figure
