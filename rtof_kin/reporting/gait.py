"""Gait scores as a document: the scores of one motion against a reference, what is missing, and the curves.

``gait_scores.csv`` has a row for each variable, side and profile score; ``gait_curves.csv`` the mean curves of both
sides with their standard deviations by the poses and between strides, and mean and deviation of the reference;
degrees. Also the recordings of healthy people below a folder, from which a reference is made.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rtof_kin.body.motion_file import MotionReader, file_in, motion_folder, motion_path
from rtof_kin.clinical import gait_scores as clinical
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_scores import FEW, DeviationIndex, GaitScores, Score
from rtof_kin.clinical.gait_variables import GaitCycles, gait_cycles, joined_cycles
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.gait_reference import NAMES, PERCENT, STANDING_ZERO, VARIABLES, GaitReference
from rtof_kin.formats.gait_reference import read_gait_reference
from rtof_kin.reporting.angle_names import SIDE_COLORS, label
from rtof_kin.reporting.audit_results import Grade, headline
from rtof_kin.reporting.document import Document, Figure, Section, Table, fixed, label_panel, number
from rtof_kin.reporting.summary_file import SUMMARY, read_summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Plot

COLUMNS: Final = (
    *("score", "side", "value_deg", "low_deg", "high_deg", "noise_deg", "corrected_deg", "pose_sigma_deg"),
    *("stride_sigma_deg", "spread_between_strides_deg", "strides", "reference_median_deg"),
)
LEAST_EXPLAINED: Final = 0.8  #: Share of a deviation outside of which the features do not describe it
_OF_INDEX: Final = ("value", "low", "high", "explained_share")  # names of the fields of a `DeviationIndex`
_FEW_STRIDES: Final = 4
_WIDTH: Final = 0.38  # of a bar of the figure


def score_motion(motion: str | Path, reference: str | Path, from_standing: bool = False) -> Document:
    """Return the gait scores of a motion against a reference, as a document. `FileFormatError`: a file is missing or
    damaged.

    Args:
        motion: output folder of reconstruct or run, or its motion file. reference: file of a `GaitReference`.
        from_standing: angles relative to quiet standing; so they are for a reference made so.
    """
    people = read_gait_reference(reference)
    cycles, _ = read_cycles(motion, from_standing or people.zero == STANDING_ZERO)
    return document(score_gait(motion_folder(motion).resolve().name, cycles, people))


def document(found: ScoredGait) -> Document:
    """Return scores as a document."""
    first, *others = _opening(found)
    printed, sections, figures, tables = [], [], [], {"gait_scores.csv": table(found)}
    if found.scores is not None:
        printed = [_profile_table(found)]
        alt = "Movement Analysis Profile as bars, and the nine curves over those of the reference, with 95 % bands"
        figures = [Figure("gait_scores", alt, lambda: gait_figure(found))]
        sections = [Section("profile", "Movement Analysis Profile", [_profile_table(found), *figures])]
        tables["gait_curves.csv"] = _curve_table(found)
    return Document(
        "gait_scores",
        f"{found.name}: gait scores",
        first,
        others,
        _cautions(found),
        printed=printed,
        sections=sections,
        figures=figures,
        tables=tables,
        facts=_facts(found),
    )


# --- recordings of healthy people ----------------------------------------------------------------


@dataclass(frozen=True)
class FoundPeople:
    """Strides of the people below a folder."""

    people: dict[str, GaitCycles]  #: Code of a person -> strides of all recordings
    recordings: dict[str, list[str]]  #: Code -> folders of the recordings, relative
    left_out: dict[str, str]  #: Folder -> why it is not used
    skeletons: tuple[str, ...]  #: Names of the models


def read_cycles(path: str | Path, from_standing: bool = False) -> tuple[GaitCycles, str]:
    """Return the strides of a motion, and the name of its skeleton. `FileFormatError`: it is none of these, or damaged.

    Args:
        from_standing: see `gait_cycles`.
    """
    with MotionReader(motion_path(path)) as reader:
        return gait_cycles(reader, from_standing=from_standing), reader.skeleton.name


def find_people(folder: str | Path, from_standing: bool = False) -> FoundPeople:
    """Return the strides of all motions below a folder, by person.

    A person is the subject of the recording's session; without one, each recording is a person of its own, named by its
    folder. Motions whose audit failed are left out. `FileFormatError`: there is no such folder;
    `InvalidInputError`: there is no motion in it.

    Args:
        from_standing: see `gait_cycles`.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder; name the one with the healthy recordings")
    parts: dict[str, list[GaitCycles]] = {}
    recordings: dict[str, list[str]] = {}
    left_out: dict[str, str] = {}
    skeletons = []
    for path in _folders(folder):
        name = path.relative_to(folder).as_posix() if path != folder else folder.resolve().name
        try:
            person = _person(path, name)
            cycles, skeleton = read_cycles(path, from_standing)
        except RtofError as error:
            left_out[name] = str(error)
            continue
        if cycles.why_not:
            left_out[name] = cycles.why_not
            continue
        parts.setdefault(person, []).append(cycles)
        recordings.setdefault(person, []).append(name)
        skeletons.append(skeleton)
    if not parts and not left_out:
        raise InvalidInputError(
            f"{folder}: no motion below it; name the folder with the outputs of reconstruct, run or batch"
        )
    people = {person: joined_cycles(own) for person, own in parts.items()}
    return FoundPeople(people, recordings, left_out, tuple(dict.fromkeys(skeletons)))


