"""Files that are made of a result when they are asked for: a workbook, tables, OpenSim, C3D, the report on paper."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from typing import Final

from rtof_kin.app.frame import Frame
from rtof_kin.app.start import pdf_browser
from rtof_kin.app.texts import TEXTS
from rtof_kin.body.motion_file import MotionReader
from rtof_kin.clinical.analysis import analyse
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.packages import optional
from rtof_kin.formats.motion_files import write_motion_files
from rtof_kin.reporting.analysis import document, gait_table, write_analysis
from rtof_kin.reporting.audit_results import headline
from rtof_kin.reporting.document import Table
from rtof_kin.reporting.page import PAGE, recording_facts
from rtof_kin.reporting.settings import AnalysisSettings
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.reporting.summary_lines import summary_lines
from rtof_kin.setup.run import MOTION

_MOST_ROWS: Final = 2**20  #: Of a sheet
_ALONE: Final = ("--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync")
_PRINTING: Final = ("--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=10000", "--no-pdf-header-footer")
_LONGEST: Final = 120.0  #: [s] of printing


def downloads(frame: Frame, folder: Path) -> None:
    """Show the files that can be made of the result of a recording."""
    name = "_".join(folder.relative_to(frame.store.root).parts)
    frame.ui.label(TEXTS.downloads)
    with frame.row():
        for text, ending, write in _KINDS:
            frame.button(text, partial(frame.download, name + ending, folder, write, folder))


def write_xlsx(folder: Path, path: Path) -> None:
    """Write a workbook: what was recorded and how good it is, gait, angles with standard deviations, ranges, ..."""
    xlsxwriter = optional("xlsxwriter", "app", "a workbook")
    summary = read_summary(folder / MOTION / SUMMARY)
    mass, sex = (summary.subject.get(name) for name in ("mass_kg", "sex"))
    with MotionReader(folder / MOTION) as motion:
        found = analyse(motion, weight_kg=mass, sex=sex if mass else None)
        facts = recording_facts(motion, summary, summary.session, date.today().isoformat())
    made, overall = document(found, summary.sensors), headline(summary.results or ())
    facts |= {line.label: line.text for line in summary_lines(found, summary, overall, summary.session)}
    facts |= {key: text for key, text in made.data["angles.json"].items() if isinstance(text, str)}
    tables = {"information": Table(("", ""), list(facts.items())), "gait": gait_table(found.gait), **made.tables}
    settings = {"constant_memory": True, "tmpdir": str(path.parent), "strings_to_formulas": False}
    with xlsxwriter.Workbook(path, settings | {"strings_to_urls": False}) as book:
        for name, table in tables.items():
            sheet = book.add_worksheet(name.removesuffix(".csv").replace("_", " "))
            sheet.freeze_panes(1, 1)
            sheet.set_column(0, 0, 24)
            for number, row in enumerate((table.columns, *table.rows)):
                if number >= _MOST_ROWS:
                    raise InvalidInputError(TEXTS.long_for_xlsx)
                for column, cell in enumerate(row):
                    if isinstance(cell, str) or (cell is not None and math.isfinite(cell)):
                        sheet.write(number, column, str(cell) if isinstance(cell, str) else float(cell))


def write_files(formats: tuple[str, ...], folder: Path, path: Path) -> None:
    """Write a motion in some formats, or its analysis without any, in a ZIP file but for C3D alone."""
    new = path.parent / path.stem
    if formats:
        new.mkdir()
        with MotionReader(folder / MOTION) as motion:
            write_motion_files(new, motion, formats)
    else:
        write_analysis(folder / MOTION, new, AnalysisSettings(), figures=False)
    if formats == ("c3d",):
        (new / "motion.c3d").rename(path)
    else:
        shutil.make_archive(str(path.with_suffix("")), "zip", new)


def write_pdf(folder: Path, path: Path) -> None:
    """Print the report by a browser of this machine, with a profile of its own and without the network; `RtofError`
    where there is none, or it does not print.
    """
    if (browser := pdf_browser()) is None:
        raise RtofError(TEXTS.no_browser)
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []  # else it does not start
    own = [f"--user-data-dir={path.parent / 'profile'}", f"--print-to-pdf={path}"]
    command = [browser, *_ALONE, *_PRINTING, *root, *own, (folder / PAGE).as_uri()]
    try:
        subprocess.run(command, timeout=_LONGEST, capture_output=True, check=True)
        path.stat()
    except (OSError, subprocess.SubprocessError) as error:
        raise RtofError(TEXTS.not_printed) from error


_KINDS: Final[tuple[tuple[str, str, Callable[..., None]], ...]] = (
    ("Excel", ".xlsx", write_xlsx),
    ("CSV", "_csv.zip", partial(write_files, ())),
    ("OpenSim", "_opensim.zip", partial(write_files, ("osim", "mot"))),
    ("C3D", ".c3d", partial(write_files, ("c3d",))),
    ("PDF", ".pdf", write_pdf),
)
"""Name, ending of the file, and what writes it."""
