"""First part of a recording's page: its files, what was found in them, and what only the user can say."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import Frame, Show
from rtof_kin.app.store import AT_WORK, FILES, State, Take
from rtof_kin.app.texts import TEXTS, worded
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.setup.init import FINDINGS, read_findings
from rtof_kin.setup.people import PICTURE, people_in_picture
from rtof_kin.setup.run import RECORDING, SECOND
from rtof_kin.setup.sources import SourceKind, Sources, recognise_source
from rtof_kin.vision.model_download import model_sets, models_folder
from rtof_kin.vision.person_detector import contained_models

MAP: Final = "sensors-on-body.csv"  #: Among the files: the map of sensors that is made by the drawing
PICTURES: Final = {PICTURE: f"{RECORDING}/{PICTURE}", f"second-{PICTURE}": f"{SECOND}/{PICTURE}"}
"""Pictures of the people, and where they are."""
_OF_CAMERA: Final = {kind.value for kind in (SourceKind.VIDEO, SourceKind.KEYPOINTS, SourceKind.CAMERA)}
_BESIDE: Final = {kind.value for kind in (SourceKind.SENSOR_MAP, SourceKind.CAMERA)}  # Nothing is found in them
_DRAWING: Final = load_toml(Path(__file__).with_suffix(".toml"))
_BODY: Final[dict[str, list[int]]] = {
    **_DRAWING["trunk"],
    **{f"Left{name}": line for name, line in _DRAWING["limbs"].items()},
    **{f"Right{name}": [200 - x0, y0, 200 - x1, y1, w] for name, (x0, y0, x1, y1, w) in _DRAWING["limbs"].items()},
}
"""Ends of a line for each segment, and its width."""
_CHOSEN: Final = "e => { const one = e.target.closest('[data-choice]'); if (one) emit(one.dataset.choice) }"

_HELD: Final = "e => { e.dataTransfer?.setData('text/plain', ''); emit() }"  # without data Firefox drags nothing


def body_drawing(places: Mapping[str, str]) -> str:
    """Return the body as SVG, with sensors by the numbers of their order. `places`: segments, '' where left out."""
    out, words = list[str](), TEXTS.segments
    for segment, (x0, y0, x1, y1, width) in _BODY.items():
        here = {str(number): name for number, (name, place) in enumerate(places.items(), 1) if place == segment}
        line = f'<line data-choice="{segment}" x1="{x0}" y1="{y0}" x2="{x1}" y2="{y1}" stroke-width="{width}"'
        title = escape(": ".join([words[segment], *here.values()]))
        out.append(f'{line} class="{"on" if here else ""}"><title>{title}</title></line>')
        out.append(f'<text x="{(x0 + x1) / 2}" y="{(y0 + y1) / 2 + 4}">{",".join(here)}</text>')
    return f'<svg viewBox="30 5 140 310" class="body" aria-hidden="true">{"".join(out)}</svg>'


def people_picture(address: str, boxes: list[tuple[float, ...]], chosen: int | None, title: str) -> str:
    """Return the picture of the people as HTML, with a box around each that can be clicked."""
    out = []
    for number, x0, y0, x1, y1 in boxes:
        style = f"left: {100 * x0 - 1}%; top: {100 * y0 - 8}%; width: {100 * (x1 - x0) + 2}%"
        style += f"; height: {100 * (y1 - y0) + 10}%"
        out.append(f'<div data-choice="{number}" class="{"on" if number == chosen else ""}" style="{style}"></div>')
    return f'<div class="people"><img src="{escape(address)}" alt="{escape(title)}">{"".join(out)}</div>'


def write_map(path: Path, places: Mapping[str, str]) -> None:
    """Write a map of sensors, which `run` takes; `InvalidInputError` where it says nothing, or one place twice."""
    given = {sensor: place for sensor, place in places.items() if place}
    if not given or len(set(given.values())) < len(given):
        raise InvalidInputError(TEXTS.same_place if given else TEXTS.no_places)
    if bad := [sensor for sensor in given if set(sensor) & set(',;\t#"\n')]:
        raise InvalidInputError(TEXTS.bad_sensor.format(name=bad[0]))
    write_text(path, "".join(f"{sensor}, {place}\n" for sensor, place in given.items()), overwrite=True)


class SourceParts:
    """The parts of the page of one recording that are about its files."""

    def __init__(self, page: Frame, folder: Path):
        """Lay them out."""
        self.page, self.ui, self.store, self.folder = page, page.ui, page.store, folder
        self._typed: tuple[float | None, ...] = (None, None)  # of a size; one side alone is not kept in the take
        page.heading(TEXTS.files, 2)
        done = self.store.take(folder).state in (State.DONE, State.ATTENTION)  # then the result is looked for
        with self.ui.expansion(TEXTS.all_files, value=not done).classes("w-full"):
            self._upload = self.ui.upload(label=TEXTS.drop, multiple=True, auto_upload=True, on_upload=self._dropped)
            self._upload.props("flat bordered").classes("w-full").on(
                "failed", lambda: page.say(RtofError(TEXTS.not_taken))
            )
            page.shown(self._look, self._files)
        self._same = page.shown(self._look, self._known, self._people, self._sensors)

    def _look(self) -> Any:
        made = [self.folder / file for file in (f"{RECORDING}/{FINDINGS}", *PICTURES.values())]
        changed = [path.stat().st_mtime_ns if path.is_file() else 0 for path in made]
        return self.store.take(self.folder), self.store.files(self.folder), changed

    def _keep(self, **values: Any) -> None:
        """Keep what the user says, maybe as an answer; the page shows it already."""
        answered = {"state": State.DRAFT} if self.store.take(self.folder).state is State.ASKING else {}
        self.store.change(self.folder, **answered, **values)
        self._same()

    def _forget(self, path: Path) -> None:
        """Forget what was found and chosen, as the files are others."""
        if _kind(path) not in _BESIDE:
            self.store.change(self.folder, person=None, second_person=None, places={})

    async def _dropped(self, event: Any) -> None:
        async def save() -> None:
            path = self.store.new_file(self.folder, event.file.name)
            part = self.folder / FILES / f".{path.name}"
            try:
                await event.file.save(part)
                await self.page.run.io_bound(self.store.take_in, self.folder, path.name, part)
            finally:
                part.unlink(missing_ok=True)
            self._forget(path)
            self._upload.run_method("removeUploadedFiles")

        await self.page.tried(save)

    def _files(self, show: Show) -> None:
        def remove(path: Path) -> None:
            self._forget(path)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            mark(path.name, second=False)

        def mark(name: str, second: bool) -> None:
            others = tuple(one for one in self.store.take(self.folder).second if one != name)
            self.store.change(self.folder, second=(*others, name) if second else others)
            show()

        take, kinds = self.store.take(self.folder), {path: _kind(path) for path in self.store.files(self.folder)}
        free = take.state not in AT_WORK
        several = take.second or sum(kind in _OF_CAMERA - _BESIDE for kind in kinds.values()) > 1
        self._upload.set_visibility(free)
        for path, kind in kinds.items():
            with self.page.row():
                self.ui.label(f"{path.name}: {_named(kind)}")
                if free:
                    self.page.icon("close", TEXTS.remove.format(name=path.name), lambda path=path: remove(path))
                if free and several and kind in _OF_CAMERA:
                    box = self.ui.checkbox(TEXTS.second.format(name=path.name), value=path.name in take.second)
                    box.on_value_change(lambda event, path=path: mark(path.name, event.value))

    def _known(self, _: Show) -> None:
        """What was recognised, what is missing, and what was found."""
        ui, take = self.ui, self.store.take(self.folder)
        if take.state in AT_WORK:
            return
        try:
            sources = self.store.sources(self.folder)
        except RtofError as error:
            ui.label(worded(str(error).replace(f"{self.folder / FILES}/", "")))
            return
        ui.label(TEXTS.ready.format(parts=", ".join(sorted({_named(_kind(path)) for path in sources.paths}))))
        missing = {
            TEXTS.without_image: not sources.seen,
            TEXTS.without_sensors: not sources.sensors,
            TEXTS.without_camera: sources.seen and sources.camera is None,
            TEXTS.no_models: sources.video is not None and sources.keypoints is None and _no_detector(),
        }
        for said in (said for said, is_missing in missing.items() if is_missing):
            ui.label(f"• {said}")
        if missing[TEXTS.no_models]:
            ui.link(TEXTS.to_start, "/start")
        with self.page.row():
            self._fields(sources, take)
        with suppress(RtofError):  # nothing was found yet
            found = read_findings(self.folder / RECORDING)
            with ui.expansion(TEXTS.findings, value=True).classes("w-full"):
                for kind, words in reversed(TEXTS.kinds.items()):
                    for sentence in getattr(found, kind):
                        ui.label(f"{words}: {worded(sentence)}").classes("doubt" if kind == "doubtful" else "")

    def _fields(self, sources: Sources, take: Take) -> None:
        """Fields for what the files do not say."""

        def sized() -> None:
            self._typed = width.value, height.value
            self._keep(size_px=(int(width.value), int(height.value)) if all(self._typed) else None)

        ui = self.ui
        if sources.sizeless:
            first, last = take.size_px or self._typed
            width = ui.number(TEXTS.width_px, value=first, min=1, on_change=sized).classes("w-60")
            height = ui.number(TEXTS.height_px, value=last, min=1, on_change=sized).classes("w-60")
            rate = ui.number(TEXTS.rate, value=take.rate_hz, min=1).classes("w-80")
            rate.on_value_change(lambda event: self._keep(rate_hz=event.value or None))
        if not sources.seen:
            pose = ui.select(TEXTS.poses, label=TEXTS.pose, value=take.pose).classes("w-80")
            pose.on_value_change(lambda event: self._keep(pose=event.value))
        if take.second:
            one_clock = ui.checkbox(TEXTS.synchronised, value=take.synchronised)
            one_clock.on_value_change(lambda event: self._keep(synchronised=event.value))

    def _people(self, _: Show) -> None:
        take, of = self.store.take(self.folder), (("person", TEXTS.who), ("second_person", TEXTS.who_second))
        for (file, place), (field, title) in zip(PICTURES.items(), of, strict=True):
            there = (self.folder / place).is_file() and (field == "person" or take.second)
            if there and take.state not in AT_WORK:
                with self._opened(title, take):
                    self._person(take, file, self.folder / place, field, title)

    def _opened(self, title: str, take: Take) -> Any:
        """A part that is open while the recording is looked at."""
        return self.ui.expansion(title, value=take.state in (State.ASKING, State.DRAFT)).classes("w-full")

    def _person(self, take: Take, file: str, picture: Path, field: str, title: str) -> None:
        def choose(event: Any) -> None:
            self._keep(**{field: event.value or None})
            drawn.content = people_picture(address, boxes, event.value, title)

        ui, boxes, chosen = self.ui, people_in_picture(picture), getattr(take, field)
        address = f"{self.page.prefix}{self.page.address(self.folder, file)}?{picture.stat().st_mtime_ns}"
        drawn = ui.html(people_picture(address, boxes, chosen, title), sanitize=False).classes("w-full")
        options = {int(number): TEXTS.person.format(number=int(number)) for number, *_ in sorted(boxes)}
        if len(options) < 2:
            return
        asked = take.state is State.ASKING and chosen is None
        options |= {} if asked else {0: TEXTS.nobody}
        ui.label(TEXTS.who_hint)
        radio = ui.radio(options, value=None if asked else chosen or 0, on_change=choose)
        radio.props(f'inline aria-label="{title}"')
        drawn.on("click", lambda event: radio.set_value(int(event.args)), js_handler=_CHOSEN)

    def _sensors(self, show: Show) -> None:
        take, own = self.store.take(self.folder), self.folder / FILES / MAP
        if take.state in AT_WORK or not take.places:
            return
        with self._opened(TEXTS.body, take):
            maps = [path for path in self.store.files(self.folder) if _kind(path) == SourceKind.SENSOR_MAP.value]
            if maps in ([], [own]):
                self._body(take, own, show)
            else:
                self.ui.label(TEXTS.body_map)

    def _body(self, take: Take, own: Path, show: Show) -> None:
        given = {name: place for name, (place, _) in take.places.items()}
        with suppress(RtofError):  # there is none, or it was damaged
            given = read_sensor_map(own)
        places, fields, held = {name: given.get(name, "") for name in take.places}, dict[str, Any](), list[str]()

        def put(event: Any) -> None:
            if held:
                fields[held[-1]].set_value(event.args)
                held.clear()

        def moved(name: str, segment: str) -> None:
            places[name] = segment
            drawn.content = body_drawing(places)

        def done(action: Callable[[], None]) -> None:
            action()
            self._keep()
            show()

        ui = self.ui
        ui.label(TEXTS.body_hint)
        with ui.row().classes("items-start no-wrap"):
            with ui.column().classes("items-center w-60"):
                ui.label(TEXTS.body_sides)
                drawn = ui.html(body_drawing(places), sanitize=False).classes("w-full")
                drawn.on("click", put, js_handler=_CHOSEN)
                drawn.on("drop.prevent", put, js_handler=_CHOSEN)
                drawn.on("dragover.prevent", js_handler="() => {}")
            with ui.column():
                for number, (name, (segment, sure)) in enumerate(take.places.items(), 1):
                    with self.page.row():
                        chip = ui.button(f"{number}: {name}", color=None).props("outline no-caps draggable=true")
                        for event in ("click", "dragstart"):
                            chip.on(event, lambda name=name: held.append(name), js_handler=_HELD)
                        options = {places[name]: places[name], "": TEXTS.no_place} | TEXTS.segments
                        fields[name] = ui.select(options, value=places[name], label=name).classes("w-48")
                        fields[name].on_value_change(lambda event, name=name: moved(name, event.value))
                        said = TEXTS.sure.format(percent=100 * sure) if sure < 1 else TEXTS.stated
                        ui.label(said if segment else TEXTS.unsure)
        with self.page.row():
            self.page.button(TEXTS.use_places, lambda: done(lambda: write_map(own, places)))
            if own.is_file():
                self.page.button(TEXTS.drop_places, lambda: done(lambda: own.unlink(missing_ok=True)))


def _kind(path: Path) -> str:
    """Return the kind of a file as `SourceKind` has it, or what is wrong with it."""
    try:
        return recognise_source(path).value
    except RtofError as error:
        return worded(str(error))


def _named(kind: str) -> str:
    """Return a kind in the language of the page."""
    return TEXTS.sources.get(kind, kind)


def _no_detector() -> bool:
    """Return whether no models that find people are here; their files are not compared."""
    return contained_models() is None and not any(models_folder(one).is_dir() for one in model_sets())