def _folders(folder: Path) -> Iterator[Path]:
    """Folders with a motion; hidden ones are not searched."""
    for path, inner, _ in os.walk(folder):
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        if file_in(Path(path)):
            yield Path(path)


def _person(path: Path, name: str) -> str:
    """Code of the person of a motion. `InvalidInputError`: its audit failed."""
    if not (path / SUMMARY).is_file():
        return name
    summary = read_summary(path / SUMMARY)
    if summary.results and (verdict := headline(summary.results)).grade is Grade.FAIL:
        raise InvalidInputError(f"its audit fails: {verdict.text}")
    return summary.session.subject or name


# --- scores --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScoredGait:
    """Scores of a motion against a reference."""

    name: str  #: Of the motion, for all output
    cycles: GaitCycles
    reference: GaitReference
    scores: GaitScores | None  #: None if the motion has no strides that count
    index: dict[str, DeviationIndex]  #: Gait Deviation Index by side; empty if it is not computed
    why_no_index: str  #: One sentence; '' if there is an index
    people: Array | None  #: Scores of the reference's own people, see `people_scores`

    @property
    def missing(self) -> dict[str, str]:
        """Variables without which there is no profile score of a side, and what they need."""
        own = self.scores.missing if self.scores is not None else {}
        return {f"{side} {name}": needs for side, names in own.items() for name, needs in names.items()}


def score_gait(name: str, cycles: GaitCycles, reference: GaitReference) -> ScoredGait:
    """Return the scores of a motion."""
    people = clinical.people_scores(reference)
    if cycles.why_not:
        return ScoredGait(name, cycles, reference, None, {}, cycles.why_not, people)
    scores = clinical.gait_scores(cycles, reference)
    try:
        features = clinical.gait_features(reference)
    except InvalidInputError as error:
        return ScoredGait(name, cycles, reference, scores, {}, f"{error}.", people)
    index = {side: clinical.deviation_index(scores.curves[side], features) for side in SIDES}
    known = {side: found for side, found in index.items() if found.value == found.value}
    why = "" if known else "It needs all nine variables of a side."
    return ScoredGait(name, cycles, reference, scores, known, why, people)


# --- words ---------------------------------------------------------------------------------------


def _opening(found: ScoredGait) -> list[str]:
    """Return the first lines: another system's reference, then the scores or why there are none."""
    lines = []
    if not found.reference.is_own:
        lines.append(
            f"The reference is of another system ({found.reference.system}; zero: {found.reference.zero}): its "
            "model has other zeros, above all of pelvic tilt, hip rotation and ankle, and a constant offset "
            "between the two counts as a deviation of the person."
        )
    if found.scores is None:
        return [*lines, f"No gait scores: {found.cycles.why_not}"]
    lines.append(f"{_profile(found)}.")
    if found.missing:
        by_need: dict[str, list[str]] = {}
        for name, needs in found.missing.items():
            by_need.setdefault(needs, []).append(label(name))
        text = "; ".join(f"{', '.join(names)} (needs {needs})" for needs, names in by_need.items())
        lines.append(f"Not observed in a whole stride: {text}.")
    lines.append(_index(found))
    return lines


def _cautions(found: ScoredGait) -> list[str]:
    """Return what to be careful about, one sentence each."""
    reference, scores = found.reference, found.scores
    lines = []
    if scores is not None:
        lines += _about_bands(found)
        explained = [one.explained for one in found.index.values()]
        if explained and min(explained) < LEAST_EXPLAINED:
            lines.append(
                f"the features of the GDI have {100 * min(explained):.0f} % of the deviation; in the rest "
                "people of the reference do not differ, so the GDI is too good: use the GPS"
            )
        speed, speeds = found.cycles.speed, reference.speed_range
        if np.isfinite(speed) and speeds is not None and not speeds[0] <= speed <= speeds[1]:
            lines.append(
                f"the person walks at {speed:.2f} m/s, the people of the reference at {speeds[0]:.2f} to "
                f"{speeds[1]:.2f} m/s; curves depend on speed"
            )
    if reference.people < FEW:
        error = float(np.degrees(np.sqrt(np.nanmean(reference.sd**2) / reference.people)))  # root mean square
        lines.append(
            f"scores are relative to {reference.people} people, fewer than {FEW}; their mean is itself known "
            f"to \u00b1{error:.1f} deg (standard error)"
        )
    if reference.zero == STANDING_ZERO:
        lines.append("angles of trunk and legs are relative to each person's quiet standing, as in the reference")
    return [*lines, *found.cycles.notes, *(f"reference: {note}" for note in reference.notes)]


def score_text(score: Score) -> str:
    """Return a score with its band, deg."""
    if not np.isfinite(score.value):
        return "not computed"
    text = f"{np.degrees(score.value):.1f}"
    if score.noise == 0:
        return text
    return f"{text} ({np.degrees(score.low):.1f} to {np.degrees(score.high):.1f})"


def _profile(found: ScoredGait) -> str:
    """Gait Profile Score, and that of the reference's people."""
    scores = found.scores
    assert scores is not None
    parts = [f"{side} {score_text(score)}" for side, score in scores.sides.items()]
    text = f"{found.name}: GPS {score_text(scores.overall)} deg, {', '.join(parts)}"
    if found.people is not None:
        own = np.degrees(found.people[..., -1])
        text += f"; people of the reference {own.min():.1f} to {own.max():.1f}, median {np.median(own):.1f}"
    return text


def _index(found: ScoredGait) -> str:
    """Gait Deviation Index, or why there is none."""
    if not found.index:
        return f"GDI not computed: {found.why_no_index}"
    parts = []
    for side, one in found.index.items():
        high = f"to {one.high:.0f}" if np.isfinite(one.high) else "or more"
        parts.append(f"{side} {one.value:.0f} ({one.low:.0f} {high})")
    return f"GDI {', '.join(parts)}; 100 is the mean of the reference, 10 its standard deviation."


def _about_bands(found: ScoredGait) -> list[str]:
    scores = found.scores
    assert scores is not None
    if not scores.has_bands:
        return ["the motion has no covariances: bands have the spread between strides alone"]
    known = [one for own in scores.profile.values() for one in own if np.isfinite(one.value)]
    unknown = [
        f"{side} {label(name)}"
        for side, own in scores.profile.items()
        for name, one in zip(NAMES, own, strict=True)
        if np.isfinite(one.value) and np.isnan(one.pose_sigma)
    ]
    lines = []
    if unknown:
        lines.append(f"bands are without the errors of the poses, as some are unknown: {', '.join(unknown)}")
    if known:
        noise = np.degrees(np.sqrt(np.mean([one.noise**2 for one in known])))
        size = np.degrees(np.sqrt(np.mean([one.value**2 for one in known])))
        left = np.sqrt(max(0.0, size**2 - noise**2))
        fewest = min(one.strides for one in known)
        if fewest < _FEW_STRIDES:
            lines.append(f"{fewest} strides of a side: their spread is hardly known, so bands are wide")
        lines.append(
            f"errors of the curves make scores too large: they alone would give {noise:.1f} deg, and without "
            f"them the root mean square of {size:.1f} deg would be about {left:.1f}"
        )
    return lines


# --- tables --------------------------------------------------------------------------------------


