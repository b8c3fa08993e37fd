"""Detectors' models that may be downloaded with consent (``models/detector_models.toml``), and their cache.

Every file has a checksum that ships with this package; it is compared after the download and before each use.
The cache is the folder ``models`` in the user's cache folder (``RTOF_KIN_CACHE`` names another one).
"""

from __future__ import annotations

import hashlib
import importlib.util
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from filelock import FileLock

from rtof_kin.core.errors import FileFormatError, RtofError, UnknownNameError
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import cache_folder, model_path

Progress = Callable[[str, int, int], None]
_PIECE = 2**18  # bytes
_WAIT = 30.0  # [s] for the server
_AGAIN = "try again"


@dataclass(frozen=True)
class ModelFile:
    """A file of a model."""

    name: str  #: In the cache
    url: str  #: Of the file, or of a ZIP archive that contains it
    sha256: str  #: Checksum of what is downloaded
    megabytes: int  #: Size of the download, 1e6 bytes
    member: str | None = None  #: Name of the file in the archive; None where it is none
    member_sha256: str | None = None  #: Checksum of that file

    @property
    def checksum(self) -> str:
        """SHA-256 of the file in the cache."""
        return self.member_sha256 or self.sha256


@dataclass(frozen=True)
class ModelSet:
    """Models that make a detector together."""

    name: str  #: For ``--fetch-models``
    title: str  #: In words
    licence: str  #: Licence, whose work it is, and what else has to be known
    needs: tuple[str, ...]  #: Modules that run them
    install: str  #: Command that installs these
    files: tuple[ModelFile, ...]

    @property
    def missing(self) -> list[str]:
        """Those of the modules that are not installed."""
        return [module for module in self.needs if importlib.util.find_spec(module) is None]

    @property
    def megabytes(self) -> int:
        """Size of all downloads, 1e6 bytes."""
        return sum(file.megabytes for file in self.files)


@cache
def model_sets() -> tuple[ModelSet, ...]:
    """Return all shipped sets of models, the preferred first."""

    def described(file: list[dict[str, Any]], needs: list[str], **about: str) -> ModelSet:
        return ModelSet(files=tuple(ModelFile(**one) for one in file), needs=tuple(needs), **about)

    return tuple(described(**entry) for entry in load_toml(model_path("detector_models.toml"))["set"])


def model_set(name: str) -> ModelSet:
    """Return a set of models; a name of none raises `UnknownNameError`."""
    known = {each.name: each for each in model_sets()}
    if name not in known:
        raise UnknownNameError("set of models", [name], list(known))
    return known[name]


def models_folder(wanted: ModelSet) -> Path:
    """Return the folder of a set in the cache, which need not exist."""
    return cache_folder() / "models" / wanted.name


def cached_models(wanted: ModelSet) -> Path | None:
    """Return the folder of a set if all its files are in the cache, after comparing their checksums; `FileFormatError`
    where one is not the published one.
    """
    folder = models_folder(wanted)
    if not all((folder / file.name).is_file() for file in wanted.files):
        return None
    for file in wanted.files:
        _check(folder / file.name, folder / file.name, file.checksum, "delete it and fetch the models again")
    return folder


def fetch_models(wanted: ModelSet, progress: Progress | None = None) -> Path:
    """Download the files of a set that are not in the cache yet to the folder that is returned. Calling it is consent.
    Progress is ("fetch", megabytes done, megabytes in all). `RtofError`: what runs them is not installed, no
    connection, an interrupted download, another file than the published one, a full disk.
    """
    if wanted.missing:
        raise RtofError(f"{', '.join(wanted.missing)}: not installed, {wanted.title} needs it: {wanted.install}")
    folder = models_folder(wanted)
    done = 0
    try:
        cache_folder().mkdir(mode=0o700, parents=True, exist_ok=True)  # as for compiled functions
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock"):
            for file in wanted.files:
                if not (folder / file.name).is_file():
                    before = done

                    def report(size: int, before: int = before) -> None:
                        if progress is not None:
                            progress("fetch", before + round(size / 1e6), wanted.megabytes)

                    _fetch(file, folder, report)
                done += file.megabytes
    except RtofError:
        raise
    except OSError as error:  # also of the connection
        raise RtofError(f"{wanted.title}: not downloaded ({error}); {_AGAIN}") from error
    found = cached_models(wanted)
    if found is None:
        raise RtofError(f"{folder}: files disappeared while they were downloaded; {_AGAIN}")
    return found


def _fetch(file: ModelFile, folder: Path, report: Callable[[int], None]) -> None:
    """Download a file, and move it into its folder when it is right."""
    import pooch  # type: ignore[import-untyped]  # slow to import

    pooch.get_logger().setLevel("ERROR")
    with TemporaryDirectory(dir=folder, prefix=".download-") as fresh:
        downloader = pooch.HTTPDownloader(progressbar=_Progress(report), timeout=_WAIT, chunk_size=_PIECE)
        found = Path(pooch.retrieve(file.url, None, "whole", fresh, downloader=downloader))
        _check(found, file.url, file.sha256, "nothing was kept; try again later, or give models of your own")
        if file.member is not None:
            archive, found = found, Path(fresh, "member")
            with zipfile.ZipFile(archive) as members:
                (member,) = (name for name in members.namelist() if Path(name).name == file.member)
                with members.open(member) as source, found.open("wb") as whole:
                    shutil.copyfileobj(source, whole)
            _check(found, file.url, file.checksum, "nothing was kept")
        found.replace(folder / file.name)


class _Progress:
    """Progress bar for `pooch` that reports bytes."""

    def __init__(self, report: Callable[[int], None]) -> None:
        self._report = report
        self.total = self._size = 0

    def update(self, size: int) -> None:
        self._size = min(self._size + size, self.total or self._size + size)
        self._report(self._size)

    def reset(self) -> None:
        self._size = 0

    def close(self) -> None:
        pass


def _check(path: Path, name: str | Path, expected: str, remedy: str) -> None:
    """Compare the checksum of a file."""
    with path.open("rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    if found != expected:
        difference = f"its SHA-256 {found[:12]}... is not the published {expected[:12]}..."
        raise FileFormatError(name, f"{difference}; {remedy}")
