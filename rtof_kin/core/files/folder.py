"""Atomic output: files and folders appear complete or not at all and never replace files of the user.

They are of this user alone (0600, 0700), as they are data of patients; a file that is replaced keeps its permissions.
"""

from __future__ import annotations

import errno
import logging
import os
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from rtof_kin.core.errors import OutputExistsError, RtofError, WritingError, too_long
from rtof_kin.core.files.manifest import Contents, make_folders, make_private, read_contents, sync, write_manifest
from rtof_kin.core.files.temporary import clear, temporary_folder

_NAMED = 3
"""Number of foreign files that an error message lists."""
_NO_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP}
_NO_LINKS = {errno.ENOSYS, errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP}
"""Errors of file systems that cannot exchange folders or create hard links."""
_HERE, _EXCHANGE = -100, 2
"""Linux's AT_FDCWD and RENAME_EXCHANGE."""
_log = logging.getLogger(__name__)


def path_inside(folder: Path, name: str) -> Path | None:
    """Return the path of a name inside a folder; None if it leads out of it ('..', absolute names, links)."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or ":" in name or "\0" in name or not parts.parts:
        return None
    path = folder.joinpath(*parts.parts)
    try:
        return path if path.resolve().is_relative_to(folder.resolve()) else None
    except (OSError, RuntimeError):  # a link to itself
        return None


# --- folders -------------------------------------------------------------------------------------


@contextmanager
def new_folder(
    path: str | Path, marker: str, overwrite: bool = False, inputs: Mapping[str, str] | None = None
) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to `path` when the block ends without an error.

    Args:
        marker: name of a file that every folder of this kind contains.
        overwrite: replace an earlier folder of this kind, see `check_replaceable`.
        inputs: fingerprints of what it is made from, for `core.files.manifest.made_from`.

    Raises:
        OutputExistsError: `path` exists, or appears meanwhile, and may not be replaced.
        WritingError: it cannot be written.
    """
    path = Path(os.path.abspath(path))
    check_replaceable(path, marker, overwrite)
    try:
        make_folders(path.parent)
        with temporary_folder(path.parent) as temporary:
            yield temporary
            write_manifest(temporary, marker, inputs)
            _put_folder(temporary, path, marker, overwrite)
            sync(path.parent)
    except WritingError as error:  # of a file in the temporary folder: name the final one
        problem = error.__cause__ or error
        raise WritingError(f"{path}: cannot be written ({problem}); choose another folder") from error
    except RtofError:  # OutputExistsError is an OSError
        raise
    except OSError as error:
        raise WritingError(f"{path}: cannot be written ({error}); choose another folder") from error


def check_replaceable(path: str | Path, marker: str, overwrite: bool = False) -> None:
    """Check that an output folder may be written. Long computations check before they start.

    An empty folder may be filled. With `overwrite` a folder of the same kind may be replaced if it contains
    only unchanged files of this package (see `core.files.manifest`).

    Args:
        path, marker, overwrite: see `new_folder`.

    Raises:
        OutputExistsError: it may not be replaced. WritingError: its parent cannot be written.
    """
    path = Path(path)
    _check_length(path)
    if path.is_symlink() or os.path.ismount(path):
        raise OutputExistsError(f"{path}: is a link or a mounted disk; name a folder of its own")
    _check_place(path, "choose another folder")
    if not path.exists():
        return
    if not path.is_dir():
        raise OutputExistsError(f"{path}: is a file; name a folder")
    try:
        found = _contents(path)
    except OSError as error:
        raise RtofError(f"{path}: cannot be read ({error}); choose another folder") from error
    if not (found.own or found.foreign):
        return
    if found.foreign:
        more = len(found.foreign) - _NAMED
        names = ", ".join(found.foreign[:_NAMED]) + (f" and {more} more" if more > 0 else "")
        raise OutputExistsError(
            f"{path}: contains files that this package did not write and that are never replaced: "
            f"{names}; move it elsewhere or name another folder"
        )
    if Path(found.kind).stem != Path(marker).stem:  # an earlier version wrote motion.npz for motion.h5
        raise OutputExistsError(
            f"{path}: was written by another command ({found.kind}) and is not replaced by this one; "
            "name another folder"
        )
    if not overwrite:
        raise OutputExistsError.of(path)


def _check_length(path: Path) -> None:
    try:
        path.lstat()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise WritingError(too_long(path)) from error


