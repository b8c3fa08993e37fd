"""Errors of joint angles as a document, of one motion or of a data set, beside published values of the same metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.clinical.angle_errors import ALL, AngleErrors, angle_differences, error_rows
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles, opensim_angles
from rtof_kin.clinical.comparison_samples import align
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.core.over_time import Stream
from rtof_kin.datasets.public_sets import Movement
from rtof_kin.formats.motion_views import AnyMotion
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.markers.trials import MarkerResult
from rtof_kin.protocols.published import METRICS, PUBLISHED, WITHOUT_METRIC, Metric
from rtof_kin.protocols.tables import NAME, Table
from rtof_kin.recording.recording import RecordingSource
from rtof_kin.reporting import document
from rtof_kin.reporting.document import Document, Figure, Section, number, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

CSV: Final = "angle_errors.csv"
HARDLY: Final = "the movements hardly agree at any shift"  #: Of a motion whose clock was not found
_COLUMNS: Final = {"joint angle": 0, "movement": 0, "takes": 0, "samples": 0, "RMSE": 1, "mean abs.": 1} | {
    "median abs.": 1,
    "RMSE, no offset": 1,
    "offset": 1,
    "in 95 % band": 0,
}
"""Columns with their digits."""
_AGREEMENT: Final = {"joint angle": 0, "movement": 0, "NRMSE [%]": 0, "CMC": 2, "range error": 1} | {
    name: 1 for name in ("bias", "limit low", "limit high", "range bias", "range low", "range high")
}
_AGREED: Final = (
    "Degrees. NRMSE: of the range of the reference in each take. CMC: coefficient of multiple correlation (Ferrari et "
    "al. 2010); offsets count, and it is '-' where the curves differ more than they move. Range error: mean size of "
    "the difference of the ranges of motion of a take and side.",
    "Limits: bias -+ 1.96 s, s^2 the variance within plus between people (Bland and Altman 2007); none of a single "
    "known person; where people are not known the spread alone. First of the angle over samples, then of its range.",
)
_NOTES: Final = (
    "Degrees; estimate minus reference. Both sides of a joint are pooled. Offset: mean difference. No "
    "offset: RMSE after each take's own mean difference of each angle is removed.",
    "In 95 % band: percent of the samples within 1.96 of the estimate's own standard deviations of the "
    "reference, whose own errors and definition count as errors here.",
    "Samples are pooled and not independent: the number of takes says how sure a value is.",
)
_COLOURS: Final[dict[Metric, str]] = {"rmse": "#4c78a8", "mae": "#e08214", "median": "#2a9d5c"}


def against_recording(motion: AnyMotion, recording: RecordingSource, movement: Movement = "other") -> Document:
    """Compare the angles of a motion with the truth of a recording, on one clock and with one definition.
    `InvalidInputError`: the recording has no truth, or no angle is in both.
    """
    if (truth := recording.streams.truth) is None:
        raise InvalidInputError(f"recording {recording.name}: has no truth to compare with")
    seen = Stream(truth.times, lambda rows: all_observed(truth.part(rows)))
    estimate = clinical_angles(motion)
    return_free_memory()
    reference = clinical_angles(seen, recording.facts.skeleton)
    return_free_memory()
    found, left_out = angle_differences(estimate, reference, movement, recording.name)
    del estimate, reference  # the differences are as large
    if not found:
        raise InvalidInputError(f"recording {recording.name}: no angle of its truth is observed in the motion")
    names = [name for name, reason in left_out.items() if "estimate" in reason]
    notes = [f"Not observed in the motion: {', '.join(names)}."] if names else []
    title = f"Joint angles against the truth of {recording.name}"
    headline = f"{title}: {len(found)} angles, on the recording's own clock."
    return angle_document(error_rows(found, [movement]), title, headline, notes)


def against_opensim(motion: AnyMotion, path: Path, movement: Movement = "other", reach: float = 1.0) -> Document:
    """Compare with OpenSim's coordinates, whose zeros are those of their model; the clocks are aligned.

    The file is a ``.mot`` or ``.sto``; differences of the clocks up to `reach`, s, are searched. `FileFormatError`: no
    such table; `InvalidInputError`: no angle is in both.
    """
    with reading(path):
        reference, _ = opensim_angles(read_opensim_table(path))
    return _with_other_clock(motion, reference, path, movement, reach)


def against_markers(motion: AnyMotion, path: Path, trial: MarkerResult, movement: Movement = "other") -> Document:
    """Compare with the motion of a marker trial, whose clock may differ by any time; `path`: of the trial, for names.
    `InvalidInputError`: no angle is in both at the same time.
    """
    return _with_other_clock(motion, clinical_angles(trial.motion), path, movement, np.inf, (trial.headline,))


def _with_other_clock(
    motion: AnyMotion,
    reference: ClinicalAngles,
    path: Path,
    movement: Movement,
    reach: float,
    notes: Sequence[str] = (),
) -> Document:
    """Compare with angles of another clock, differences of which up to `reach`, s, are searched."""
    estimate = clinical_angles(motion)
    clock = clock_shift(estimate, reference, reference.names, reach)
    found, left_out = angle_differences(estimate, reference, movement, path.stem, (), clock["shift_s"])
    if not found:
        raise InvalidInputError(f"{path}: no angle is in it and in the motion at the same time")
    names = [name for name, reason in left_out.items() if not reason.startswith("not in the reference")]
    if names:
        left = f"Left out, as not observed in the motion, fixed in the file, or headings: {', '.join(names)}."
        notes = (*notes, left)
    title = f"Joint angles against {path.name}"
    said = f"{clock['shift_s']:+.3f} s were added to its times ({clock['how']})"
    headline = f"{title}: {len(found)} angles; {said}."
    return angle_document(error_rows(found, [movement]), title, headline, notes)


def clock_shift(
    estimate: ClinicalAngles, reference: ClinicalAngles, names: Sequence[str], reach: float
) -> dict[str, Any]:
    """Return the shift of the reference's clock, ``shift_s``, ``how`` it was found, and what it rests on.

    Shifts up to `reach`, s, are searched.
    """
    common = [
        name
        for name in names
        if name in estimate.names and np.isfinite(estimate[name]).any() and np.isfinite(reference[name]).any()
    ]
    try:
        found = align(estimate, reference, common, reach)
    except InvalidInputError as error:
        return {"shift_s": 0.0, "how": f"as recorded: no shift was found ({error})"}
    facts = {
        "found_s": found.shift,
        "sigma_s": found.sigma,
        "agreement": found.agreement,
        "agreement_as_recorded": found.unshifted,
    }
    if found.poor:
        return facts | {"shift_s": 0.0, "how": f"as recorded: {HARDLY}"}
    how = f"estimated within {reach:g} s" if np.isfinite(reach) else "estimated among all shifts"
    if abs(found.shift) > 0.95 * reach:
        how += ", at the edge of what was searched"
    if found.ambiguous:
        how += f"; {found.rival:+.2f} s agrees nearly as well"
    return facts | {"shift_s": found.shift, "how": how}


# --- the document --------------------------------------------------------------------------------


def angle_document(
    rows: Sequence[AngleErrors],
    title: str,
    headline: str,
    notes: Sequence[str] = (),
    further: Sequence[Table] = (),
    facts: Mapping[str, Any] | None = None,
    files: Mapping[str, document.Table] | None = None,
    alarm: bool = False,
) -> Document:
    """Return errors of angles (`error_rows`) with their tables, figure and page.

    Title and notes are of the table of errors; further tables stand below it, and facts and files are added.
    """
    tables = (error_table(rows, title, notes), agreement_table(rows), published_table(rows), *further)
    figure = Figure("figures/angle_errors", "Errors of each joint angle, and published values", lambda: _figure(rows))
    plain = plain_rows(rows)
    return Document(
        NAME,
        "Errors of joint angles",
        headline,
        alarm=alarm,
        printed=tables,
        sections=[Section("errors", "", [*([figure] if rows else []), *tables])],
        figures=[figure] if rows else [],
        tables={CSV: document.Table.of(plain) if plain else document.Table(["angle"], [])} | dict(files or {}),
        facts={"rows": plain} | dict(facts or {}) | {"tables": {table.name: table.as_dict() for table in tables}},
    )


def error_table(rows: Sequence[AngleErrors], title: str, notes: Sequence[str] = ()) -> Table:
    """Return the table of errors by joint angle and class of movement."""
    cells: list[tuple[str | float | None, ...]] = []
    for row in rows:
        angles = (row.rmse, row.mae, row.median, row.offset_removed, row.offset)
        degrees = [float(np.degrees(angle)) for angle in angles]
        movement = "all" if row.movement == ALL else row.movement
        counts = (float(row.takes), float(row.samples))
        cells.append((_name(row.angle), movement, *counts, *degrees, 100 * row.within))
    return Table("angles", title, tuple(_COLUMNS), tuple(_COLUMNS.values()), cells, (*notes, *_NOTES))


def agreement_table(rows: Sequence[AngleErrors]) -> Table:
    """Return NRMSE, CMC, errors of the range of motion and limits of agreement."""
    cells: list[tuple[str | float | None, ...]] = []
    for row in rows:
        own, movement = list(row.agreement.figures.values()), "all" if row.movement == ALL else row.movement
        cells.append((_name(row.angle), movement, 100 * own[0], *own[1:]))
    return Table("agreement", "Agreement", tuple(_AGREEMENT), tuple(_AGREEMENT.values()), cells, _AGREED)


def published_table(rows: Sequence[AngleErrors]) -> Table:
    """Return published values, each beside ours of the same metric and joint angle over all movements."""
    ours = {row.angle: row for row in rows if row.movement == ALL}
    cells: list[tuple[str | float | None, ...]] = []
    for value in PUBLISHED:
        row = ours.get(value.angle)
        own = None if row is None else float(np.degrees(getattr(row, value.metric)))
        cells.append((_name(value.angle), METRICS[value.metric], own, value.degrees, value.system, value.source))
    columns = ("joint angle", "metric", "ours", "published", "system", "source")
    note = "Degrees. The same metric, but other people, movements, references and sets of angles: no ranking."
    title = "Beside published values of the same metric"
    return Table("published", title, columns, (0, 0, 1, 1, 0, 0), cells, (note, WITHOUT_METRIC))


def _name(angle: str) -> str:
    return "all angles" if angle == ALL else angle.replace("_", " ")


def plain_rows(rows: Sequence[AngleErrors]) -> list[dict[str, Any]]:
    """Return rows as plain values with units in their names; None where there is no value."""
    metrics = ("rmse", "mae", "median", "offset_removed", "offset")
    return [
        {"angle": row.angle, "movement": row.movement, "takes": row.takes, "samples": row.samples}
        | {f"{name}_deg": float(np.degrees(getattr(row, name))) for name in metrics}
        | {"within_95_share": row.within if np.isfinite(row.within) else None}
        | {name: number(value) for name, value in row.agreement.figures.items()}
        for row in rows
    ]


def _figure(rows: Sequence[AngleErrors]) -> Plot:
    """Draw three metrics of every joint angle, and published values in their colours."""
    own = [row for row in rows if row.movement == ALL]
    figure, ((axes,),) = subplots(1, 1, (9.5, 1.2 + 0.34 * len(own)))
    for height, row in enumerate(own):
        for metric, colour in _COLOURS.items():
            value = np.degrees(getattr(row, metric))
            axes.plot(value, height, "o", color=colour, label=f"ours, {METRICS[metric]}" if not height else None)
            for published in PUBLISHED:
                if (published.angle, published.metric) == (row.angle, metric):
                    axes.plot(published.degrees, height, "D", mfc="none", color=colour)
    axes.plot([], [], "D", mfc="none", color="#555555", label="published, in the colour of its metric")
    axes.set_yticks(range(len(own)), [_name(row.angle) for row in own])
    axes.set_ylim(len(own) - 0.4, -0.6)
    axes.set_xlim(left=0)
    axes.set_xlabel("error [degrees]")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure
