"""The command report: one page of a motion, and its analysis as tables."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.table import Column, Table

from rtof_kin.cli.options import Fields, Figures, Overwrite, command
from rtof_kin.cli.terminal import out, print_files
from rtof_kin.core.files.folder import check_new_file, check_replaceable
from rtof_kin.core.files.text import write_text
from rtof_kin.recording.session import Session
from rtof_kin.reporting.analysis import AnalysisSettings, analyse

if TYPE_CHECKING:
    from rtof_kin.clinical.analysis import MotionAnalysis


@command
def report(
    motion: Path,
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=("--output", "-o"),
            metavar="FILE",
            help="page; default: report.html beside the motion, where no tables or scores are asked for",
        ),
    ] = None,
    analysis: Annotated[
        AnalysisSettings, Fields("sex", "repetitions", "from_standing", "height", weight_kg="weight", group="Analysis")
    ],
    tables: Annotated[Path | None, Parameter(name="--analysis", metavar="FOLDER", group="Analysis")] = None,
    gait_reference: Annotated[Path | None, Parameter(metavar="FILE", group="Analysis")] = None,
    figures: Figures = True,
    session: Annotated[Session, Fields("subject", "operator", "date", "place", "protocol", group="Labels")],
    overwrite: Overwrite = False,
) -> None:
    """One page of a reconstructed motion that opens in any browser.

    MOTION is the output of reconstruct or run. The page begins with a summary; ranges of motion, curves, an animated
    skeleton, gait, torques, quality, the items to report of a study with inertial sensors and the audit follow. It
    reads on a phone and on paper, and needs no network. Labels replace those of the recording.

    With --analysis, FOLDER gets the angles as CSV with a table of their names, signs and zeros, ranges of motion, gait
    cycles, torques where a body mass is known, figures, and notes on what could not be computed and why. An unobserved
    angle is an empty cell.

    Args:
        motion: output folder of reconstruct or run
        tables: write the analysis as tables and figures into this folder too, and print it
        gait_reference: score the gait against this file of rtof-kin gait-reference: GPS, its profile (MAP) and GDI;
            with --analysis the scores are written into FOLDER/gait_scores
    """
    from rtof_kin.body.motion_file import motion_folder
    from rtof_kin.reporting.document import show
    from rtof_kin.reporting.gait import score_motion
    from rtof_kin.reporting.page import PAGE
    from rtof_kin.reporting.page import report as page

    folder = motion_folder(motion)
    path = output or (folder / PAGE if tables is None and gait_reference is None else None)
    if path is not None:
        check_new_file(path, overwrite)
    if tables is not None:
        from rtof_kin.clinical.files import MARKER

        check_replaceable(tables, MARKER, overwrite)
    if path is not None:
        write_text(path, page(folder, session, analysis.weight_kg, analysis.sex), overwrite)
        out.print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB, opens in any browser", soft_wrap=True)
    documents = []
    if gait_reference is not None:
        documents.append(score_motion(motion, gait_reference, analysis.from_standing))
    if tables is not None:
        how: Any = {"figures": figures, "overwrite": overwrite, "documents": documents}
        _print_analysis(analyse(motion, tables, analysis, **how))
    for document in documents:
        show(document, out)
    if tables is not None:
        print_files(tables)


def _print_analysis(analysis: MotionAnalysis) -> None:
    _print_ranges(analysis)
    out.print(f"pelvis: {analysis.travel.text}", soft_wrap=True)
    if analysis.gait.is_gait:
        _print_gait(analysis.gait)
        out.print(f"gait: from {analysis.gait.rests_on}", soft_wrap=True)
    else:
        out.print(f"gait: {analysis.gait.why_not}", soft_wrap=True)
    if analysis.repetitions is not None:
        _print_repetitions(analysis.repetitions)
    for part, notes in analysis.notes.items():
        for note in notes:
            out.print(f"{part}: {note}", soft_wrap=True)


def _print_ranges(analysis: Any) -> None:
    from rtof_kin.data.confidence import BAND_95

    columns = ("low", "high", "range", "\u00b1 95 %", "deg/s", "trusted")
    table = Table(Column("angle [deg]", no_wrap=True), *columns)
    shown = [row for row in analysis.ranges if row.known_share > 0 and not row.about_vertical]
    for row in shown:
        half = math.nan if row.is_uncertain else BAND_95 * row.range_sigma
        figures = map(math.degrees, (row.low, row.high, row.range, half, row.peak_velocity))
        cells = ["" if math.isnan(v) else f"{v:.0f}" for v in figures]
        cells[2] = f">= {cells[2]}" if row.is_uncertain else cells[2]
        table.add_row(row.name, *cells, f"{100 * row.known_share * row.trusted_share:.0f} %")
    out.print(table)
    for row in shown:
        if row.is_uncertain:
            out.print(f"{row.name}: {row.text}", soft_wrap=True)


def _print_gait(gait: Any) -> None:
    digits = {"stride_time": "s", "cadence": "steps/min", "stride_length": "m", "speed": "m/s"}
    table = Table(Column("gait", no_wrap=True), *gait.summary, "symmetry")
    for name in next(iter(gait.summary.values())):
        cells = [_spread(*measures[name]) for measures in gait.summary.values()]
        symmetry = f"{100 * gait.symmetry[name]:+.1f} %" if name in gait.symmetry else ""
        label = f"{name.replace('_', ' ')} {digits.get(name, '')}"
        table.add_row(label, *cells, symmetry)
    out.print(table)


def _spread(mean: float, spread: float, strides: int) -> str:
    return f"{mean:.3g}" + (f" \u00b1 {spread:.2g}" if strides > 1 else "") + f" ({strides})"


def _print_repetitions(found: Any) -> None:
    columns = ("down [s]", "below [s]", "up [s]", "depth [m]", "right knee [deg]", "left knee [deg]")
    table = Table(Column(found.kind.replace("_", " "), no_wrap=True), *columns)
    for number, r in enumerate(found.repetitions, start=1):
        knees = [math.degrees(r.knee_flexion[side]) for side in ("right", "left")]
        figures = (r.descent_time, r.bottom_time, r.ascent_time, r.depth)
        cells = [f"{v:.2f}" for v in figures] + [f"{v:.0f}" for v in knees]
        table.add_row(str(number), *("" if cell == "nan" else cell for cell in cells))
    out.print(table)
