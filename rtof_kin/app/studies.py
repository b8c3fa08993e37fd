"""Pages of the application: recordings of a person compared, and a session planned."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import SANDBOX, Frame, Show
from rtof_kin.app.store import MADE, SUBJECT
from rtof_kin.app.texts import TEXTS, worded
from rtof_kin.body.motion_file import file_in
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.manifest import remove_written
from rtof_kin.plan.document import write_plan
from rtof_kin.plan.movements import MOVEMENTS
from rtof_kin.plan.plan import plan
from rtof_kin.plan.protocol import Protocol, sensor_places
from rtof_kin.plan.setup import setup_of
from rtof_kin.recording.subject import read_subject
from rtof_kin.reporting.comparison import compare
from rtof_kin.reporting.document import write
from rtof_kin.reporting.visits import follow
from rtof_kin.setup.run import MOTION

_PAGES: Final = ("follow.html", "comparison.html", "plan.html", "instructions.html")


class StudyPages(Frame):
    """Comparisons and plans of a person: chosen on the page, made in a process, kept in the person's folder."""

    def serve(self) -> None:
        """See `Frame`."""
        self.said: dict[Path, str] = {}  # why the last one could not be made
        self.ui.page("/people/{person}/comparisons")(self.comparisons)
        self.ui.page("/people/{person}/plans")(self.plans)
        self.app.get("/made/{person}/{kind}/{name}/{file}")(self.file)

    def comparisons(self, person: str) -> None:
        """All visits, two recordings, or the sides of one."""
        with self.frame(TEXTS.compare, person, TEXTS.compare):
            folder, found = self.store.path(person), self._finished(person)
            make, visits = partial(self._make, folder / MADE[0]), sorted({Path(path).parent.name for path in found})
            if len(visits) > 1:
                with self.row():
                    first = self._choice(TEXTS.baseline, visits, visits[0])
                    self.button(TEXTS.compare_visits, lambda: make(compare_visits, folder, first.value))
            if found:
                with self.row():
                    a = self._choice(TEXTS.recording_a, found, next(iter(found)))
                    b = self._choice(TEXTS.recording_b, {"": TEXTS.sides, **found}, "")
                    self.button(TEXTS.compare, lambda: make(compare_motions, [a.value, b.value]))
            else:
                self.ui.label(TEXTS.nothing_to_compare)
            self._shown(folder / MADE[0])

    def plans(self, person: str) -> None:
        """A session before it is recorded."""
        places = sensor_places(skeleton := SkeletonModel.default(), list(skeleton.sensors))
        with self.frame(TEXTS.plan, person, TEXTS.plan):
            folder = self.store.path(person)
            own = {path: TEXTS.as_in.format(name=name) for path, name in self._finished(person).items()}
            what = self._choice(TEXTS.movement, {n: n.replace("_", " ") for n in MOVEMENTS} | own, "gait")
            said = self.ui.label()
            said.bind_text_from(what, "value", lambda name: MOVEMENTS[name].description if name in MOVEMENTS else "")
            worn = self._choice(TEXTS.sensors, {n: f"{n}: {at}" for n, at in places.items()}, [], multiple=True)
            search = self.ui.switch(TEXTS.plan_search, value=True)

            def ask() -> Any:
                protocol = Protocol(what.value, sensors=tuple(worn.value), any_camera=True)
                return self._make(folder / MADE[1], make_plan, protocol, folder / SUBJECT, search.value)

            self.button(TEXTS.make_plan, ask)
            self._shown(folder / MADE[1])

    def file(self, person: str, kind: str, name: str, file: str) -> Any:
        """Return a page of a comparison or of a plan."""
        known = kind in MADE and name[:1].isdigit() and file in _PAGES
        return self.answer(lambda: self.store.path(person) / (f"{kind}/{name}/{file}" if known else "-"))

    def _finished(self, person: str) -> dict[str, str]:
        """Return the recordings with a result: path -> name."""
        found = [path for path in self.store.takes(person) if file_in(path / MOTION)]
        return {str(path): " / ".join(path.parts[-2:]) for path in found}

    def _choice(self, label: str, options: Any, value: Any, **how: Any) -> Any:
        return (
            self.ui.select(options, label=label, value=value, **how).classes("w-80").props("use-chips" if how else "")
        )

    async def _make(self, place: Path, function: Callable[..., None], *arguments: Any) -> None:
        self.said.pop(place, None)
        try:
            await self.made(place.parent, function, *arguments, place / time.strftime("%Y-%m-%d_%H-%M-%S"))
        except RtofError as error:
            self.said[place] = worded(str(error))

    def _shown(self, place: Path) -> None:
        """Show whether something is being made, the latest that was, and links to all."""
        ui = self.ui

        def rows(_: Show) -> None:
            if place.parent in self.making:
                ui.label(TEXTS.being_made).props("role=status").classes("text-lg")
                ui.linear_progress(show_value=False).props(f'indeterminate aria-label="{TEXTS.being_made}"')
            if said := self.said.get(place):
                ui.label(said).props("role=alert").classes("doubt text-lg")
            for number, folder in enumerate(made()):
                address = f"/made/{place.parent.name}/{place.name}/{folder.name}"
                pages = [file for file in _PAGES if (folder / file).is_file()]
                with self.row():
                    ui.label(folder.name.replace("_", " ")).classes("text-lg")
                    for file in pages:
                        ui.link(TEXTS.pages[file], f"{address}/{file}", new_tab=True)
                    said = TEXTS.delete_made.format(name=folder.name)
                    self.icon("delete", said, lambda one=folder: remove_written(one))
                if number == 0 and pages:
                    source = f'src="{self.prefix}{address}/{pages[0]}" title="{TEXTS.pages[pages[0]]}"'
                    ui.element("iframe").props(f'{source} sandbox="{SANDBOX}"')

        def made() -> list[Path]:  # the latest first
            return sorted((one for one in place.glob("[0-9]*") if one.is_dir()), reverse=True)

        self.shown(lambda: (place.parent in self.making, self.said.get(place), made()), rows)


# --- in the process ------------------------------------------------------------------------------


def compare_visits(visits: Path, first: str, place: Path) -> None:
    """Write the comparison of visits into a folder."""
    write(follow(visits, baseline=first), place)


def compare_motions(motions: Sequence[str], place: Path) -> None:
    """Write the comparison of two recordings, or of the sides of one, into a folder."""
    write(compare(*filter(None, motions)), place)


def make_plan(protocol: Protocol, subject: Path, search: bool, place: Path) -> None:
    """Write a plan into a folder, of the person where there is a file."""
    known = read_subject(subject) if subject.is_file() else None
    write_plan(plan(protocol, setup_of(protocol, subject=known), search=search, workers=1), place)
