"""Page to look at a result and to mend it: video, motion and curves on one time line, and corrections by hand."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import Frame, Show
from rtof_kin.app.store import AT_WORK, Store
from rtof_kin.app.texts import TEXTS
from rtof_kin.app.work import REVIEW, VIDEO, write_review
from rtof_kin.body.motion_file import MOTION as MOTION_FILE
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.corrections import EVENTS, Correction
from rtof_kin.recording.index import INDEX, read_corrections, write_corrections
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.setup.run import MOTION, RECORDING

_LISTEN: Final = """
window.addEventListener("message", event => {
  if (event.origin === location.origin && Array.isArray(event.data?.range)) emitEvent("range", event.data.range);
});
"""
_WITHOUT_SPAN: Final = ("exchange_sides", "leave_out")  #: What may hold for the whole recording


class ReviewPages(Frame):
    """A result beside its video, and what a person corrects in it."""

    who = ""  #: Who made the last correction

    def serve(self) -> None:
        """See `Frame`."""
        self.ui.page("/people/{person}/{visit}/{name}/review")(self.review)
        self.app.get("/review/{person}/{visit}/{name}/{file}")(self.file)

    async def review(self, person: str, visit: str, name: str) -> None:
        """Show the result, the corrections, and a form for further ones."""
        with self.frame(name, person, visit, name):
            folder = self.store.path(person, visit, name)
            if not (folder / MOTION / MOTION_FILE).is_file():
                raise InvalidInputError(TEXTS.no_result)
            self.ui.link(TEXTS.to_recording, self.page_of(folder))
            with self.ui.expansion(TEXTS.mend, value=True).classes("w-full"):

                def look() -> Any:
                    self.store.path(person, visit, name)  # still there
                    files = folder / RECORDING / INDEX, folder / MOTION / SUMMARY
                    changed = [file.stat().st_mtime_ns if file.is_file() else 0 for file in files]
                    return self.store.take(folder).state, changed

                self.shown(look, lambda show: self._made(folder, show))
                self._form(folder)
            page, motion = folder / REVIEW, folder / MOTION / MOTION_FILE
            if not page.is_file() or page.stat().st_mtime < motion.stat().st_mtime:  # or it is of an earlier result
                told = self.ui.label(TEXTS.being_made).props("role=status")
                await self.ui.context.client.connected()  # what is above is shown meanwhile
                await self.made(folder, write_review, folder)
                told.delete()
            address = "/".join((self.prefix, "review", person, visit, name, "page"))
            self.ui.element("iframe").props(f'src="{address}" title="{TEXTS.review}"').style("height: 110vh")

    def file(self, person: str, visit: str, name: str, file: str) -> Any:
        """Return the page of the result, or the video."""

        def find() -> Path:
            folder = self.store.path(person, visit, name)
            found = folder / REVIEW if file == "page" else Store.video(folder) if file == VIDEO else None
            return found or folder / "-"

        kind = {"media_type": "video/mp4"} if file == VIDEO else {}  # whatever its name says
        return self.answer(find, sandbox=False, **kind)

    def _made(self, folder: Path, show: Show) -> None:
        """List the corrections, each of which can be taken back, and offer to solve again."""
        made = read_corrections(folder / RECORDING)
        for one in made:
            with self.row().classes("no-wrap"):
                self.ui.label(_words(one))
                self.icon("undo", TEXTS.take_back.format(what=_words(one)), self._without(folder, one, show))
        if _waits(folder) and self.store.take(folder).state not in AT_WORK:
            with self.row():
                self.ui.label(TEXTS.unsolved).props("role=status").classes("doubt")
                self.button(TEXTS.solve_again, lambda: self._solve(folder))

    def _form(self, folder: Path) -> None:
        """Let a person add a correction; the range comes from the page below."""
        ui = self.ui
        sensors = [str(one["name"]) for one in read_summary(folder / MOTION / SUMMARY).inputs.get("sensors") or ()]
        choices = TEXTS.corrections | {
            f"leave_out {name}": TEXTS.leave_out_sensor.format(name=name) for name in sensors
        }
        with self.row():
            kind = ui.select(choices, label=TEXTS.correction).classes("w-64")
            start = ui.number(TEXTS.from_s, format="%.2f").classes("w-24")
            stop = ui.number(TEXTS.to_s, format="%.2f").classes("w-24")
            who = ui.input(TEXTS.who_mends, value=self.who).classes("w-28")
            why = ui.input(TEXTS.why).classes("w-48")

            def add() -> None:
                if not kind.value or not who.value.strip() or not why.value.strip():
                    raise InvalidInputError(TEXTS.incomplete)
                name, _, what = kind.value.partition(" ")
                if name not in _WITHOUT_SPAN and (start.value is None or (stop.value is None and name not in EVENTS)):
                    raise InvalidInputError(TEXTS.no_range)
                ReviewPages.who = who.value.strip()
                now = datetime.now().isoformat(timespec="minutes")
                ends = {"start_s": start.value, "stop_s": None if name in EVENTS else stop.value}
                span: dict[str, Any] = {end: float(at) for end, at in ends.items() if at is not None}
                one = Correction(name, what, who=ReviewPages.who, when=now, why=why.value.strip(), **span)
                write_corrections(folder / RECORDING, [*read_corrections(folder / RECORDING), one])
                why.value = ""

            self.button(TEXTS.add_correction, add, why)

        def chosen(event: Any) -> None:
            start.value, stop.value = event.args

        ui.on("range", chosen)
        ui.add_body_html(f"<script>{_LISTEN}</script>")

    def _without(self, folder: Path, one: Correction, show: Show) -> Callable[[], None]:
        def take_back() -> None:
            made = read_corrections(folder / RECORDING)  # maybe changed in another window
            write_corrections(folder / RECORDING, [other for other in made if other != one])
            show()

        return take_back

    def _solve(self, folder: Path) -> None:
        self.work.ask(folder)
        self.ui.navigate.to(self.page_of(folder))


def _waits(folder: Path) -> bool:
    """Return whether the result is without what was corrected."""
    index, summary = folder / RECORDING / INDEX, folder / MOTION / SUMMARY
    if not (index.is_file() and summary.is_file()) or index.stat().st_mtime <= summary.stat().st_mtime:
        return False
    solved = read_summary(summary).inputs.get("corrections") or ()
    return [*solved] != [str(one) for one in read_corrections(folder / RECORDING)]


def _words(one: Correction) -> str:
    """Return a correction in the words of the page."""
    usual = TEXTS.leave_out_sensor.format(name=one.what)
    what = TEXTS.corrections.get(f"{one.kind} {one.what}".strip(), usual)
    ends = [f"{at:.2f}" if isfinite(at) else "..." for at in one.span][: 1 if one.kind in EVENTS else 2]
    where = f", {' - '.join(ends)} s" if set(ends) != {"..."} else ""
    return f"{what}{where} ({one.who}, {one.when.replace('T', ' ')}): {one.why}"
