"""People, visits and recordings in plain folders of one workspace; the folders themselves are the index.

::

    WORKSPACE/                      of this user alone
        P07/                        a person; `rtof-kin compare P07` reads it
            subject.toml            see `rtof_kin.recording.subject`
            2026-01-31/             a visit
                walk/               a recording: what `rtof-kin run files/* -o walk` writes
                    files/          as they were dropped; a detector's files of single frames in a folder of their own
                    take.json       state, and what the files do not say; written anew where it is missing
                    notes.txt       also of a visit
            comparisons/, plans/    what was compared, and planned, with its page
        .trash/ID/                  what was deleted, and the place where it was
        .settings.json              `Settings`
"""

from __future__ import annotations

import re
import secrets
import shutil
import threading
import time
import zipfile
from datetime import date
from enum import Enum
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ValidationError

from rtof_kin.app.texts import TEXTS
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, RtofError
from rtof_kin.core.files.arrays import check_ratio
from rtof_kin.core.files.folder import temporary_folder
from rtof_kin.core.files.manifest import make_folders, make_private
from rtof_kin.core.files.text import read_text, write_text
from rtof_kin.recording.subject import Estimate, Subject, read_subject, write_subject
from rtof_kin.reporting.audit_results import Grade, headline
from rtof_kin.reporting.page import PAGE
from rtof_kin.reporting.summary_file import SUMMARY, read_summary
from rtof_kin.setup.init import read_findings
from rtof_kin.setup.run import MOTION, RECORDING
from rtof_kin.setup.settings import SecondCamera, SetupSettings
from rtof_kin.setup.sources import SourceKind, Sources, recognise_source

FILES: Final = "files"
NOTES: Final = "notes.txt"
MADE: Final = ("comparisons", "plans")  #: Folders of a person that are no visits
SUBJECT: Final = "subject.toml"
_TAKE, _TRASH, _ITEM, _ORIGIN, _SETTINGS = "take.json", ".trash", "item", "origin.txt", ".settings.json"
_NAME: Final = re.compile(r"\w[\w-]{0,63}")
_RESERVED: Final = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_NO_FILE: Final = re.compile(r"[\\/:*?\"<>|]|^[.\s-]|[.\s]$")
_LONGEST: Final = 200  # [bytes] of the name of a file
_FRAME: Final = re.compile(r"(.*?)([_-]?\d{4,}_keypoints|\.\d{4,6}|_\d{6}|_?\d{12})\.json")  # Of one frame, as OpenPose
_CHANGING: Final = threading.Lock()  # The pages' thread and that of the queue
_MOST_FILES, _MOST_BYTES = 100_000, 16e9  # Of a .zip file, unpacked


class State(Enum):
    """State of a recording."""

    DRAFT = "draft"
    WAITING = "waiting"
    RUNNING = "running"
    ASKING = "has a question"
    DONE = "done"
    ATTENTION = "needs attention"
    FAILED = "failed"


AT_WORK: Final = (State.WAITING, State.RUNNING)


class Take(BaseModel, frozen=True):
    """What is known of a recording beside its files."""

    state: State = State.DRAFT
    asked: float = 0.0  #: [s] since 1970, when the reconstruction was asked for
    said: str = ""  #: Why it failed
    size_px: tuple[int, int] | None = None  #: Of the image, for keypoints without a video
    person: int | None = None  #: Number in the picture of the people; None: the only prominent one
    rate_hz: float | None = None  #: Of keypoints without times
    pose: Literal["N", "T", "seated"] = "N"  #: Of sensors without an image, see `SetupSettings`
    second: tuple[str, ...] = ()  #: Files of the second camera, by name
    second_person: int | None = None  #: As `person`, in the picture of the second camera
    synchronised: bool = False  #: Whether both cameras have one clock
    look: bool = False  #: Whether only the recording was asked for, to be looked at first
    learn: bool = False  #: Whether the person's file is updated
    learned: tuple[str, ...] = ()  #: What was changed there
    places: dict[str, tuple[str, float]] = {}  #: Likeliest segment of each sensor, and its probability
    seconds: dict[str, float] = {}  #: How long each stage took, s, in their order


