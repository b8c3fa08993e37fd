"""Pages of the application: people, a person's visits, the trash; and a person as a ZIP archive of the plain folder."""

from __future__ import annotations

import shutil
import stat
import tempfile
import zipfile
import zlib
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any, Final

from rtof_kin.app.frame import Frame, Show
from rtof_kin.app.start import welcome
from rtof_kin.app.store import AT_WORK, MADE, State, Store, is_file_name, is_name
from rtof_kin.app.texts import TEXTS
from rtof_kin.app.work import REVIEW
from rtof_kin.core.checks import some
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.files.folder import temporary_folder
from rtof_kin.core.files.manifest import MANIFEST, make_private
from rtof_kin.setup.sources import VIDEO_SUFFIXES

_COMMENT: Final = b"rtof-kin person 1"  #: Says that an archive is that of a person
_MOST_FILES, _RATIO = 100_000, 100  # the latter of the size of all files and that of the archive
_SMALL: Final = 2**28  #: [bytes] that an archive may have whatever its own size, and that stay free on the disk


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
                    counts = Counter(self.store.take(path).state for path in self.store.takes(person))
                    for state in filter(counts.get, State):
                        self.badge(state, counts[state])
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

    def _add_recording(self, person: str, visit: str) -> None:
        def add() -> None:
            self.store.add_take(person, visit, name.value.strip())
            self.ui.navigate.to(f"/people/{person}/{visit}/{name.value.strip()}")

        with self.row():
            name = self.ui.input(TEXTS.recording).classes("w-64")
            self.button(TEXTS.add_recording, add, name)
            self.button(TEXTS.record, lambda: self.ui.navigate.to(f"/record/{person}/{visit}"))


# --- archives ------------------------------------------------------------------------------------


def write_archive(store: Store, person: str, videos: bool, path: Path) -> list[str]:
    """Write the archive of a person, and return what is left out: links, hidden files, videos unless wanted."""
    root, left_out = store.path(person), list[str]()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
        archive.comment = _COMMENT
        for place in (root, *sorted(root.rglob("*"))):
            name, video = place.relative_to(root.parent).as_posix(), place.suffix.lower() in VIDEO_SUFFIXES
            if place.is_symlink() or not _is_taken(name, place.is_dir()) or (video and not videos):
                left_out.append(name)
            else:
                archive.write(place, name)
    return left_out


def read_archive(store: Store, path: Path) -> str:
    """Make a person of an archive, completely or not at all, and return the person; `OutputExistsError` where there is
    such a person, `InvalidInputError` where it is no such archive, or could write elsewhere or fill the disk.
    """
    try:
        with zipfile.ZipFile(path) as archive, temporary_folder(store.root) as new:
            person = _person(archive, path.stat().st_size, shutil.disk_usage(new).free)
            if (place := store.place(person)).exists():
                raise OutputExistsError(TEXTS.exists.format(name=person))
            archive.extractall(new)
            for one in new.rglob("*"):
                make_private(one)
            (new / person).rename(place)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, UnicodeDecodeError) as error:
        raise InvalidInputError(TEXTS.no_archive) from error
    for take in store.takes(person):
        if store.take(take).state in AT_WORK:  # where it comes from
            store.change(take, state=State.DRAFT)
    return person


def _person(archive: zipfile.ZipFile, size: int, free: int) -> str:
    """Return whose archive it is; `InvalidInputError` where it could do harm, or is no such archive."""
    infos, seen = archive.infolist(), set[str]()
    people = {info.filename.split("/")[0] for info in infos}
    if archive.comment != _COMMENT or len(people) != 1:
        raise InvalidInputError(TEXTS.no_archive)
    total = sum(info.file_size for info in infos)
    if len(infos) > _MOST_FILES or total > min(_RATIO * size + _SMALL, free - _SMALL):
        raise InvalidInputError(TEXTS.large_archive.format(size=total / 1e9))
    for info in infos:
        name, kind = info.filename.removesuffix("/"), stat.S_IFMT(info.external_attr >> 16)
        plain = kind in (0, stat.S_IFDIR if info.is_dir() else stat.S_IFREG) and not info.flag_bits & 1
        plain &= info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        if not plain or not _is_taken(name, info.is_dir()) or name.casefold() in seen:
            raise InvalidInputError(TEXTS.bad_member.format(name=repr(name[:60])))
        seen.add(name.casefold())
    return people.pop()


def _is_taken(name: str, folder: bool) -> bool:
    """Return whether the store has files or folders of a name, from the person on."""
    person, *parts = name.split("/")
    named = () if parts[:1] and parts[0] in MADE else parts[:2] if folder or len(parts) > 2 else parts[:-1]
    own = REVIEW.casefold() in map(str.casefold, parts)  # reaches the application, and is made again
    files = all(part == MANIFEST or is_file_name(part) for part in parts)
    return all(map(is_name, (person, *named))) and files and not own
