"""What the pages of the application share: the frame, rows, buttons, and parts that follow what changes."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final

from rtof_kin.app.store import NOTES, State, Store
from rtof_kin.app.texts import TEXTS, languages, speak, worded
from rtof_kin.app.work import Work
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.text import write_text
from rtof_kin.core.jobs.processes import end_with_parent
from rtof_kin.core.packages import optional

Show = Callable[[], None]
SANDBOX: Final = "allow-scripts allow-downloads allow-modals"
"""What a page that was made may do: run its own script, and reach nothing of the application."""
_COLOURS: Final = {
    State.DRAFT: "grey-8",
    State.WAITING: "blue-9",
    State.RUNNING: "blue-9",
    State.ASKING: "deep-orange-10",
    State.DONE: "green-9",
    State.ATTENTION: "deep-orange-10",
    State.FAILED: "red-10",
}
EVERY: Final = 0.5  # [s] between two looks at what has changed
_HEAD: Final = Path(__file__).parent / "assets" / "head.html"  #: Style of all pages


class Frame:
    """The pages of one kind: a frame around each, and the pieces that they are made of."""

    making: ClassVar[list[Path]] = []  #: Folders of which something is being made

    def __init__(self, nicegui: Any, store: Store, work: Work, prefix: str):
        """`nicegui`: the package. `prefix`: path under which the pages are served."""
        self.app, self.ui, self.run = nicegui.app, nicegui.ui, nicegui.run
        self.store, self.work, self.prefix = store, work, prefix
        self.serve()

    def serve(self) -> None:
        """Let NiceGUI serve the pages of this kind."""
        raise NotImplementedError

    @contextmanager
    def frame(self, title: str, *names: str) -> Iterator[None]:
        """Lay out a page; what is not there, or has a hostile name, is said in its place."""
        ui = self.ui
        ui.page_title(f"{title} · {TEXTS.title}")
        ui.add_head_html(_HEAD.read_text(encoding="utf-8"))
        ui.colors(primary="#1565c0")
        ui.on_exception(self.say)  # of what is not `tried`
        with ui.row().props("role=navigation").classes("w-full"):
            ui.link(TEXTS.people, "/")
            for person in names[:1]:
                ui.link(person, f"/people/{person}")
            ui.space()
            ui.link(TEXTS.trash, "/trash")
            for code in languages().keys() - {TEXTS.code}:
                self.button(
                    languages()[code].language, lambda code=code: self.speak(code), props=f"flat dense lang={code}"
                )
        with ui.column().classes("w-full"):
            self.heading(" / ".join(names) or title, 1)
            try:
                yield
            except (RtofError, OSError) as error:
                ui.label(worded(str(error))).props("role=alert").classes("doubt text-lg")

    def speak(self, code: str) -> None:
        """Choose the language of the workspace."""
        self.store.choose(language=code)
        speak(code)
        self.app.config.language = code
        self.ui.navigate.reload()

    def shown(self, look: Callable[[], Any], *fills: Callable[[Show], None]) -> Show:
        """Fill parts of a page, and again when what is looked at has changed, maybe in another window. Returns what is
        called after a change that the parts show already, so that the focus stays where it is.
        """
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

        def kept() -> None:
            nonlocal before
            before = look()

        show()
        self.ui.timer(EVERY, again)
        return kept

    async def tried(self, action: Callable[[], Awaitable[None] | None]) -> None:
        """Do something; what goes wrong is said."""
        try:
            if (waited := action()) is not None:
                await waited
        except (RtofError, OSError) as error:
            self.say(error)

    def say(self, error: Exception) -> None:
        """Say what went wrong."""
        said = TEXTS.not_written.format(error=error.strerror) if isinstance(error, OSError) else str(error)
        self.ui.notify(worded(said), type="negative", multi_line=True, timeout=10_000)

    def answer(self, find: Callable[[], Path], sandbox: bool = True, **how: Any) -> Any:
        """Return a file as an answer, or why there is none. `sandbox`: it is a page that reaches nothing of the
        application. `how`: of Starlette's `FileResponse`.
        """
        answers = optional("starlette.responses", "app")
        try:
            path = find()
        except RtofError as error:
            return answers.PlainTextResponse(str(error), 404)
        if not path.is_file() or path.is_symlink():
            return answers.PlainTextResponse(TEXTS.no_file, 404)
        policy = {"content-security-policy": f"sandbox {SANDBOX} allow-popups; frame-ancestors 'self'"}
        return answers.FileResponse(path, headers={"cache-control": "no-store"} | (policy if sandbox else {}), **how)

    def button(self, text: str, action: Callable[..., Any], *fields: Any, props: str = "") -> Any:
        """A button, which is returned; Enter in one of the fields presses it too."""
        button = self.ui.button(text, on_click=lambda: self.tried(action)).props(f"no-caps {props}")
        for field in fields:
            field.on("keydown.enter", lambda: self.tried(action))
        return button

    def icon(self, icon: str, said: str, action: Callable[..., Any]) -> None:
        """A button with a picture; `said`: what it does, for a screen reader."""
        button = self.ui.button(icon=icon, on_click=lambda: self.tried(action)).props("flat round dense")
        button.props["aria-label"] = said

    def delete(self, show: Show, *names: str) -> None:
        """A button that moves a person, a visit or a recording to the trash."""

        def delete() -> None:
            self.check_idle(*names)
            self.store.delete(*names)
            self.ui.notify(TEXTS.deleted.format(name=names[-1]))
            show()

        self.icon("delete", TEXTS.delete.format(name=names[-1]), delete)

    def check_idle(self, *names: str) -> None:
        """Raise `RtofError` while something is made of a person, a visit or a recording."""
        folder = self.store.path(*names)
        if self.work.busy(folder) or any(one.is_relative_to(folder) or one in folder.parents for one in self.making):
            raise RtofError(TEXTS.at_work)

    def notes(self, *names: str) -> None:
        """The notes of a visit or a recording, which are saved as they are typed."""
        path = self.store.path(*names) / NOTES

        def read() -> str:
            return (
                path.read_text(encoding="utf-8", errors="replace") if path.is_file() and not path.is_symlink() else ""
            )

        def save() -> None:
            if (typed := field.value or "") != seen[0]:
                self.store.path(*names)  # still there
                seen[0] = typed
                write_text(path, typed, overwrite=True)

        def look() -> None:
            if (found := read()) != seen[0]:  # typed in another window
                seen[0] = field.value = found

        seen = [read()]
        field = self.ui.textarea(TEXTS.notes.format(name=names[-1]), value=seen[0]).classes("w-full")
        field.props("autogrow outlined rows=1 debounce=400").on_value_change(lambda: self.tried(save))
        self.ui.timer(EVERY, look)

    async def made(self, folder: Path, function: Callable[..., Any], *arguments: Any) -> Any:
        """Let another process call a function, which makes something of a folder; `RtofError` where it cannot."""
        if folder in self.making:
            raise RtofError(TEXTS.at_work)
        self.making.append(folder)
        try:
            found, said = await self.run.cpu_bound(_called, TEXTS.code, function, *arguments) or (None, "")
        except BrokenExecutor as error:
            raise RtofError(TEXTS.lost.format(how=error)) from error
        finally:
            self.making.remove(folder)
        if said:
            raise RtofError(said.replace(f"{folder}/", ""))
        return found

    async def download(self, name: str, folder: Path, write: Callable[..., Any], *arguments: Any) -> Any:
        """Let another process write a file, whose path is its last argument, and give it to the browser."""
        new = Path(tempfile.mkdtemp())  # in the workspace, see `serve`
        self.ui.context.client.on_delete(lambda: shutil.rmtree(new, ignore_errors=True))
        told = self.ui.notification(TEXTS.making.format(name=name), spinner=True, timeout=None)
        try:
            found = await self.made(folder, write, *arguments, new / name)
        finally:
            told.dismiss()
        self.ui.download.file(new / name, name)
        return found

    def heading(self, text: str, level: int) -> None:
        """A heading of a level."""
        size = "text-3xl" if level == 1 else "text-xl pt-4"
        self.ui.label(text).props(f"role=heading aria-level={level}").classes(size)

    def row(self) -> Any:
        """A row of pieces."""
        return self.ui.row().classes("items-center")

    def link(self, *names: str) -> None:
        """A link to the page of a person or a recording."""
        self.ui.link(names[-1], "/".join(("/people", *names))).classes("text-lg")

    def page_of(self, folder: Path, *more: str) -> str:
        """Return the address of the page of a recording, or of one below it."""
        return "/".join(("/people", *folder.relative_to(self.store.root).parts, *more))

    def address(self, folder: Path, file: str) -> str:
        """Return the address of a file of a recording."""
        return "/".join(("/results", *folder.relative_to(self.store.root).parts, file))

    def chip(self, folder: Path) -> None:
        """The state of a recording."""
        self.badge(self.store.take(folder).state)

    def badge(self, state: State, count: int = 0) -> None:
        """A state, maybe of so many recordings."""
        text = TEXTS.counted if count else "{state}"
        said = text.format(count=count, state=TEXTS.states[state.value])
        self.ui.badge(said, color=_COLOURS[state]).classes("text-sm p-1")

    def height(self, person: str) -> str:
        """Return what is known of the height of a person."""
        try:
            known = self.store.subject(person).height_m
        except RtofError as error:
            return str(error)
        return "" if known is None else TEXTS.of_height.format(height=100 * known.value)


_ends_with_parent: Final = cache(end_with_parent)  # a process of the pool makes several things


def _called(code: str, function: Callable[..., Any], *arguments: Any) -> tuple[Any, str]:
    """Return what a function returns, and what went wrong; in a process of its own."""
    _ends_with_parent()
    speak(code)
    try:
        with without_warnings("rtof_kin"):
            return function(*arguments), ""
    except RtofError as error:
        return None, str(error)
    except OSError as error:
        return None, TEXTS.not_written.format(error=error.strerror)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
