"""Page of the first steps: five of them in pictures, the demo, and a check of this computer."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final
from urllib.parse import urlparse

from rtof_kin.app.frame import EVERY, Frame, Show
from rtof_kin.app.store import Store
from rtof_kin.app.texts import TEXTS, languages
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.manifest import make_private
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.jobs.memory import available_memory
from rtof_kin.core.packages import install
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import write_raw_files
from rtof_kin.vision.model_download import ModelSet, cached_models, fetch_models, model_sets

_PERSON, _TAKE = "demo", "exercises"
_LONGEST: Final = 20.0  # [s] of looking for cameras or streams
_LEAST: Final = 4.0  # [1e9 bytes] of memory, and on the disk
_CAMERAS: Final = "import cv2; found = [str(i) for i in range(4) if cv2.VideoCapture(i).read()[0]]"
_STREAMS: Final = "import pylsl; found = sorted({one.name() for one in pylsl.resolve_streams(2.0)})"
_BROWSERS: Final = (
    *("chromium", "chromium-browser", "google-chrome", "chrome", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)
_STEPS: Final = load_toml(Path(__file__).with_suffix(".toml"))  #: Pictures of the five steps


@dataclass(frozen=True)
class Found:
    """One line of the check: whether it is good, what was looked at, what was found, and what to do."""

    good: bool
    what: str
    said: str
    todo: str = ""
    models: str = ""  #: Name of a set of models that is meant


_Lists = dict[str, list[Found] | None]


def welcome(frame: Frame) -> None:
    """Where nobody is there yet: the five steps and the demo; always a link to the page."""
    if not frame.store.names():
        tour(frame)
        _demo(frame)
    frame.ui.link(TEXTS.to_start, "/start")


def tour(frame: Frame) -> None:
    """The five steps, until they are put away."""
    if frame.store.settings.toured:
        return
    with frame.ui.element("section").classes("w-full") as section:
        frame.heading(TEXTS.tour, 2)
        with frame.ui.element("ol").classes("grid grid-cols-1 sm:grid-cols-3 md:grid-cols-5 gap-4 py-4"):
            for picture, (title, words) in zip(_STEPS["pictures"], TEXTS.steps.items(), strict=True):
                with frame.ui.element("li"):
                    svg = _STEPS["svg"].format(picture.format(**_STEPS["parts"]))
                    frame.ui.html(svg, sanitize=False).classes("text-primary")
                    frame.ui.label(title).classes("text-lg")
                    frame.ui.label(words)

        def put_away() -> None:
            frame.store.choose(toured=True)
            section.delete()

        frame.button(TEXTS.put_away, put_away, props="outline")


def _demo(frame: Frame) -> None:
    async def add() -> None:
        folder = await frame.run.io_bound(add_demo, frame.store)
        frame.ui.navigate.to(frame.page_of(folder))

    frame.heading(TEXTS.demo_title, 2)
    frame.ui.label(TEXTS.demo_about)
    frame.button(TEXTS.demo, add)


def add_demo(store: Store) -> Path:
    """Add the demo as raw files, as a recording of today of a person of its own, and return its folder."""
    day = date.today().isoformat()
    if _PERSON in store.names() and day in store.names(_PERSON) and _TAKE in store.names(_PERSON, day):
        return store.path(_PERSON, day, _TAKE)
    recording = Recording.load(model_path("demo"))
    with TemporaryDirectory() as place:
        raw = Path(place) / "raw"
        write_raw_files(recording, raw)
        if _PERSON not in store.names():
            store.add_person(_PERSON, recording.skeleton.height)
        if day not in store.names(_PERSON):
            store.add_visit(_PERSON, day)
        folder = store.add_take(_PERSON, day, _TAKE)
        for path in filter(Path.is_file, raw.rglob("[!.]*")):
            make_private(Path(shutil.move(path, store.new_file(folder, path.name))))
    return folder


# --- the check ---------------------------------------------------------------------------------------------------


def of_this_machine(store: Store) -> list[Found]:
    """What can be seen without asking anybody: detectors, browser, disk, memory."""
    browser = pdf_browser()
    found = [_of_detector(wanted) for wanted in model_sets() if wanted == model_sets()[0] or not wanted.missing]
    found.append(Found(browser is not None, TEXTS.pdf, browser or TEXTS.nothing, TEXTS.pdf_todo))
    free = {(TEXTS.disk, TEXTS.disk_todo): shutil.disk_usage(store.root).free}
    if (memory := available_memory()) is not None:
        free[TEXTS.memory, TEXTS.memory_todo] = memory
    for (what, todo), size in free.items():
        found.append(Found(size / 1e9 >= _LEAST, what, TEXTS.gigabytes.format(size=size / 1e9), todo))
    return found


def pdf_browser() -> str | None:
    """Return a browser that can write a PDF without a window."""
    return next(filter(None, map(shutil.which, _BROWSERS)), None)


def _of_detector(wanted: ModelSet) -> Found:
    what = TEXTS.detector.format(title=wanted.title)
    if wanted.missing:
        return Found(False, what, TEXTS.not_installed, wanted.install)
    try:
        folder = cached_models(wanted)
    except RtofError as error:
        return Found(False, what, str(error))
    said = TEXTS.at_hand if folder else TEXTS.not_fetched
    return Found(folder is not None, what, said, TEXTS.fetch_todo, wanted.name)


def devices() -> list[Found]:
    """Cameras that can be opened, and streams that answer."""
    cameras = _looked(_CAMERAS, TEXTS.cameras, TEXTS.cameras_todo, "app")
    return [cameras, _looked(_STREAMS, TEXTS.streams, TEXTS.streams_todo, "live")]


def _looked(code: str, what: str, todo: str, extra: str) -> Found:
    """Look in a process of its own, since a library may hang or crash."""
    command = [sys.executable, "-P", "-c", f"{code}; import json; print(json.dumps(found))"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST, check=True)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        if "ModuleNotFoundError" in str(error.stderr):
            return Found(False, what, TEXTS.not_installed, install(extra))
        return Found(False, what, TEXTS.no_answer, todo)
    found = json.loads(done.stdout.splitlines()[-1])
    return Found(bool(found), what, ", ".join(found) or TEXTS.nothing, todo)


class StartPages(Frame):
    """The page of the first steps."""

    def serve(self) -> None:
        """See `Frame`."""
        self._fetching: dict[str, tuple[int, int]] = {}  # name of a set of models -> megabytes done, and in all
        self.ui.page("/start")(self.start)

    def start(self) -> None:
        """Language, the five steps, the demo, the check."""
        found: _Lists = {"here": None}  # None: it is being looked for

        async def look(name: str, action: Callable[[], list[Found]]) -> None:
            found[name] = None
            found[name] = await self.run.io_bound(action)

        def here() -> Awaitable[None]:
            return look("here", lambda: of_this_machine(self.store))

        def lines(name: str) -> None:
            def fill(_: Show) -> None:
                if found.get(name, ()) is None:
                    self.ui.label(TEXTS.checking).props("role=status")
                for one in found.get(name) or ():
                    self._line(one)

            self.shown(lambda: found.get(name), fill)

        def again() -> None:
            self.store.choose(toured=False)
            self.ui.navigate.reload()

        with self.frame(TEXTS.first_steps):
            names = {code: texts.language for code, texts in languages().items()}
            chosen = self.ui.radio(names, value=TEXTS.code, on_change=lambda event: self.speak(event.value))
            chosen.props(f'inline aria-label="{TEXTS.language_of}"')
            tour(self)
            if self.store.settings.toured:
                self.button(TEXTS.tour, again)
            _demo(self)
            self.heading(TEXTS.check, 2)
            lines("here")
            for wanted in model_sets():
                if not wanted.missing:
                    self._fetch(wanted, found, here)
            self.ui.label(TEXTS.devices_about)
            self.button(TEXTS.devices, lambda: look("devices", devices))
            lines("devices")
            self.ui.timer(0, here, once=True)

    def _line(self, one: Found) -> None:
        with self.row().classes("no-wrap"):
            self.ui.icon("check_circle" if one.good else "error_outline", size="sm").props("aria-hidden=true")
            word = TEXTS.good if one.good else TEXTS.missing
            with self.ui.column().classes("gap-0"):
                self.ui.label(f"{one.what}: {word}. {one.said}").classes("" if one.good else "doubt")
                if one.todo and not one.good:
                    self.ui.label(one.todo)

    def _fetch(self, wanted: ModelSet, found: _Lists, then: Callable[[], Awaitable[None]]) -> None:
        """Offer a set of models that is missing; what is fetched goes on without this window."""
        name, places = wanted.name, sorted({urlparse(file.url).netloc for file in wanted.files})

        def progress(_: str, done: int, total: int) -> None:
            self._fetching[name] = done, total

        async def fetch() -> None:
            progress("", 0, wanted.megabytes)
            try:
                await self.run.io_bound(fetch_models, wanted, progress)
            finally:
                del self._fetching[name]
            await then()

        def update() -> None:
            at = self._fetching.get(name)
            part.set_visibility(any(one.models == name and not one.good for one in found["here"] or ()))
            button.set_visibility(at is None)
            line.text = "" if at is None else TEXTS.fetching.format(done=at[0], total=at[1])

        with self.ui.column() as part:
            terms = {"title": wanted.title, "licence": wanted.licence, "size": wanted.megabytes}
            self.ui.label(TEXTS.terms.format(**terms, places=", ".join(places)))
            button = self.button(TEXTS.fetch.format(size=wanted.megabytes), fetch)
            line = self.ui.label().props("role=status")
        update()
        self.ui.timer(EVERY, update)
