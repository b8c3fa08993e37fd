"""Page of a recording: its files, its reconstruction, its result."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import EVERY, Frame, Show
from rtof_kin.app.store import AT_WORK, FILES, State
from rtof_kin.app.texts import TEXTS
from rtof_kin.app.work import REPORT
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.manifest import make_private
from rtof_kin.core.packages import optional
from rtof_kin.reporting.page import PAGE
from rtof_kin.setup.init import FINDINGS, read_findings
from rtof_kin.setup.people import PICTURE
from rtof_kin.setup.run import RECORDING
from rtof_kin.setup.sources import Sources, recognise_source

_SANDBOX: Final = "allow-scripts allow-downloads allow-modals"
"""What the report may do: run its own script, and reach nothing of the application."""
_RESULTS: Final = {PAGE: PAGE, PICTURE: f"{RECORDING}/{PICTURE}"}  #: Files that are shown, and where they are


class TakePages(Frame):
    """A recording: its files, its reconstruction, its result."""

    def serve(self) -> None:
        """See `Frame`."""
        self.ui.page("/people/{person}/{visit}/{name}")(self.recording)
        self.app.get("/results/{person}/{visit}/{name}/{file}")(self.file)

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

            await self.tried(save)

        def files(_: Show) -> None:
            free = self.store.take(folder).state not in AT_WORK
            upload.set_visibility(free)
            for path in self.store.files(folder):
                with self.row():
                    self.ui.label(f"{path.name}: {_kind(path)}")
                    if free:
                        self.icon("close", TEXTS.remove.format(name=path.name), lambda path=path: path.unlink())

        def look() -> Any:
            found = (folder / RECORDING / FINDINGS).is_file(), (folder / PAGE).is_file()
            return self.store.take(folder), self.store.files(folder), found

        with self.frame(name, person, visit, name):
            folder = self.store.path(person, visit, name)
            self.heading(TEXTS.files, 2)
            upload = self.ui.upload(label=TEXTS.drop, multiple=True, auto_upload=True, on_upload=dropped)
            upload.props("flat bordered").classes("w-full")
            parts = (lambda show: self._reconstruction(folder, show)), (lambda _: self._result(folder))
            self.shown(look, files, *parts)

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

    def _reconstruction(self, folder: Path, show: Show) -> None:
        ui, take = self.ui, self.store.take(folder)
        with self.row():
            self.heading(TEXTS.reconstruct_title, 2)
            self.chip(folder)
        if take.state in AT_WORK:
            self._progress(folder)
            self.button(TEXTS.cancel, lambda: self.work.cancel(folder))
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
            with self.row():
                for label, value in ((TEXTS.width_px, width), (TEXTS.height_px, height), (TEXTS.rate, take.rate_hz)):
                    fields.append(ui.number(label, value=value, min=1).classes("w-80"))

        if (folder / RECORDING / PICTURE).is_file():
            with ui.expansion(TEXTS.who, value=take.state is State.FAILED).classes("w-full"):
                ui.image(self.address(folder, PICTURE)).props(f'alt="{TEXTS.who}"')
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

        self.button(TEXTS.again if (folder / PAGE).is_file() else TEXTS.reconstruct, ask, *fields)

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
        self.ui.timer(EVERY, update)

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
        self.heading(TEXTS.result, 2)
        address = self.address(folder, PAGE)
        with self.row().classes("gap-8"):
            ui.link(TEXTS.to_review, "/".join(("/people", *folder.relative_to(self.store.root).parts, "review")))
            ui.link(TEXTS.report, address, new_tab=True)
        ui.element("iframe").props(f'src="{self.prefix}{address}" title="{TEXTS.result}" sandbox="{_SANDBOX}"')


def _kind(path: Path) -> str:
    try:
        return dict(TEXTS.sources)[recognise_source(path).value]
    except RtofError as error:
        return str(error)


def _ready(sources: Sources) -> str:
    """Say what is used."""
    kinds = sorted({_kind(path) for path in sources.paths})
    return TEXTS.ready.format(parts=", ".join([*kinds, *([] if sources.seen else [TEXTS.without_image])]))


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
