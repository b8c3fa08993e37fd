"""A person as a ZIP archive of the plain folder; its comment says what it is."""

from __future__ import annotations

import shutil
import stat
import zipfile
import zlib
from pathlib import Path
from typing import Final

from rtof_kin.app.store import AT_WORK, MADE, State, Store, is_file_name, is_name
from rtof_kin.app.texts import TEXTS
from rtof_kin.app.work import REVIEW
from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.core.files.folder import temporary_folder
from rtof_kin.core.files.manifest import MANIFEST, make_private
from rtof_kin.setup.sources import VIDEO_SUFFIXES

_COMMENT: Final = b"rtof-kin person 1"
_MOST_FILES, _RATIO = 100_000, 100  # the latter of the size of all files and that of the archive
_SMALL: Final = 2**28  #: [bytes] that an archive may have whatever its own size, and that stay free on the disk


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
