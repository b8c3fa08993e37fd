"""Folders of output that appear whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from rtof_kin.errors import OutputExistsError, RtofError


def path_inside(folder: Path, name: str) -> Path | None:
    """The path that a file's field names inside a folder, either slash between its parts; None where it
    leads out of it, as '..', absolute names and links do."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or ":" in name or "\0" in name or not parts.parts:
        return None
    path = folder.joinpath(*parts.parts)
    try:
        return path if path.resolve().is_relative_to(folder.resolve()) else None
    except (OSError, RuntimeError):  # a link that leads to itself
        return None


@contextmanager
def new_folder(path: str | Path, marker: str, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its place when the block ends without an error.

    Args:
        path: where the folder shall stand in the end.
        marker: name of a file that every folder of this kind holds. Only a folder that holds it (or an
            empty one) is ever replaced.
        overwrite: whether a folder of this kind may be replaced.

    Raises:
        OutputExistsError: something stands there that may not be replaced.
        RtofError: the place cannot be written to.
    """
    path = Path(path)
    check_replaceable(path, marker, overwrite)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    except OSError as error:
        raise RtofError(f"{path}: cannot be written ({error}); choose another folder") from error
    try:
        temporary.chmod(0o755)
        yield temporary
        if path.exists():
            shutil.rmtree(path)
        temporary.rename(path)
    except RtofError:  # some of them are OSErrors too
        raise
    except OSError as error:
        raise RtofError(f"{path}: writing failed ({error})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_replaceable(path: str | Path, marker: str, overwrite: bool = False) -> None:
    """Raise `OutputExistsError` if output may not go there; long work asks before it begins."""
    path = Path(path)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not path.is_dir():
        raise OutputExistsError(f"{path}: is a file; name a folder")
    if not (path / marker).exists():
        raise OutputExistsError(
            f"{path}: is a folder with other things in it (no {marker}) and is never replaced; "
            "name a new one"
        )
    if not overwrite:
        raise OutputExistsError.of(path)
