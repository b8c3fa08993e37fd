"""One ZIP archive of a result with its recording: numbers, settings and versions, without video, names and paths.

recording/     ``recording.toml`` and its arrays, written anew from their numbers without title and labels
result/        motion, measurements, skeleton, and ``summary.json`` with settings and versions
SHA256SUMS     of every member, for ``sha256sum -c SHA256SUMS``

The same result gives the same bytes. Proportions of a body and its way of moving may identify a person without a
name: an archive is still data of a person.
"""

from __future__ import annotations

import json
import re
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rtof_kin.body.motion_file import motion_folder, motion_path
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import check_new_file, new_file
from rtof_kin.core.files.manifest import file_digest
from rtof_kin.core.files.text import load_json
from rtof_kin.core.resources import LIFTERS, model_path
from rtof_kin.formats.measurements_file import measurements_path
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.labels import Session
from rtof_kin.recording.recording import RecordingReader

SUMS: Final = "SHA256SUMS"
LEFT_OUT: Final = "[left out]"  #: In place of a name or path in a text of ``summary.json``
_SUMMARY: Final = (
    "mode verdict frames rate_hz parts skeleton height_m sensors provenance valid_share dofs_from_prior "
    "limit_violations_deg singular_share mean_sigma_m settings inputs audit stream_faults warnings "
    "root_drift_sigma_m solver metrics metrics_per_joint run"
)
_INPUTS: Final = "software first_frame floor_height_m camera cameras camera_estimate sensors calibration"
"""Fields of ``summary.json``, and of its inputs, that are kept."""
_OF_RUN: Final = ("recording", "joined")  #: Recordings beside the motion in the output of `run`
_PATH: Final = r"(?<![\w.])(?:~?/[\w.]|[A-Za-z]:[\\/]|\\\\|file:)\S*|\S+\.(?:mp4|mov|avi|mkv|m4v|webm|jpe?g|png)\b"
_SHORTEST: Final = 3  #: Letters of a name that is searched for


def write_result_archive(
    path: str | Path, result: str | Path, recording: str | Path | None = None, overwrite: bool = False
) -> Path:
    """Write a result and its recording to one ZIP archive. `InvalidInputError`: the result does not say how it was
    made, or the recording is another one; `OutputExistsError`: the file exists; `WritingError`: it cannot be written.

    Args:
        path: file to write.
        result: output of `reconstruct` or `run`.
        recording: folder that the result was made from; default: that in the output of `run`, or the demo.
        overwrite: replace an existing file.

    Returns:
        The file.
    """
    check_new_file(path, overwrite)
    folder = motion_folder(result)
    summary = load_json(folder / "summary.json")
    if (summary.get("run") or {}).get("lift_sha256"):
        raise InvalidInputError(
            f"{folder}: made with --lift, and the archive has the recording only; name the points in its [lift], and "
            "reconstruct again without the option"
        )
    person = Session.of((summary.get("inputs") or {}).get("session") or {}).subject  # maybe of the person's file
    with tempfile.TemporaryDirectory(prefix="rtof_kin_") as temporary:
        written = Path(temporary)
        with recording_of(folder, summary, recording) as (source, found):
            facts, files = found.facts, [Path(lift.name).stem for lift in found.facts.lifts]
            names = identifying(facts.session, (found.name, source.resolve().name), person, files)
            bare = found.with_facts(name="recording", session=Session(), notes="", acknowledgement="")
            bare.save(written / "recording")
        (written / "summary.json").write_text(_summary(summary, names), encoding="utf-8")
        kept = (motion_path(result), measurements_path(folder), folder / "skeleton.urdf", written / "summary.json")
        members = {f"result/{file.name}": file for file in kept if file.is_file()}
        members |= {f"recording/{file.name}": file for file in (written / "recording").glob("[!.]*")}
        members = dict(sorted(members.items()))
        sums = "".join(f"{file_digest(file)}  {name}\n" for name, file in members.items())
        (written / SUMS).write_text(sums, encoding="utf-8")
        with new_file(path, overwrite) as whole, zipfile.ZipFile(whole, "w") as archive:
            for name, file in {SUMS: written / SUMS, **members}.items():
                info = zipfile.ZipInfo(name)  # of 1980: the same contents give the same bytes
                info.create_system, info.external_attr = 3, (stat.S_IFREG | 0o644) << 16
                info.compress_type = zipfile.ZIP_STORED if file.suffix in (".h5", ".npz") else zipfile.ZIP_DEFLATED
                info.file_size = file.stat().st_size
                with file.open("rb") as contents, archive.open(info, "w") as member:
                    shutil.copyfileobj(contents, member)
    return Path(path)


@contextmanager
def recording_of(
    result: Path, summary: Mapping[str, Any], given: str | Path | None
) -> Iterator[tuple[Path, RecordingReader]]:
    """Open the recording of a result, found by the SHA-256 of its numbers; `InvalidInputError` where there is none."""
    run = summary.get("run")
    if not isinstance(run, dict) or "recording_sha256" not in run:
        raise InvalidInputError(
            f"{result}: does not say how it was made (by an earlier version, or in Python); run rtof-kin "
            "reconstruct again, then export that"
        )
    near = (*(result.parent / name for name in _OF_RUN), model_path("demo"))
    for folder in near if given is None else (Path(given),):
        if given is not None or (folder / INDEX).is_file():
            with RecordingReader.open(folder) as recording:
                if recording.digest() == run["recording_sha256"]:
                    yield folder, recording
                    return
    what = "no recording beside it is the one" if given is None else f"{given} is not the recording"
    raise InvalidInputError(
        f"{result}: {what} that it was made from; name its folder by --recording, or reconstruct again if it was "
        "changed since"
    )


def identifying(
    session: Session, titles: Sequence[str], person: str = "", files: Sequence[str] = ()
) -> re.Pattern[str]:
    """Return a pattern of paths, names of videos, a person, files, and what the labels and titles say."""
    words = [
        word for label in (session.subject, session.operator, person) for word in (label, *re.split(r"[\W_]+", label))
    ]
    words += [session.place, *files, *(title for title in titles if not (title.isalpha() and title.islower()))]
    known = sorted({word for word in words if len(word) >= _SHORTEST}, key=len, reverse=True)
    names = "|".join(map(re.escape, known))
    return re.compile(f"{_PATH}|(?<![^\\W_])(?:{names})(?![^\\W_])" if names else _PATH, re.IGNORECASE)


def _summary(whole: dict[str, Any], names: re.Pattern[str]) -> str:
    """Return the text of ``summary.json`` with the fields that are kept, and without names."""
    kept = {field: whole[field] for field in _SUMMARY.split() if field in whole}
    inputs = kept.get("inputs") or {}
    kept["inputs"] = {field: inputs[field] for field in _INPUTS.split() if field in inputs}
    (kept.get("run") or {}).pop("person", None)
    settings = kept.get("settings") or {}
    if settings.get("lifter") not in (*LIFTERS, None):
        settings["lifter"] = "own"
    return json.dumps(_without(kept, names), indent=2) + "\n"


def _without(data: Any, names: re.Pattern[str]) -> Any:
    if isinstance(data, str):
        return names.sub(LEFT_OUT, data)
    if isinstance(data, dict):
        return {_without(key, names): _without(value, names) for key, value in data.items()}
    return [_without(value, names) for value in data] if isinstance(data, list) else data
