"""Page of a recording: its files, its reconstruction, its result, and the files that are made of it when asked for."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Callable
from contextlib import suppress
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import EVERY, SANDBOX, Frame, Show
from rtof_kin.app.sources import PICTURES, SourceParts
from rtof_kin.app.start import pdf_browser
from rtof_kin.app.store import AT_WORK, State
from rtof_kin.app.texts import TEXTS, worded
from rtof_kin.app.work import REPORT
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

_RESULTS: Final = {PAGE: PAGE, **PICTURES}  #: Files that are shown, and where they are
_MOST_ROWS: Final = 2**20  #: Of a sheet
_ALONE: Final = ("--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync")
_PRINTING: Final = ("--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=10000", "--no-pdf-header-footer")
_LONGEST: Final = 120.0  #: [s] of printing


class TakePages(Frame):
    """A recording: its files, its reconstruction, its result."""

    def serve(self) -> None:
        """See `Frame`."""
        self.ui.page("/people/{person}/{visit}/{name}")(self.recording)
        self.app.get("/results/{person}/{visit}/{name}/{file}")(self.file)

    def recording(self, person: str, visit: str, name: str) -> None:
        """One recording: its files, its reconstruction, its result."""

        def look() -> Any:
            take, page = self.store.take(self.store.path(person, visit, name)), folder / PAGE
            made = page.stat().st_mtime_ns if page.is_file() else 0
            return take.state, take.said, take.learned, self.store.files(folder), take.second, made

        with self.frame(name, person, visit, name):
            folder = self.store.path(person, visit, name)
            SourceParts(self, folder)
            self.shown(look, lambda show: self._reconstruction(folder, show), lambda _: self._result(folder))
            self.notes(person, visit, name)

    def file(self, person: str, visit: str, name: str, file: str) -> Any:
        """Return the report of a recording, or the picture of the people in it."""
        return self.answer(lambda: self.store.path(person, visit, name) / _RESULTS.get(file, "-"))

    def _reconstruction(self, folder: Path, show: Show) -> None:
        ui, take = self.ui, self.store.take(folder)
        with self.row():
            self.heading(TEXTS.reconstruct_title, 2)
            self.chip(folder)
        if take.state in AT_WORK:
            self._progress(folder)
            self.button(TEXTS.cancel, lambda: self.work.cancel(folder))
            return
        asked = TEXTS.asked_sensors if take.places else TEXTS.asked_person
        if said := asked if take.state is State.ASKING else worded(take.said):
            ui.label(said).props("role=alert").classes("doubt text-lg")
        for what in take.learned:
            ui.label(TEXTS.learned.format(what=worded(what)))

        def ask(look: bool = False) -> None:
            if self.store.sources(folder).sizeless and not self.store.take(folder).size_px:
                raise RtofError(TEXTS.size_needed)
            self.work.ask(folder, look)
            show()

        with suppress(RtofError):  # else nothing can be done yet, which is said above
            self.store.sources(folder)
            learn = ui.switch(TEXTS.learn, value=take.learn)
            learn.on_value_change(lambda event: self.store.change(folder, learn=event.value))
            with self.row():
                self.button(TEXTS.look, lambda: ask(look=True), props="outline")
                self.button(TEXTS.again if (folder / PAGE).is_file() else TEXTS.reconstruct, ask)

    def _progress(self, folder: Path) -> None:
        line = self.ui.label().props("role=status").classes("text-lg")
        finishing = TEXTS.looking if self.store.take(folder).look else TEXTS.finishing
        rows, bars, names = self.ui.column().classes("w-full"), dict[str, Any](), TEXTS.stages

        def update() -> None:
            stages = self.work.stages(folder)
            if stages is None:
                line.text = TEXTS.waiting.format(count=self.work.before(folder))
                return
            done, left = stages.done, stages.left
            said = TEXTS.starting
            if done:
                last = list(done)[-1]
                said = names.get(last, last) if any(n < of for n, of in done.values()) else finishing
            line.text = said if left is None else f"{said}: {TEXTS.left.format(time=_time(left))}"
            for stage in done.keys() - {REPORT}:
                if stage not in bars:
                    with rows:
                        self.ui.label(names.get(stage, stage))
                        bars[stage] = self.ui.linear_progress(show_value=False)
                        bars[stage].props["aria-label"] = names.get(stage, stage)
                bars[stage].value = done[stage][0] / max(1, done[stage][1])

        update()
        self.ui.timer(EVERY, update)

    def _result(self, folder: Path) -> None:
        ui, ready = self.ui, self.store.take(folder).state not in AT_WORK and (folder / PAGE).is_file()
        if not ready:
            return
        self.heading(TEXTS.result, 2)
        address = self.address(folder, PAGE)
        with self.row().classes("gap-8"):
            ui.link(TEXTS.to_review, self.page_of(folder, "review"))
            ui.link(TEXTS.report, address, new_tab=True)
        ui.element("iframe").props(f'src="{self.prefix}{address}" title="{TEXTS.result}" sandbox="{SANDBOX}"')
        ui.label(TEXTS.downloads)
        made = "_".join(folder.relative_to(self.store.root).parts)
        with self.row():
            for text, ending, write in _KINDS:
                self.button(text, partial(self.download, made + ending, folder, write, folder))


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


# --- downloads -----------------------------------------------------------------------------------


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
        write_analysis(folder / MOTION, new, AnalysisSettings(figures=False))
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
