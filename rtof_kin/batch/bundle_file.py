"""A bundle's file: recordings, settings and results of a study in one archive, with a SHA-256 of each member.

manifest.json                     runs, what was kept and left out, SHA-256 of all other members
recordings/S01-1/                 recording.toml and its arrays
results/1/                        motion.h5, measurements.h5, skeleton.urdf, summary.json
files/                            weights and calibrations of the user, by their SHA-256

The archive's comment has the SHA-256 of the manifest. Reading loads no NumPy, so that the number of threads
can be set first; docs/bundle.md.
"""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.archive import digest_of, open_archive

MANIFEST: Final = "manifest.json"
FORMAT, VERSION = "rtof_kin bundle", 1
RECORDINGS, RESULTS, FILES = "recordings", "results", "files"
LABELS: Final = ("operator", "date", "place", "protocol", "notes", "acknowledgement")
"""Free text of a recording that is kept on request."""
RESULT_FILES: Final = ("motion.h5", "measurements.h5", "skeleton.urdf", "summary.json")
"""Members of a result."""
_LARGEST: Final = 16 * 2**30
_LARGEST_MANIFEST: Final = 16 * 2**20
_MEMBER: Final = re.compile(
    rf"{RECORDINGS}/[\w-]+/(recording\.toml|keypoints(_\d+)?\.npz|imus\.npz|truth\.npz)"
    rf"|{RESULTS}/\d+/({'|'.join(map(re.escape, RESULT_FILES))})|{FILES}/[0-9a-f]{{16}}\.(pt|toml)"
)
_PLACE: Final = re.compile(rf"({RECORDINGS}|{RESULTS})/[\w-]+")


@dataclass(frozen=True)
class Run:
    """One reconstruction in a bundle."""

    recording: str
    """Folder of its recording in the bundle."""
    result: str
    """Folder of its result."""
    record: Mapping[str, Any]
    """What it can be repeated by: ``run`` of its summary."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Members by use: model, calibration."""

    def plain(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {"recording": self.recording, "result": self.result, "run": dict(self.record), "files": dict(self.files)}


@dataclass(frozen=True)
class Bundle:
    """Contents of a bundle's manifest."""

    runs: tuple[Run, ...]
    kept: tuple[str, ...]
    """What it tells of people, in sentences."""
    left_out: tuple[str, ...]
    sha256: Mapping[str, str]
    """Of each member."""

    def text(self) -> str:
        """Return the text of `MANIFEST`."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "runs": [run.plain() for run in self.runs],
            "kept": list(self.kept),
            "left_out": list(self.left_out),
            "sha256": dict(self.sha256),
        }
        return json.dumps(content, indent=1, sort_keys=True) + "\n"


def read_bundle(path: Path, folder: Path | None = None) -> Bundle:
    """Verify every member of a bundle, and unpack it if a folder is named.

    Args:
        folder: existing and empty.

    Raises:
        FileFormatError: no bundle, hostile, of a newer version, or a member is missing, added or changed.
    """
    with open_archive(path, _LARGEST) as archive:
        bundle = _manifest(path, archive)
        names = {info.filename for info in archive.infolist()} - {MANIFEST}
        if missing := sorted({*bundle.sha256} - names):
            raise FileFormatError(path, f"changed: the member {missing[0]} is missing; ask for the file again")
        if added := sorted(names - {*bundle.sha256}):
            raise FileFormatError(path, f"changed: the member {added[0]} was added; ask for the file again")
        if other := sorted(name for name in names if not _MEMBER.fullmatch(name)):
            raise FileFormatError(path, f"member {other[0]!r} is nothing that a bundle has; not opened")
        for name, sha256 in sorted(bundle.sha256.items()):
            if _digest(path, archive, name, None if folder is None else folder / name) != sha256:
                raise FileFormatError(path, f"changed: the member {name} is not as it was bundled")
    return bundle


def _digest(path: Path, archive: zipfile.ZipFile, name: str, target: Path | None) -> str:
    try:
        return digest_of(archive, name, target)
    except zipfile.BadZipFile as error:  # a checksum of the archive
        raise FileFormatError(path, f"changed: the member {name} is damaged ({error})") from error


def _manifest(path: Path, archive: zipfile.ZipFile) -> Bundle:
    """Read the manifest and check its form."""
    if MANIFEST not in archive.namelist():
        raise FileFormatError(path, f"no bundle: it has no {MANIFEST}; rtof-kin bundle writes one")
    if archive.getinfo(MANIFEST).file_size > _LARGEST_MANIFEST:
        raise FileFormatError(path, f"{MANIFEST} is larger than {_LARGEST_MANIFEST} bytes; not opened")
    try:
        text = archive.read(MANIFEST)
    except zipfile.BadZipFile as error:
        raise FileFormatError(path, f"changed: {MANIFEST} is damaged ({error})") from error
    if hashlib.sha256(text).hexdigest() != archive.comment.decode("ascii", errors="replace"):
        raise FileFormatError(path, f"changed: {MANIFEST} is not as it was bundled")
    try:
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        if content["version"] != VERSION:
            raise FileFormatError(
                path, f"a bundle of version {content['version']}, this package reads {VERSION}; use a newer one"
            )
        runs = tuple(_run(run, content["sha256"]) for run in content["runs"])
        sha256 = {str(name): str(value) for name, value in content["sha256"].items()}
        kept, left_out = (tuple(map(str, content[name])) for name in ("kept", "left_out"))
    except FileFormatError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(path, f"{MANIFEST} is not that of a bundle ({error})") from error
    if not runs:
        raise FileFormatError(path, f"{MANIFEST} names no run")
    return Bundle(runs, kept, left_out, sha256)


def _run(plain: Mapping[str, Any], members: Mapping[str, str]) -> Run:
    run = Run(plain["recording"], plain["result"], dict(plain["run"]), dict(plain["files"]))
    for place in (run.recording, run.result):
        if not _PLACE.fullmatch(place):
            raise ValueError(f"{place!r} is no folder of a bundle")
    if wrong := [name for name in run.files.values() if name not in members]:
        raise ValueError(f"{wrong[0]!r} is not in it")
    environment, options = run.record["environment"], run.record["options"]
    if not all(isinstance(text, str) for pair in environment.items() for text in pair):
        raise ValueError("the environment is no table of texts")
    if not (isinstance(options, dict) and isinstance(options["mode"], str)):
        raise ValueError("the options are no table with a mode")
    return run
