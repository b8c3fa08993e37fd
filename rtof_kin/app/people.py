"""Pages of the application: people, a person's visits, the trash."""

from __future__ import annotations

from datetime import date
from typing import Any

from rtof_kin.app.frame import Frame, Show
from rtof_kin.app.start import welcome
from rtof_kin.app.texts import TEXTS


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
                    self.delete(show, person)
            if not self.store.names():
                self.ui.label(TEXTS.no_people)

        def add() -> None:
            self.store.add_person(name.value.strip(), None if height.value is None else height.value / 100)
            self.ui.navigate.to(f"/people/{name.value.strip()}")

        with self.frame(TEXTS.people):
            self.shown(self.store.names, rows)
            with self.row():
                name = self.ui.input(TEXTS.identifier)
                height = self.ui.number(TEXTS.height, min=40, max=260).classes("w-56")
                self.button(TEXTS.add_person, add, name, height)
            welcome(self)

    def person(self, person: str) -> None:
        """Visits and recordings of a person, and forms for further ones."""

        def rows(show: Show) -> None:
            for visit in self.store.names(person):
                with self.row():
                    self.heading(visit, 2)
                    self.delete(show, person, visit)
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

        with self.frame(person, person):
            with self.row():
                label = self.ui.label(self.height(person))
                height = self.ui.number(TEXTS.height, min=40, max=260).classes("w-56")
                self.button(TEXTS.change_height, correct, height)
            self.shown(look, rows)
            with self.row():
                day = self.ui.input(TEXTS.date, value=date.today().isoformat()).classes("w-64")
                self.button(TEXTS.add_visit, lambda: self.store.add_visit(person, day.value.strip()), day)

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

    def _add_recording(self, person: str, visit: str) -> None:
        def add() -> None:
            self.store.add_take(person, visit, name.value.strip())
            self.ui.navigate.to(f"/people/{person}/{visit}/{name.value.strip()}")

        with self.row():
            name = self.ui.input(TEXTS.recording).classes("w-64")
            self.button(TEXTS.add_recording, add, name)
            self.button(TEXTS.record, lambda: self.ui.navigate.to(f"/record/{person}/{visit}"))
