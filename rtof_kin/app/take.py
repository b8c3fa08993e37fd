"""Page of a recording: its files, its reconstruction, its result."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.downloads import downloads
from rtof_kin.app.frame import EVERY, SANDBOX, Frame, Show
from rtof_kin.app.sources import PICTURES, SourceParts
from rtof_kin.app.store import AT_WORK, State
from rtof_kin.app.texts import TEXTS, worded
from rtof_kin.app.work import REPORT
from rtof_kin.core.errors import RtofError
from rtof_kin.reporting.page import PAGE

_RESULTS: Final = {PAGE: PAGE, **PICTURES}  #: Files that are shown, and where they are


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
        rows, bars, names = self.ui.column().classes("w-full"), dict[str, Any](), dict(TEXTS.stages)

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
        downloads(self, folder)


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
