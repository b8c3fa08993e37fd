"""The command report: one page of a motion, and its analysis as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rtof_kin.cli.options import Fields, Overwrite, command, written
from rtof_kin.cli.terminal import out, print_files, say
from rtof_kin.core.files.folder import check_new_file, check_replaceable
from rtof_kin.recording.labels import Session
from rtof_kin.reporting.settings import AnalysisSettings


@command
def report(
    motion: Path,
    /,
    *,
    output: Annotated[
        Path | None,
        written("page; default: report.html beside the motion, where no tables or scores are asked for", "FILE"),
    ] = None,
    analysis: Annotated[
        AnalysisSettings, Fields("sex repetitions from_standing height figures", weight_kg="weight", group="Analysis")
    ],
    tables: Annotated[Path | None, Parameter(name="--analysis", metavar="FOLDER", group="Analysis")] = None,
    gait_reference: Annotated[Path | None, Parameter(metavar="FILE", group="Analysis")] = None,
    session: Annotated[Session, Fields("operator date place protocol", subject="code", group="Labels")],
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
    from rtof_kin.core.files.text import write_text
    from rtof_kin.reporting.analysis import MARKER, write_analysis
    from rtof_kin.reporting.document import show
    from rtof_kin.reporting.gait import score_motion
    from rtof_kin.reporting.page import PAGE
    from rtof_kin.reporting.page import report as page

    folder = motion_folder(motion)
    path = output or (folder / PAGE if tables is None and gait_reference is None else None)
    if path is not None:
        check_new_file(path, overwrite)
    if tables is not None:
        check_replaceable(tables, MARKER, overwrite)
    if path is not None:
        write_text(path, page(folder, session, analysis.weight_kg, analysis.sex), overwrite)
        say(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB, opens in any browser")
    documents = []
    if gait_reference is not None:
        documents.append(score_motion(motion, gait_reference, analysis.from_standing))
    if tables is not None:
        show(write_analysis(motion, tables, analysis, overwrite, documents=documents), out)
    for document in documents:
        show(document, out)
    if tables is not None:
        print_files(tables)
