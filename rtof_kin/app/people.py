"""Pages of the application: people, a person's visits, the trash."""

from __future__ import annotations

import tempfile
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

from rtof_kin.app.archives import read_archive, write_archive
from rtof_kin.app.frame import Frame, Show
from rtof_kin.app.start import welcome
from rtof_kin.app.store import State
from rtof_kin.app.texts import TEXTS
from rtof_kin.core.checks import some
from rtof_kin.core.errors import RtofError


class PeoplePages(Frame):
    """People, a person's visits, the trash."""

    def serve(self) -> None:
        """See `Frame`."""
        self.ui.page("/")(self.people)
        self.ui.page("/people/{person}")(self.person)
        self.ui.page("/trash")(self.trash)

    def people(self) -> None:
        """All people, and a form for another one."""

        def rows(show: Show) -> None:
            for person in self.store.names():
                with self.row():
                    self.link(person)
                    self.ui.label(self.height(person))
                    for state, count in self._states(person).items():
                        self.badge(state, count)
                    self.delete(show, person)
            if not self.store.names():
                self.ui.label(TEXTS.no_people)

        def add() -> None:
            self.store.add_person(name.value.strip(), None if height.value is None else height.value / 100)
            self.ui.navigate.to(f"/people/{name.value.strip()}")

        async def taken(event: Any) -> None:
            async def take() -> None:
                with tempfile.TemporaryDirectory() as folder:
                    await event.file.save(path := Path(folder) / "archive.zip")
                    person = await self.made(path, read_archive, self.store, path)
                self.ui.navigate.to(f"/people/{person}")

            upload.reset()
            await self.tried(take)

        with self.frame(TEXTS.people):
            self.shown(lambda: [(one, self.work.busy(self.store.root / one)) for one in self.store.names()], rows)
            with self.row():
                name = self.ui.input(TEXTS.identifier)
                height = self.ui.number(TEXTS.height, min=40, max=260).classes("w-56")
                self.button(TEXTS.add_person, add, name, height)
            upload = self.ui.upload(label=TEXTS.take_archive, auto_upload=True, on_upload=taken)
            upload.props('flat bordered accept=".zip"').classes("w-full")
            upload.on("failed", lambda: self.say(RtofError(TEXTS.not_taken)))
            welcome(self)

    def person(self, person: str) -> None:
        """Visits and recordings of a person, and forms for further ones."""

        def rows(show: Show) -> None:
            for visit in self.store.names(person):
                with self.row():
                    self.heading(visit, 2)
                    self.delete(show, person, visit)
                self.notes(person, visit)
                for name in self.store.names(person, visit):
                    with self.row():
                        self.link(person, visit, name)
                        self.chip(self.store.path(person, visit, name))
                        self.delete(show, person, visit, name)
                self._add_recording(person, visit)

        def look() -> Any:
            takes = self.store.takes(person)
            return self.store.names(person), takes, [self.store.take(path).state for path in takes]

        def correct() -> None:
            self.store.set_height(person, height.value and height.value / 100)
            label.text = self.height(person)

        async def export() -> None:
            self.check_idle(person)
            how = write_archive, self.store, person, videos.value
            left_out = await self.download(f"{person}.zip", self.store.path(person), *how)
            self.ui.notify(TEXTS.left_out.format(names=some(left_out) or "-"), timeout=10_000)

        with self.frame(person, person):
            with self.row():
                label = self.ui.label(self.height(person))
                height = self.ui.number(TEXTS.height, min=40, max=260).classes("w-56")
                self.button(TEXTS.change_height, correct, height)
            with self.row():
                self.ui.link(TEXTS.compare, f"/people/{person}/comparisons")
                self.ui.link(TEXTS.plan, f"/people/{person}/plans")
            self.shown(look, rows)
            with self.row():
                day = self.ui.input(TEXTS.date, value=date.today().isoformat()).classes("w-64")
                self.button(TEXTS.add_visit, lambda: self.store.add_visit(person, day.value.strip()), day)
            with self.row():
                self.button(TEXTS.export, export)
                videos = self.ui.switch(TEXTS.with_videos, value=True)

    def trash(self) -> None:
        """What was deleted."""

        def rows(_: Show) -> None:
            for key, names in self.store.trash().items():
                with self.row():
                    self.ui.label(" / ".join(names))
                    self.button(TEXTS.restore.format(name=names[-1]), lambda key=key: self.store.restore(key))
            if not self.store.trash():
                self.ui.label(TEXTS.empty_trash)

        with self.frame(TEXTS.trash):
            self.shown(self.store.trash, rows)

    def _states(self, person: str) -> dict[State, int]:
        """How many recordings of a person are in each state."""
        found = Counter(self.store.take(path).state for path in self.store.takes(person))
        return {state: found[state] for state in State if found[state]}

    def _add_recording(self, person: str, visit: str) -> None:
        def add() -> None:
            self.store.add_take(person, visit, name.value.strip())
            self.ui.navigate.to(f"/people/{person}/{visit}/{name.value.strip()}")

        with self.row():
            name = self.ui.input(TEXTS.recording).classes("w-64")
            self.button(TEXTS.add_recording, add, name)
            self.button(TEXTS.record, lambda: self.ui.navigate.to(f"/record/{person}/{visit}"))