def _profile_table(found: ScoredGait) -> Table:
    """Scores of both sides with their bands, and the median of the reference's people."""
    scores, medians = found.scores, _medians(found)
    assert scores is not None
    rows = []
    for v, name in enumerate((*NAMES, "gps")):
        own = [(*scores.profile[side], scores.sides[side])[v] for side in SIDES]
        median = fixed(float(np.degrees(medians[name, "right"])), 1)
        rows.append(("GPS" if name == "gps" else label(name), *map(score_text, own), median))
    title = "95 % bands in brackets; people: median of the reference"
    return Table(("MAP [deg]", *SIDES, "people"), rows, title, row_headers=True)


def _medians(found: ScoredGait) -> dict[tuple[str, str], float]:
    """Score and side -> median of the reference's people, rad; NaN without their curves."""
    names, middle = (*NAMES, "gps"), np.full((len(SIDES), len(NAMES) + 1), np.nan)
    if found.people is not None:
        middle = np.median(found.people, axis=0)
    return {(name, side): middle[s, v] for s, side in enumerate(SIDES) for v, name in enumerate(names)}


def _facts(found: ScoredGait) -> dict[str, Any]:
    reference, cycles = found.reference, found.cycles
    return {
        "motion": found.name,
        "is_gait": found.scores is not None,
        "why_not": cycles.why_not,
        "strides": {side: cycles.sides.count(side) for side in SIDES},
        "speed_m_per_s": number(cycles.speed),
        "scores": table(found).records(),
        "missing": found.missing,
        "overall_is": "nine variables of the left side and six of the right; the pelvis counts once",
        "band": "95 %, for errors of any correlation in time and between angles",
        "gdi": {
            side: {name: number(value) for name, value in zip(_OF_INDEX, vars(one).values(), strict=True)}
            for side, one in found.index.items()
        },
        "why_no_gdi": found.why_no_index,
        "reference": {name: getattr(reference, name) for name in ("people", "system", "zero", "source", "licence")}
        | {"speed_m_per_s": None if reference.speed_range is None else list(reference.speed_range)},
    }


def table(found: ScoredGait) -> Table:
    """Return the scores, None for what there is not; no rows for a motion that is no gait; see `COLUMNS`."""
    scores, medians = found.scores, _medians(found)
    if scores is None:
        return Table(COLUMNS, [])
    own = {
        (name, side): score
        for side, profile in scores.profile.items()
        for name, score in zip(NAMES, profile, strict=True)
    }
    own |= {("gps", side): score for side, score in scores.sides.items()} | {("gps", "overall"): scores.overall}
    rows = []
    for (name, side), one in own.items():
        sizes = np.array([one.low, one.high, one.noise, one.corrected, one.pose_sigma, one.stride_sigma])
        sizes = np.where(np.isfinite(one.value), sizes, np.nan)
        values = [number(np.degrees(value)) for value in (one.value, *sizes, one.spread)]
        median = number(np.degrees(medians.get((name, side), np.nan)))
        rows.append((name, side, *values, one.strides, median))
    return Table(COLUMNS, rows)


def _curve_table(found: ScoredGait) -> Table:
    assert found.scores is not None
    columns: dict[str, Any] = {"cycle_percent": PERCENT.tolist()}
    for v, name in enumerate(NAMES):
        for side, own in found.scores.curves.items():
            strides = own.strides[:, v]
            known = strides[np.isfinite(strides).all(axis=1)]
            spread = known.std(axis=0, ddof=1) if len(known) > 1 else np.full(len(PERCENT), np.nan)
            parts = {"mean": own.mean[v], "pose_sigma": np.sqrt(own.pose_variance[v]), "stride_sd": spread}
            columns |= {f"{name}_{side}_{what}_deg": np.degrees(values) for what, values in parts.items()}
        for what, values in (("mean", found.reference.mean[v]), ("sd", found.reference.sd[v])):
            columns[f"{name}_reference_{what}_deg"] = np.degrees(values)
    return Table(tuple(columns), [[number(cell) for cell in row] for row in zip(*columns.values(), strict=True)])


# --- the figure ----------------------------------------------------------------------------------