class Settings(BaseModel, frozen=True):
    """What was chosen for a workspace."""

    language: str = ""  #: Of `texts.languages`; that of the machine where it is none of them
    toured: bool = False  #: The tour was put away


class Store:
    """The workspace. Names that could lead elsewhere are refused by `InvalidInputError`."""

    def __init__(self, root: str | Path):
        """Open a folder, which is made, or kept, for this user alone; `RtofError` where it cannot be."""
        self.root = Path(root).expanduser().resolve()
        try:
            make_folders(self.root)
            make_private(self.root)
            make_folders(self.root / _TRASH)
        except OSError as error:
            raise RtofError(f"{self.root}: cannot be a workspace ({error}); name another folder") from error

    @property
    def settings(self) -> Settings:
        """What was chosen; as at first where it is missing or damaged."""
        try:
            return Settings.model_validate_json(read_text(self.root / _SETTINGS, "JSON"))
        except (FileFormatError, ValidationError):
            return Settings()

    def choose(self, **values: Any) -> None:
        """Change what was chosen."""
        chosen = self.settings.model_copy(update=values)
        write_text(self.root / _SETTINGS, chosen.model_dump_json(indent=1) + "\n", overwrite=True)

    def path(self, *names: str) -> Path:
        """Return the folder of a person, of a visit or of a recording, which is there."""
        path = self.place(*names)
        if not path.is_dir():
            raise InvalidInputError(TEXTS.not_there.format(kind=TEXTS.levels[len(names) - 1], name=names[-1]))
        return path

    def names(self, *above: str) -> list[str]:
        """Return the people, the visits of a person (the latest first), or the recordings of a visit."""
        folder = self.path(*above) if above else self.root
        found = [one.name for one in folder.iterdir() if one.is_dir() and not one.is_symlink() and is_name(one.name)]
        return sorted(found, key=str.casefold, reverse=len(above) == 1)

    def takes(self, *people: str) -> list[Path]:
        """Return the folders of all recordings, of some people."""
        visits = [(person, visit) for person in people or self.names() for visit in self.names(person)]
        return [self.path(*visit, name) for visit in visits for name in self.names(*visit)]

    def add_person(self, person: str, height: float | None) -> None:
        """Make a person. `height`: standing, m; every length follows it."""
        path, known = self.place(person), {"subject": person, "height_m": {"value": _height(height)}}
        self._make(path)
        try:
            write_subject(path / SUBJECT, Subject.of(known, path / SUBJECT))
        except RtofError:
            path.rmdir()
            raise

    def subject(self, person: str) -> Subject:
        """Read what is known of a person."""
        return read_subject(self.path(person) / SUBJECT)

    def set_height(self, person: str, height: float | None) -> None:
        """Correct the standing height of a person, m."""
        subject = self.subject(person)
        known = subject.known | {"height_m": Estimate[Any](value=_height(height))}
        write_subject(subject.path, subject.with_known(known, subject.history), overwrite=True)

    def add_visit(self, person: str, day: str) -> None:
        """Make a visit. `day`: as 2026-01-31."""
        try:
            name = date.fromisoformat(day).isoformat()
        except ValueError as error:
            raise InvalidInputError(TEXTS.no_day.format(day=day)) from error
        self.path(person)
        self._make(self.place(person, name))

    def add_take(self, person: str, visit: str, name: str) -> Path:
        """Make a recording without files and return its folder."""
        self.path(person, visit)
        path = self.place(person, visit, name)
        self._make(path)
        make_folders(path / FILES)
        return path

    # --- a recording ---------------------------------------------------------------------------------------

    @staticmethod
    def take(folder: Path) -> Take:
        """Read the state of a recording; where it is missing or damaged, the files tell it."""
        try:
            return Take.model_validate_json(read_text(folder / _TAKE, "JSON"))
        except (FileFormatError, ValidationError):
            return Take(state=verdict(folder) if (folder / PAGE).is_file() else State.DRAFT)

    @staticmethod
    def change(folder: Path, **values: Any) -> Take:
        """Change the state of a recording and return it."""
        with _CHANGING:
            take = Store.take(folder).model_copy(update=values)
            write_text(folder / _TAKE, take.model_dump_json(indent=1) + "\n", overwrite=True)
        return take

    @staticmethod
    def files(folder: Path) -> list[Path]:
        """Return the files, and folders of single frames, of a recording."""
        found = (folder / FILES).iterdir() if (folder / FILES).is_dir() else ()
        return sorted(path for path in found if path.exists() and not path.is_symlink() and path.name[0] != ".")

    @staticmethod
    def setup(folder: Path) -> tuple[list[Path], SetupSettings, SecondCamera]:
        """Return what `run` is given: files of the first camera and of sensors, settings, and the second camera."""
        take, files = Store.take(folder), Store.files(folder)
        second = tuple(path for path in files if path.name in take.second)
        own = SetupSettings(pose=take.pose, person=take.person, rate_hz=take.rate_hz, size_px=take.size_px)
        other = SecondCamera(second, take.second_person, synchronised=take.synchronised)
        return [path for path in files if path not in second], own, other

    @staticmethod
    def video(folder: Path) -> Path | None:
        """Return the video of a recording, of the first camera; None where there is none."""
        found = (path for path in Store.setup(folder)[0] if recognise_source(path) is SourceKind.VIDEO)
        return next(found, None)

    def sources(self, folder: Path) -> Sources:
        """Recognise the files; errors of `Sources.of`, and `InvalidInputError` where there is nothing to see."""
        first, _, second = self.setup(folder)
        found = Sources.of(first)
        if second.second and not Sources.of(second.second).seen:
            raise InvalidInputError(TEXTS.nothing_second)
        if not (found.seen or found.sensors):
            raise InvalidInputError(TEXTS.nothing_recorded)
        return found

    def new_file(self, folder: Path, name: str) -> Path:
        """Return where a file that is dropped goes; refuses hostile names and one that is there."""
        if not is_file_name(name):
            raise InvalidInputError(TEXTS.bad_file_name.format(name=repr(name[:60])))
        make_folders(folder / FILES)
        frame = _FRAME.fullmatch(name)
        inner = folder / FILES / f"{frame[1]}_keypoints" if frame else folder / FILES
        path = inner / name
        if inner.is_symlink() or inner.is_file() or path.exists():
            raise OutputExistsError(TEXTS.file_exists.format(name=name))
        return path

    def take_in(self, folder: Path, name: str, part: Path) -> None:
        """Put a file that is complete in its place, or all files of a .zip file.

        Their folders are left out, so that none leads elsewhere; their names are as `new_file` takes them.
        `FileFormatError`: the archive is damaged, encrypted, or too large; nothing is taken then.
        """
        if not name.lower().endswith(".zip"):
            self._put(part, self.new_file(folder, name))
            return
        with temporary_folder(folder / FILES) as fresh:
            try:
                with zipfile.ZipFile(part) as archive:
                    found = [one for one in archive.infolist() if not re.search(r"(^|/)(\.[^/]*|)$", one.filename)]
                    full = sum(one.file_size for one in found)
                    if full > _MOST_BYTES or len(found) > _MOST_FILES:
                        raise FileFormatError(name, TEXTS.zip_large)
                    check_ratio(Path(name), full, sum(one.compress_size for one in found))
                    names = [one.filename.rpartition("/")[2] for one in found]
                    if len(set(map(str.casefold, names))) < len(names):
                        raise FileFormatError(name, TEXTS.zip_twice)
                    for member, own in zip(found, names, strict=True):
                        self.new_file(folder, own)
                        with archive.open(member) as source, (fresh / own).open("wb") as whole:
                            shutil.copyfileobj(source, whole)
            except (RtofError, OSError):
                raise
            except Exception as error:  # zipfile and its decompressors raise many
                raise FileFormatError(name, TEXTS.zip_damaged.format(error=error)) from error
            for own in names:
                self._put(fresh / own, self.new_file(folder, own))

    @staticmethod
    def _put(part: Path, path: Path) -> None:
        make_folders(path.parent)
        make_private(part)
        part.rename(path)

    # --- the trash -----------------------------------------------------------------------------------------

    def delete(self, *names: str) -> str:
        """Move a person, a visit or a recording to the trash and return the key there."""
        path = self.path(*names)
        key = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(4)}"
        slot = self.root / _TRASH / key
        make_folders(slot)
        write_text(slot / _ORIGIN, "/".join(names))
        path.rename(slot / _ITEM)
        return key

    def trash(self) -> dict[str, tuple[str, ...]]:
        """Return what is in the trash, the latest first: its key, and the names that lead to it."""
        slots = sorted((self.root / _TRASH).iterdir(), reverse=True)
        return {
            slot.name: tuple((slot / _ORIGIN).read_text(encoding="utf-8").split("/"))
            for slot in slots
            if (slot / _ORIGIN).is_file() and (slot / _ITEM).is_dir()
        }

    def restore(self, key: str) -> None:
        """Take something back; refused while its place is taken, or what it belongs to is not there."""
        names = self.trash().get(key)
        if names is None:
            raise InvalidInputError(TEXTS.not_in_trash)
        if names[:-1]:
            self.path(*names[:-1])
        place = self.place(*names)
        if place.exists():
            raise OutputExistsError(TEXTS.exists.format(name=names[-1]))
        (self.root / _TRASH / key / _ITEM).rename(place)
        shutil.rmtree(self.root / _TRASH / key)

    def place(self, *names: str) -> Path:
        """Return where something is, or would be; no name leads out of the workspace."""
        path = self.root
        for name in names:
            if not is_name(name):
                raise InvalidInputError(TEXTS.bad_name.format(name=repr(name[:60])))
            path /= name
            if path.is_symlink():
                raise InvalidInputError(TEXTS.is_link.format(name=name))
        if not 1 <= len(names) <= len(TEXTS.levels):
            raise InvalidInputError(TEXTS.bad_name.format(name=repr("/".join(names)[:60])))
        return path

    def _make(self, path: Path) -> None:
        try:
            path.mkdir(mode=0o700)
        except FileExistsError as error:
            raise OutputExistsError(TEXTS.exists.format(name=path.name)) from error
        except OSError as error:
            raise RtofError(TEXTS.not_written.format(error=error)) from error


def verdict(folder: Path) -> State:
    """Return whether the result of a recording needs attention: something warns, or is in doubt."""
    try:
        grade = headline(read_summary(folder / MOTION / SUMMARY).results or ()).grade
        doubtful = grade in (Grade.WARN, Grade.FAIL) or read_findings(folder / RECORDING).doubtful
    except RtofError:
        doubtful = True
    return State.ATTENTION if doubtful else State.DONE


def _height(height: float | None) -> float:
    if height is None or not 0.4 < height < 2.6:
        raise InvalidInputError(TEXTS.no_height)
    return round(height, 3)


def is_name(name: str) -> bool:
    """Return whether a person, a visit or a recording may have a name."""
    free = _RESERVED.fullmatch(name) is None and name.casefold() not in MADE
    return free and _NAME.fullmatch(name) is not None


def is_file_name(name: str) -> bool:
    """Return whether a file may have a name, on every system."""
    long = len(name.encode(errors="replace")) > _LONGEST
    return name.isprintable() and not (long or not name or _NO_FILE.search(name) or _RESERVED.fullmatch(name))
