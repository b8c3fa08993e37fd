"""Validation of one's own system on one's own people: raters and sessions beside a reference (docs/own_validation.md).

A folder has ``trials.csv``, a row for each trial: person, session, rater, trial, motion (a result of this package) and
reference (OpenSim's .mot or .sto, a marker trial, or another result; empty where there is none), paths below the
folder. Errors are those of `rtof_kin.clinical.angle_errors`, with limits of agreement by person. Reliability is that of
the range of motion of each angle in each trial by name: between raters in the first session, between sessions of the
first rater.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

import rtof_kin
from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.clinical.agreement import reliability
from rtof_kin.clinical.angle_errors import ALL, AngleDifferences, angle_differences, error_rows
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles, opensim_angles
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core.checks import some
from rtof_kin.core.errors import FileFormatError, InvalidInputError, MissingPackageError, RtofError
from rtof_kin.core.files.folder import check_new_file
from rtof_kin.core.files.text import csv_rows, write_text
from rtof_kin.data.confidence import BAND_95
from rtof_kin.datasets.public_sets import MOVEMENTS, Movement, kind_of, natural
from rtof_kin.formats.opensim import SUFFIXES, read_opensim_table
from rtof_kin.markers.settings import TRIALS, MarkerSettings
from rtof_kin.markers.trials import motion_of_markers
from rtof_kin.protocols.angles import HARDLY, angle_document, clock_shift
from rtof_kin.protocols.tables import Table
from rtof_kin.reporting import document
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.document import ESTIMATE, TRUTH, Document, Figure, Section, label_panel, subplots
from rtof_kin.reporting.html import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

INDEX: Final = "trials.csv"
COLUMNS: Final = ("person", "session", "rater", "trial", "motion", "reference")
_KINDS: Final[dict[str, Movement]] = {"walk": "walk", "squat": "squat", "sit": "sit-to-stand", "arm": "arms"}
_REACH: Final = {suffix: 1.0 for suffix in SUFFIXES}  # [s] of clocks that begin together; others may differ by any time
_SOURCES: Final = dict.fromkeys(SUFFIXES, "OpenSim coordinates") | dict.fromkeys(TRIALS, "optical markers")
_TEXTS: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


class Trial(NamedTuple):
    """A row of the index."""

    person: str
    session: str
    rater: str
    trial: str
    motion: Path
    reference: Path | None

    @property
    def key(self) -> str:
        """Name in all output."""
        return f"{self.person} session {self.session} rater {self.rater} {self.trial}"


@dataclass
class Study:
    """What was measured of each trial."""

    trials: tuple[Trial, ...]
    differences: list[AngleDifferences] = field(default_factory=list)
    ranges: dict[tuple[Trial, str], float] = field(default_factory=dict)  #: Trial and angle -> rad, of the estimate
    clocks: dict[str, str] = field(default_factory=dict)  #: Trial -> how its reference was put on its clock
    failed: dict[str, str] = field(default_factory=dict)  #: Trial -> why

    def names(self, column: str, measured: bool = True) -> list[str]:
        """Return the people, sessions, raters or trials, of the trials that were measured or of all."""
        own = [one for one in self.trials if not (measured and one.key in self.failed)]
        return sorted({getattr(one, column) for one in own}, key=natural)


def read_index(folder: Path) -> tuple[Trial, ...]:
    """Read ``trials.csv``; `FileFormatError`: there is none, a column or a cell is missing, or a row occurs twice."""
    path = folder / INDEX
    trials: dict[str, Trial] = {}
    for line, cells in csv_rows(path, f"a table with the columns {', '.join(COLUMNS)}; --template writes one", COLUMNS):
        if empty := [name for name in COLUMNS[:-1] if not cells[name]]:
            raise FileFormatError(path, f"no {', '.join(empty)} in this row", line)
        reference = folder / cells["reference"] if cells["reference"] else None
        person, session, rater, trial = (cells[name] for name in COLUMNS[:4])
        one = Trial(person, session, rater, trial, folder / cells["motion"], reference)
        if one.key in trials:
            raise FileFormatError(path, f"{one.key} occurs twice; give each repeat a name of its own", line)
        trials[one.key] = one
    if not trials:
        raise FileFormatError(path, "no trial below the header")
    return tuple(trials.values())


def measure(
    folder: Path, markers: MarkerSettings | None = None, progress: Callable[[int, int], None] | None = None
) -> Study:
    """Compare all trials; one that fails is kept with its reason, and `InvalidInputError` where all do."""
    study = Study(read_index(folder))
    for number, one in enumerate(study.trials):
        try:
            _measure(study, one, markers)
        except RtofError as error:
            study.failed[one.key] = str(error)
        if progress is not None:
            progress(number + 1, len(study.trials))
    if len(study.failed) == len(study.trials):
        first = next(iter(study.failed.values()))
        raise InvalidInputError(f"{folder}: no trial could be measured; first of all: {first}")
    return study


def _measure(study: Study, one: Trial, markers: MarkerSettings | None) -> None:
    estimate = _angles(one.motion, markers)
    if one.reference is not None:
        reference = _angles(one.reference, markers)
        clock = clock_shift(estimate, reference, reference.names, _REACH.get(one.reference.suffix.lower(), np.inf))
        kind = kind_of(one.trial, _KINDS)
        found, _ = angle_differences(estimate, reference, kind, one.key, shift=clock["shift_s"])
        if not found:
            raise InvalidInputError(f"{one.reference}: no angle is in it and in the motion at the same time")
        study.differences += [replace(own, person=one.person) for own in found]
        study.clocks[one.key] = f"{clock['shift_s']:+.3f} s, {clock['how']}"
    for row in ranges_of_motion(estimate):
        if row.is_comparable and not row.name.startswith("pelvis_opensim"):
            study.ranges[one, row.name] = row.range


def _angles(path: Path, markers: MarkerSettings | None) -> ClinicalAngles:
    if path.suffix.lower() in SUFFIXES:
        return opensim_angles(read_opensim_table(path))[0]
    if path.suffix.lower() in TRIALS:
        return clinical_angles(motion_of_markers(path, markers).motion)
    with MotionReader(motion_path(path)) as reader:
        return clinical_angles(reader)


def reliability_table(study: Study) -> tuple[Table, set[str]]:
    """Return the reliability of each angle in each trial by name, and why some values are missing.
    `MissingPackageError`: pingouin is not installed.
    """
    people, sessions, raters = (study.names(column) for column in ("person", "session", "rater"))
    at = {(one.person, one.session, one.rater, one.trial, name): v for (one, name), v in study.ranges.items()}
    rows, missing = list[tuple[str | float, ...]](), set[str]()
    for trial, name in product(study.names("trial"), dict.fromkeys(name for _, name in study.ranges)):
        between = np.array([[at.get((p, sessions[0], r, trial, name), np.nan) for r in raters] for p in people])
        over = np.array([[at.get((p, s, raters[0], trial, name), np.nan) for s in sessions] for p in people])
        if np.isfinite(between).any() or np.isfinite(over).any():
            pair = reliability(between, "ICC(2,1)"), reliability(over, "ICC(3,1)")
            values = [value for own in pair for value in (own.people, own.icc, own.low, own.high)]
            rows.append((trial, label(name), *values, *(pair[1].sem * np.degrees([1, BAND_95 * np.sqrt(2)])).tolist()))
            missing |= {own.why_not for own in pair if own.why_not}
    names = [f"{icc} {name}".strip() for icc in ("ICC(2,1)", "ICC(3,1)") for name in ("people", "", "low", "high")]
    columns = ("trial", "angle", *names, "SEM [deg]", "MDC [deg]")
    note = "Of the range of motion in a trial: (2,1) between raters, the others between sessions. '-': not computed."
    digits = (0, 0, 0, 2, 2, 2, 0, 2, 2, 2, 1, 1)
    return Table("reliability", "Reliability, with 95 % intervals", columns, digits, rows, [note]), missing


# --- the document --------------------------------------------------------------------------------


def report(study: Study) -> Document:
    """Return the tables, figures and methods; what is missing stands in the first line."""
    rows = error_rows(study.differences, MOVEMENTS) if study.differences else ()
    cautions, tables = list(_cautions(study)), list[Table]()
    try:
        table, missing = reliability_table(study)
        tables.append(table)
        cautions += [f"not computed for some angles: {why}" for why in sorted(missing)]
    except MissingPackageError as missing_package:
        cautions.append(f"reliability is left out: {missing_package}")
    text = methods(study) + ("\n\nNot as planned: " + "; ".join(cautions) + "." if cautions else "")
    failed = {key: f"FAILED: {why}" for key, why in study.failed.items()}
    clocks = [(one.key, (study.clocks | failed).get(one.key, "no reference")) for one in study.trials]
    tables.append(Table("trials", "Trials", ("trial", "clock of the reference, or why it failed"), (0, 0), clocks))
    base = angle_document(
        rows,
        f"Errors of {len(study.names('person'))} people",
        _first_line(study),
        further=tables,
        facts={"methods": text, "failed": study.failed},
        files={f"{one.name}.csv": one for one in tables},
        alarm=bool(study.failed) or "IN DOUBT" in _first_line(study),
    )
    alt = "Bland-Altman plots of ranges of motion, and curves of the trial with the median error"
    drawn = [Figure("figures/agreement", alt, partial(_figure, study))] if rows else []
    sections = [Section("methods", "Methods", text.split("\n\n")), *base.sections, Section("figures", "", drawn)]
    more: Any = {"figures": [*base.figures, *drawn], "printed": [*base.printed, text], "sections": sections}
    return replace(base, title="Validation", cautions=cautions, **more)


def _counts(study: Study) -> str:
    nouns = (("person", "people"), ("session", "sessions"), ("rater", "raters"))
    counted = [(len(study.names(column)), column, plural) for column, plural in nouns]
    return ", ".join(f"{count} {one if count == 1 else many}" for count, one, many in counted)


def _first_line(study: Study) -> str:
    count = len(study.trials)
    text = f"Validation of {_counts(study)}: {count - len(study.failed)} of {count} trials measured"
    if study.failed:
        named = some([f"{key}: {why}" for key, why in study.failed.items()], 3, "; ")
        text += f", {len(study.failed)} FAILED and are in no value below ({named})"
    if gone := [name for name in study.names("person", False) if name not in study.names("person")]:
        text += f"; WITHOUT {', '.join(gone)}, of whom no trial was measured"
    every = [study.names(column, False) for column in COLUMNS[:4]]
    if missing := int(np.prod([len(names) for names in every])) - count:
        text += f"; {missing} combinations of person, session, rater and trial are not in {INDEX}"
    if alone := sum(one.reference is None for one in study.trials):
        text += f"; without a reference, and in no error: {alone}"
    if doubts := [key for key, how in study.clocks.items() if HARDLY in how]:
        text += f". IN DOUBT: in {len(doubts)} trials {HARDLY}: {some(doubts, 5)}"
    return text + "."


def _cautions(study: Study) -> Iterator[str]:
    names = {one.angle for one in study.differences} | {name for _, name in study.ranges}
    other = {f"{a}_": f"{b}_" for a, b in (SIDES, SIDES[::-1])}
    sides = ((name, side) for name in sorted(names) for side in other if name.startswith(side))
    if alone := [name for name, side in sides if name.replace(side, other[side], 1) not in names]:
        yield f"one side alone was measured: {', '.join(map(label, alone))}"
    if len({one.person for one in study.differences}) < 2:
        yield "limits of agreement are not shown: they need the differences of two people"
    if 1 < len(study.names("person")) < 10:
        yield f"{len(study.names('person'))} people: intervals are wide, and limits hold for people like these"


def methods(study: Study) -> str:
    """Return a methods paragraph and its references, for a manuscript."""
    used = [one for one in study.trials if one.key not in study.failed]
    suffixes = [one.reference.suffix.lower() for one in used if one.reference is not None]
    kinds = Counter(_SOURCES.get(suffix, "another result of the same software") for suffix in suffixes)
    try:
        package = f"pingouin {version('pingouin')}"
    except ImportError:
        package = "pingouin, which was not installed, so that they are missing"
    counted = (_counts(study), ", ".join(study.names("trial")), len(used), len(study.trials), rtof_kin.__version__)
    references = ", ".join(f"{kind} ({count} trials)" for kind, count in kinds.items()) or "none"
    first = study.names("session")[0], study.names("rater")[0]
    return str(_TEXTS["methods"]).format(*counted, references, *first, package).strip()


def _figure(study: Study) -> Plot:
    """Draw each joint angle: difference of the ranges of motion over their mean, by person, with bias and limits; and
    estimate and reference in the trial with the median error.
    """
    known = [(one, one.reference) for one in study.differences if one.reference is not None]
    rows = {row.angle: row for row in error_rows(study.differences, MOVEMENTS) if row.movement == ALL}
    names = [name for name in rows if name != ALL]
    figure, axes = subplots(len(names), 2, (10, 2.6 * len(names)))
    for (left, right), name in zip(axes, names, strict=True):
        own = [(np.degrees([r + one.difference, r]), one) for one, r in known if one.joint_angle == name]
        for k, person in enumerate(study.names("person")):
            pairs = [np.ptp(ends, axis=1) for ends, one in own if one.person == person]
            estimate, reference = np.array(pairs).reshape(-1, 2).T
            dots: Any = {"ms": 4, "alpha": 0.7, "color": f"C{k % 10}", "label": person}
            left.plot((estimate + reference) / 2, estimate - reference, "o", **dots)
        for value, style in zip(np.degrees(rows[name].agreement[-3:]), ("-", "--", "--"), strict=True):
            left.axhline(value, color="0.3", lw=0.9, ls=style)  # nothing where it is not known
        label_panel(left, f"{label(name)}: ranges of motion", "difference [deg]", "mean of both [deg]")
        left.locator_params("x", nbins=6)
        ends, one = sorted(own, key=lambda of: float(np.mean(of[1].difference ** 2)))[(len(own) - 1) // 2]
        for values, colour, text in zip(ends, (ESTIMATE, TRUTH), ("estimate", "reference"), strict=True):
            right.plot(values, color=colour, lw=1.1, label=text)
        label_panel(right, f"{label(one.angle)}, {one.take}", "[deg]", "common sample")
    axes[0, 1].legend(fontsize=7)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=10, fontsize=7, frameon=False)
    return figure


# --- the protocol to print -----------------------------------------------------------------------


def write_protocol(folder: Path) -> list[Path]:
    """Write the protocol to print, and an index of its trials; `OutputExistsError` where there is one."""
    check_new_file(folder / INDEX, False)
    what: dict[str, str] = _TEXTS["trials"]
    visits = list(product([f"P{k:02d}" for k in range(1, 11)], "12", "AB"))
    trials = [(*visit, name) for visit in visits for name in what]
    rows = [(*one, "/".join(one), f"{'/'.join(one)}/reference.mot") for one in trials]
    document.write_csv(folder / INDEX, document.Table(COLUMNS, rows))
    page = render("validation_protocol.html", styles=("page.css",), trials=what, visits=visits)
    write_text(folder / "protocol.html", page)
    return [folder / INDEX, folder / "protocol.html"]