def gait_figure(found: ScoredGait) -> Plot:
    """Plot the profile above the nine curves, with 95 % bands."""
    from matplotlib.figure import Figure as Plot

    figure = Plot(figsize=(12, 14), layout="constrained")
    grid = figure.add_gridspec(4, 3, height_ratios=(1.2, 1, 1, 1))
    _draw_profile(figure.add_subplot(grid[0, :]), found)
    for v in range(len(VARIABLES)):
        _draw_curve(figure.add_subplot(grid[1 + v // 3, v % 3]), found, v)
    figure.suptitle(f"{found.name}: bars and lines with 95 % bands; grey: reference, mean and two standard deviations")
    return figure


def _draw_profile(ax: Any, found: ScoredGait) -> None:
    """Bars of the variable scores and profile scores, with those of the reference's people."""
    scores = found.scores
    assert scores is not None
    labels = [variable.label.replace(" ", "\n", 1) for variable in VARIABLES]
    for s, (side, own) in enumerate(scores.profile.items()):
        bars = [*own, scores.sides[side]]
        x = np.arange(len(bars)) + (s - 0.5) * _WIDTH
        values = np.degrees([bar.value for bar in bars])
        ends = np.degrees([[bar.value - bar.low, bar.half_width] for bar in bars]).T
        ax.bar(x, values, _WIDTH, color=SIDE_COLORS[side], alpha=0.8, label=side)
        ax.errorbar(x, values, yerr=ends, fmt="none", ecolor="0.2", elinewidth=1, capsize=2)
        for column, value in zip(x, values, strict=True):
            if np.isnan(value):
                ax.text(column, 0, "not observed", rotation=90, fontsize=7, color="0.4", ha="center")
    overall = np.degrees([scores.overall.value, scores.overall.value - scores.overall.low])
    at = len(labels) + 1
    ax.bar(at, overall[0], _WIDTH, color="0.4", label="both")
    half = np.degrees(scores.overall.half_width)
    ax.errorbar(at, overall[0], yerr=[[overall[1]], [half]], fmt="none", ecolor="0.2", capsize=2)
    if found.people is not None:
        sizes = np.degrees(found.people).reshape(-1, len(NAMES) + 1)
        low, middle, high = np.quantile(sizes, [0, 0.5, 1], axis=0)
        columns = np.arange(len(middle))
        ax.bar(columns, high - low, 0.9, low, color="0.5", alpha=0.25, lw=0, label="reference's people, range")
        ax.hlines(middle, columns - 0.45, columns + 0.45, color="0.2", lw=1, ls=":", label="and median")
    ax.set_xticks(range(at + 1), [*labels, "GPS", "GPS\noverall"], fontsize=8)
    ax.set_ylabel("score [deg]", fontsize=8)
    ax.set_ylim(bottom=0)
    ax.set_title("Movement Analysis Profile", fontsize=9, loc="left")
    ax.legend(fontsize=7, ncols=5, frameon=False, loc="lower right", bbox_to_anchor=(1, 1))


def _draw_curve(ax: Any, found: ScoredGait, v: int) -> None:
    """One variable over the cycle."""
    assert found.scores is not None
    mean, sd = (np.degrees(one[v]) for one in (found.reference.mean, found.reference.sd))
    ax.plot(PERCENT, mean, color="0.4", lw=1)
    if np.isfinite(sd).all():
        ax.fill_between(PERCENT, mean - 2 * sd, mean + 2 * sd, color="0.5", alpha=0.3, lw=0)
    for side, own in found.scores.curves.items():
        if not np.isfinite(own.mean[v]).all():
            continue
        y = np.degrees(own.mean[v])
        variance = np.nan_to_num(own.pose_variance[v]) + np.nan_to_num(own.stride_bound[v])
        half = BAND_95 * np.degrees(np.sqrt(variance))
        ax.plot(PERCENT, y, color=SIDE_COLORS[side], lw=1.2)
        ax.fill_between(PERCENT, y - half, y + half, color=SIDE_COLORS[side], alpha=0.2, lw=0)
    if not len(ax.lines) or np.isnan(mean).all():
        ax.text(0.5, 0.5, "not in the reference", transform=ax.transAxes, ha="center", color="0.5")
    variable = VARIABLES[v]
    below = "gait cycle of the side, from heel strike [%]" if v >= 6 else ""
    label_panel(ax, f"{variable.label} (+ {variable.positive})", "[deg]", below)
    ax.set_xlim(0, 100)
    ax.tick_params(labelsize=8)
