"""Pages of the application: people, a person's visits, a recording, the trash."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.store import AT_WORK, FILES, State, Store
from rtof_kin.app.texts import TEXTS
from rtof_kin.app.work import REPORT, Work
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.manifest import make_private
from rtof_kin.core.packages import optional
from rtof_kin.reporting.page import PAGE
from rtof_kin.setup.init import FINDINGS, read_findings
from rtof_kin.setup.people import PICTURE
from rtof_kin.setup.run import RECORDING
from rtof_kin.setup.sources import SourceKind, Sources, recognise_source

Show = Callable[[], None]
_COLOURS: Final = {
    State.DRAFT: "grey-8",
    State.WAITING: "blue-9",
    State.RUNNING: "blue-9",
    State.DONE: "green-9",
    State.ATTENTION: "deep-orange-10",
    State.FAILED: "red-10",
}
_EVERY: Final = 0.5  # [s] between two looks at what has changed
_STYLE: Final = """
<style>
  .nicegui-content { max-width: 70rem; margin: 0 auto; }
  a { display: inline-block; line-height: 40px; color: #1565c0 !important; }
  .body--dark a { color: #90caf9 !important; }
  a:focus-visible, button:focus-visible { outline: 3px solid #1565c0; outline-offset: 2px; }
  .doubt { color: #b00020; }
  .body--dark .doubt { color: #ff8a80; }
  .q-btn { min-height: 40px; }
  iframe { width: 100%; height: 85vh; border: 1px solid #9aa4ae; background: white; }
</style>
"""
_SANDBOX: Final = "allow-scripts allow-downloads allow-modals"
"""What the report may do: run its own script, and reach nothing of the application."""


_RESULTS: Final = {PAGE: PAGE, PICTURE: f"{RECORDING}/{PICTURE}"}  #: Files that are shown, and where they are


class Pages:
    """The pages of one workspace."""

    def __init__(self, nicegui: Any, store: Store, work: Work, prefix: str):
        """Let NiceGUI serve them. `nicegui`: the package. `prefix`: path under which it is served."""
        self.ui, self.run, self.store, self.work, self.prefix = nicegui.ui, nicegui.run, store, work, prefix
        self.ui.page("/")(self.people)
        self.ui.page("/people/{person}")(self.person)
        self.ui.page("/people/{person}/{visit}/{name}")(self.recording)
        self.ui.page("/trash")(self.trash)
        nicegui.app.get("/results/{person}/{visit}/{name}/{file}")(self.file)

    # --- pages -------------------------------------------------------------------------------------------

    def people(self) -> None:
        """All people, and a form for another one."""

        def rows(show: Show) -> None:
            for person in self.store.names():
                with self._row():
                    self._link(person)
                    self.ui.label(self._height(person))
                    self._delete(show, person)
            if not self.store.names():
                self.ui.label(TEXTS.no_people)

        def add() -> None:
            self.store.add_person(name.value.strip(), None if height.value is None else height.value / 100)
            self.ui.navigate.to(f"/people/{name.value.strip()}")

        with self._frame(TEXTS.people):
            self._shown(self.store.names, rows)
            with self._row():
                name = self.ui.input(TEXTS.identifier)
                height = self.ui.number(TEXTS.height, min=40, max=260).classes("w-56")
                self._button(TEXTS.add_person, add, name, height)

    def person(self, person: str) -> None:
        """Visits and recordings of a person, and forms for further ones."""

        def rows(show: Show) -> None:
            for visit in self.store.names(person):
                with self._row():
                    self._heading(visit, 2)
                    self._delete(show, person, visit)
                for name in self.store.names(person, visit):
                    with self._row():
                        self._link(person, visit, name)
                        self._chip(self.store.path(person, visit, name))
                        self._delete(show, person, visit, name)
                self._add_recording(person, visit)

        def look() -> Any:
            takes = self.store.takes(person)
            return self.store.names(person), takes, [self.store.take(path).state for path in takes]

        with self._frame(person, person):
            self.ui.label(self._height(person))
            self._shown(look, rows)
            with self._row():
                day = self.ui.input(TEXTS.date, value=date.today().isoformat()).classes("w-64")
                self._button(TEXTS.add_visit, lambda: self.store.add_visit(person, day.value.strip()), day)

    def recording(self, person: str, visit: str, name: str) -> None:
        """One recording: its files, its reconstruction, its result."""

        async def dropped(event: Any) -> None:
            async def save() -> None:
                path = self.store.new_file(folder, event.file.name)
                part = path.with_name(f".{path.name}")
                try:
                    await event.file.save(part)
                    make_private(part)
                    part.rename(path)
                finally:
                    part.unlink(missing_ok=True)

            await self._tried(save)

        def files(_: Show) -> None:
            free = self.store.take(folder).state not in AT_WORK
            upload.set_visibility(free)
            for path in self.store.files(folder):
                with self._row():
                    self.ui.label(f"{path.name}: {_kind(path)}")
                    if free:
                        self._icon("close", TEXTS.remove.format(name=path.name), lambda path=path: path.unlink())

        def look() -> Any:
            found = (folder / RECORDING / FINDINGS).is_file(), (folder / PAGE).is_file()
            return self.store.take(folder), self.store.files(folder), found

        with self._frame(name, person, visit, name):
            folder = self.store.path(person, visit, name)
            self._heading(TEXTS.files, 2)
            upload = self.ui.upload(label=TEXTS.drop, multiple=True, auto_upload=True, on_upload=dropped)
            upload.props("flat bordered").classes("w-full")
            parts = (lambda show: self._reconstruction(folder, show)), (lambda _: self._result(folder))
            self._shown(look, files, *parts)

    def trash(self) -> None:
        """What was deleted."""

        def rows(_: Show) -> None:
            for key, names in self.store.trash().items():
                with self._row():
                    self.ui.label(" / ".join(names))
                    self._button(TEXTS.restore.format(name=names[-1]), lambda key=key: self.store.restore(key))
            if not self.store.trash():
                self.ui.label(TEXTS.empty_trash)

        with self._frame(TEXTS.trash):
            self._shown(self.store.trash, rows)

    def file(self, person: str, visit: str, name: str, file: str) -> Any:
        """Return the report of a recording, or the picture of the people in it."""
        answers = optional("starlette.responses", "app")
        try:
            path = self.store.path(person, visit, name) / _RESULTS.get(file, "-")
        except RtofError as error:
            return answers.PlainTextResponse(str(error), 404)
        if not path.is_file() or path.is_symlink():
            return answers.PlainTextResponse(TEXTS.no_file, 404)
        policy = f"sandbox {_SANDBOX} allow-popups; frame-ancestors 'self'"
        headers = {"content-security-policy": policy, "cache-control": "no-store"}
        return answers.FileResponse(path, headers=headers)

    # --- parts of the page of a recording ----------------------------------------------------------------

    def _reconstruction(self, folder: Path, show: Show) -> None:
        ui, take = self.ui, self.store.take(folder)
        with self._row():
            self._heading(TEXTS.reconstruct_title, 2)
            self._chip(folder)
        if take.state in AT_WORK:
            self._progress(folder)
            self._button(TEXTS.cancel, lambda: self.work.cancel(folder))
            return
        if take.said:
            ui.label(take.said).props("role=alert").classes("doubt text-lg")
        try:
            sources = self.store.sources(folder)
        except RtofError as error:
            ui.label(str(error).replace(f"{folder / FILES}/", ""))
            return
        ui.label(_ready(sources))
        fields, number = list[Any](), None
        if sources.keypoints is not None and sources.video is None and sources.camera is None:
            width, height = take.size_px or (None, None)
            with self._row():
                for label, value in ((TEXTS.width_px, width), (TEXTS.height_px, height), (TEXTS.rate, take.rate_hz)):
                    fields.append(ui.number(label, value=value, min=1).classes("w-80"))

        if (folder / RECORDING / PICTURE).is_file():
            with ui.expansion(TEXTS.who, value=take.state is State.FAILED).classes("w-full"):
                ui.image(self._address(folder, PICTURE)).props(f'alt="{TEXTS.who}"')
                number = ui.number(TEXTS.number, value=take.person, min=1).classes("w-80")

        def ask() -> None:
            width, height, rate = (field.value for field in fields) if fields else (None, None, None)
            if fields and not (width and height):
                raise RtofError(TEXTS.size_needed)
            size = (int(width), int(height)) if width and height else None
            chosen = int(number.value) if number is not None and number.value else None
            self.store.change(folder, size_px=size, rate_hz=rate, person=chosen)
            self.work.ask(folder)
            show()

        self._button(TEXTS.again if (folder / PAGE).is_file() else TEXTS.reconstruct, ask, *fields)

    def _progress(self, folder: Path) -> None:
        line = self.ui.label().props("role=status").classes("text-lg")
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
                said = names.get(last, last) if any(n < of for n, of in done.values()) else TEXTS.finishing
            line.text = said if left is None else f"{said}: {TEXTS.left.format(time=_time(left))}"
            for stage in done.keys() - {REPORT}:
                if stage not in bars:
                    with rows:
                        self.ui.label(names.get(stage, stage))
                        bars[stage] = self.ui.linear_progress(show_value=False)
                        bars[stage].props["aria-label"] = names.get(stage, stage)
                bars[stage].value = done[stage][0] / max(1, done[stage][1])

        update()
        self.ui.timer(_EVERY, update)

    def _result(self, folder: Path) -> None:
        ui, ready = self.ui, self.store.take(folder).state not in AT_WORK and (folder / PAGE).is_file()
        if (folder / RECORDING / FINDINGS).is_file():
            found = read_findings(folder / RECORDING)
            with ui.expansion(TEXTS.findings, value=not ready).classes("w-full"):
                for kind, words in TEXTS.kinds:
                    for sentence in getattr(found, kind):
                        ui.label(f"{words}: {sentence}").classes("doubt" if kind == "doubtful" else "")
        if not ready:
            return
        self._heading(TEXTS.result, 2)
        address = self._address(folder, PAGE)
        ui.link(TEXTS.report, address, new_tab=True)
        ui.element("iframe").props(f'src="{self.prefix}{address}" title="{TEXTS.result}" sandbox="{_SANDBOX}"')

    def _add_recording(self, person: str, visit: str) -> None:
        def add() -> None:
            self.store.add_take(person, visit, name.value.strip())
            self.ui.navigate.to(f"/people/{person}/{visit}/{name.value.strip()}")

        with self._row():
            name = self.ui.input(TEXTS.recording).classes("w-64")
            self._button(TEXTS.add_recording, add, name)

    # --- pieces ------------------------------------------------------------------------------------------

    @contextmanager
    def _frame(self, title: str, *names: str) -> Iterator[None]:
        """Lay out a page; what is not there, or has a hostile name, is said in its place."""
        ui = self.ui
        ui.page_title(f"{title} · {TEXTS.title}")
        ui.add_head_html(_STYLE)
        ui.colors(primary="#1565c0")
        with ui.row().props("role=navigation").classes("w-full"):
            ui.link(TEXTS.people, "/")
            for person in names[:1]:
                ui.link(person, f"/people/{person}")
            ui.space()
            ui.link(TEXTS.trash, "/trash")
        with ui.column().props("role=main").classes("w-full"):
            self._heading(" / ".join(names) or title, 1)
            try:
                yield
            except (RtofError, OSError) as error:
                ui.label(str(error)).props("role=alert").classes("doubt text-lg")

    def _shown(self, look: Callable[[], Any], *fills: Callable[[Show], None]) -> None:
        """Fill parts of a page, and again when what is looked at has changed, maybe in another window."""
        parts = [(self.ui.column().classes("w-full"), fill) for fill in fills]
        before = None

        def show() -> None:
            nonlocal before
            before = look()
            for part, fill in parts:
                part.clear()
                with part:
                    fill(show)

        def again() -> None:
            try:
                if look() != before:
                    show()
            except (RtofError, OSError):  # deleted in another window
                self.ui.navigate.to("/")

        show()
        self.ui.timer(_EVERY, again)

    async def _tried(self, action: Callable[[], Awaitable[None] | None]) -> None:
        """Do something; what goes wrong is said."""
        try:
            if (waited := action()) is not None:
                await waited
        except (RtofError, OSError) as error:
            said = str(error) if isinstance(error, RtofError) else TEXTS.not_written.format(error=error.strerror)
            self.ui.notify(said, type="negative", multi_line=True, timeout=10_000)

    def _button(self, text: str, action: Callable[..., Any], *fields: Any) -> None:
        """A button; Enter in one of the fields presses it too."""
        self.ui.button(text, on_click=lambda: self._tried(action)).props("no-caps")
        for field in fields:
            field.on("keydown.enter", lambda: self._tried(action))

    def _icon(self, icon: str, said: str, action: Callable[..., Any]) -> None:
        button = self.ui.button(icon=icon, on_click=lambda: self._tried(action)).props("flat round dense")
        button.props["aria-label"] = said

    def _delete(self, show: Show, *names: str) -> None:
        def delete() -> None:
            if self.work.busy(self.store.path(*names)):
                raise RtofError(TEXTS.at_work)
            self.store.delete(*names)
            self.ui.notify(TEXTS.deleted.format(name=names[-1]))
            show()

        self._icon("delete", TEXTS.delete.format(name=names[-1]), delete)

    def _heading(self, text: str, level: int) -> None:
        size = "text-3xl" if level == 1 else "text-xl pt-4"
        self.ui.label(text).props(f"role=heading aria-level={level}").classes(size)

    def _row(self) -> Any:
        return self.ui.row().classes("items-center")

    def _link(self, *names: str) -> None:
        self.ui.link(names[-1], "/".join(("/people", *names))).classes("text-lg")

    def _address(self, folder: Path, file: str) -> str:
        return "/".join(("/results", *folder.relative_to(self.store.root).parts, file))

    def _chip(self, folder: Path) -> None:
        state = self.store.take(folder).state
        self.ui.badge(state.value, color=_COLOURS[state]).classes("text-sm p-1")

    def _height(self, person: str) -> str:
        try:
            known = self.store.subject(person).height_m
        except RtofError as error:
            return str(error)
        return "" if known is None else TEXTS.of_height.format(height=100 * known.value)


def _kind(path: Path) -> str:
    try:
        kind = recognise_source(path)
    except RtofError as error:
        return str(error)
    return TEXTS.unknown if kind is SourceKind.UNKNOWN else kind.value


def _ready(sources: Sources) -> str:
    """Say what is used."""
    kinds = sorted({recognise_source(path).value for path in sources.paths})
    return TEXTS.ready.format(parts=", ".join([*kinds, *([] if sources.seen else [TEXTS.without_image])]))


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