def _check_place(path: Path, remedy: str) -> None:
    place = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise WritingError(f"{path}: cannot be written ({place} is no folder to write to); {remedy}")


def _put_folder(new: Path, path: Path, marker: str, overwrite: bool) -> None:
    """Rename a folder, or exchange it with an earlier one and remove that."""
    while True:
        try:
            os.rename(new, path)  # replaces only an empty folder
            return
        except OSError:
            if not (new.exists() and os.path.lexists(path)):
                raise
        check_replaceable(path, marker, overwrite)
        with suppress(FileNotFoundError):  # another run is replacing it
            if not any(path.iterdir()):
                path.rmdir()  # Windows does not rename over a folder
                continue
            _exchange(new, path)
            _remove_replaced(new, path)
            return


def _contents(path: Path) -> Contents:
    """Return the contents of one folder, even while other runs replace it."""
    while True:
        before = _identity(path)
        if before is None:
            return Contents("", (), ())
        with suppress(FileNotFoundError):
            found = read_contents(path)
            if _identity(path) == before:
                return found


def _identity(path: Path) -> tuple[int, int] | None:
    with suppress(FileNotFoundError):
        found = path.lstat()
        return found.st_dev, found.st_ino
    return None


def _exchange(new: Path, path: Path) -> None:
    """Exchange two folders, atomically on Linux; elsewhere the old one is renamed to ``*.replaced-*`` for a moment."""
    try:
        _exchange_at_once(new, path)
    except OSError as error:
        if error.errno not in _NO_EXCHANGE:
            raise
        aside = _beside(path, "replaced")
        try:
            os.rename(path, aside)
            os.rename(new, path)
        except BaseException:
            with suppress(OSError):  # if `path` exists again, the old folder keeps its other name
                os.rename(aside, path)
            raise
        os.rename(aside, new)


def _exchange_at_once(first: Path, second: Path) -> None:
    import ctypes  # slow to import, rarely needed

    if sys.platform != "linux":
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    paths = os.fsencode(first), os.fsencode(second)
    if library.renameat2(_HERE, paths[0], _HERE, paths[1], ctypes.c_uint(_EXCHANGE)):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(second))


def _remove_replaced(old: Path, path: Path) -> None:
    """Remove an earlier output but keep files that were added at the last moment."""
    clear(old)
    with suppress(FileNotFoundError):  # removed completely, maybe by another run
        if read_contents(old).foreign:
            kept = _beside(path, "kept")
            os.rename(old, kept)
            _log.warning("%s: was replaced while files were added to it; they are in %s", path, kept)


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.name}.{what}-{secrets.token_hex(4)}")


# --- files ---------------------------------------------------------------------------------------


@contextmanager
def new_file(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary file that is renamed to `path` when the block ends without an error.

    Args:
        path: final file; a link is followed. overwrite: replace an existing file.

    Raises:
        OutputExistsError: `path` exists, or appears meanwhile, and may not be replaced.
        WritingError: it cannot be written.
    """
    check_new_file(path, overwrite)
    target = Path(os.path.realpath(path))
    try:
        make_folders(target.parent)
        with temporary_folder(target.parent) as folder:
            file = folder / Path(path).name
            yield file
            make_private(file)
            sync(file)
            try:
                _put_file(file, target, overwrite)
            except FileExistsError as error:
                raise OutputExistsError.of(path) from error
            sync(target.parent)
    except RtofError:
        raise
    except OSError as error:
        raise WritingError(f"{path}: cannot be written ({error}); name another file") from error


def check_new_file(path: str | Path, overwrite: bool) -> None:
    """Check that an output file may be written.

    Args:
        path, overwrite: see `new_file`.

    Raises:
        OutputExistsError: it exists. WritingError: its folder cannot be written.
    """
    path = Path(path)
    _check_length(path)
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or a pipe"
        raise OutputExistsError(f"{path}: is {what}; name a file")
    _check_place(Path(os.path.realpath(path)), "name another file")
    if path.exists() and not overwrite:
        raise OutputExistsError.of(path)


def _put_file(new: Path, path: Path, overwrite: bool) -> None:
    if overwrite:
        with suppress(FileNotFoundError):
            shutil.copymode(path, new)
        os.replace(new, path)
        return
    try:
        os.link(new, path)  # fails if `path` exists; a renaming would replace it
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))  # reserves the name
        os.replace(new, path)
