"""Bundling of reconstructions: what is kept of recordings and results, without names, places and video.

Recordings are written anew from their numbers, and summaries from a list of fields: what is not listed here
is left out. Everything is searched for names and paths before it is written.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from rtof_kin.batch.bundle_file import FILES, LABELS, MANIFEST, RECORDINGS, RESULT_FILES, RESULTS, Bundle, Run
from rtof_kin.batch.privacy import Finding, Search, of_this_machine
from rtof_kin.batch.reproduction import REDACTED
from rtof_kin.body.motion_file import motion_folder
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.archive import write_archive
from rtof_kin.core.files.folder import check_new_file
from rtof_kin.core.files.manifest import file_digest
from rtof_kin.core.files.text import load_json
from rtof_kin.core.resources import LIFTERS, model_path
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.session import Session

_SUMMARY: Final = (
    "mode",
    "verdict",
    "frames",
    "rate_hz",
    "parts",
    "skeleton",
    "height_m",
    "sensors",
    "provenance",
    "valid_share",
    "dofs_from_prior",
    "limit_violations_deg",
    "singular_share",
    "mean_sigma_m",
    "settings",
    "inputs",
    "audit",
    "stream_faults",
    "warnings",
    "root_drift_sigma_m",
    "solver",
    "metrics",
    "metrics_per_joint",
    "run",
)
_INPUTS: Final = (
    "software",
    "first_frame",
    "subject",
    "floor_height_m",
    "camera",
    "cameras",
    "camera_estimate",
    "sensors",
    "calibration",
)
"""Fields of ``summary.json``, and of its inputs, that are kept."""
_OF_RUN: Final = ("recording", "joined")
"""Recordings beside the motion in the output of `run`."""
_NAMED: Final = 5
"""Findings that an error lists."""


@dataclass(frozen=True)
class Choice:
    """What the user chose for a bundle."""

    ids: tuple[str, ...] = ()
    """Pseudonyms of the subjects, in the order of the outputs; default: S01, S02, ..."""
    keep: tuple[str, ...] = ()
    """Of `LABELS`."""
    forbidden: tuple[str, ...] = ()
    """Words that must not be in it."""
    allowed: tuple[str, ...] = ()
    """Words that may."""
    redact: bool = False
    """Replace sentences that identify, instead of refusing."""


@dataclass(frozen=True)
class _Source:
    """An output with its recording."""

    output: Path
    record: dict[str, Any]
    """``run`` of its summary."""
    folder: Path
    recording: Recording


def write_bundle(
    path: Path,
    outputs: Sequence[Path],
    recordings: Sequence[Path],
    files: Sequence[Path] = (),
    choice: Choice | None = None,
    overwrite: bool = False,
) -> Bundle:
    """Write reconstructions with their recordings and settings to one file.

    Args:
        outputs: folders of `reconstruct` or `run`. overwrite: replace an existing file.

    Raises:
        InvalidInputError: a recording or file of a run is not there, or something that identifies would be
            in the bundle: the message says where.
        OutputExistsError: the file exists.
    """
    choice = choice or Choice()
    check_new_file(path, overwrite)
    sources = _sources(outputs, recordings)
    subjects = _subjects(sources, choice)
    search = _search(sources, subjects, choice)
    with tempfile.TemporaryDirectory(prefix="rtof_kin_") as name:
        folder = Path(name)
        runs, kept, left_out = _collect(folder, sources, subjects, files, choice, search)
        paths = sorted(found for found in folder.rglob("*") if found.is_file())
        members = {found.relative_to(folder).as_posix(): found for found in paths}
        sha256 = {name: file_digest(found) for name, found in members.items()}
        bundle = Bundle(tuple(runs), tuple(kept), tuple(left_out), sha256)
        (folder / MANIFEST).write_text(bundle.text(), encoding="utf-8")
        contents = {MANIFEST: folder / MANIFEST} | members
        search.allow((*members, MANIFEST))
        _refuse(one for name, found in contents.items() for one in search.in_file(name, found))
        write_archive(path, contents, file_digest(folder / MANIFEST), overwrite)
    return bundle


# --- what belongs together -----------------------------------------------------------------------


def _sources(outputs: Sequence[Path], recordings: Sequence[Path]) -> list[_Source]:
    """Return the outputs with the recordings that they were made from."""
    sources, loaded = list[_Source](), set[Path]()
    known: dict[str, tuple[Path, Recording]] = {}
    for given in outputs:
        output = motion_folder(given)
        record = load_json(output / "summary.json").get("run")
        if not isinstance(record, dict) or "recording_sha256" not in record:
            raise InvalidInputError(
                f"{output}: does not say how it was made (by an earlier version, or in Python); run rtof-kin "
                "reconstruct again, then bundle that"
            )
        digest = record["recording_sha256"]
        near = (*(output.parent / name for name in _OF_RUN), model_path("demo"))
        for folder in (*recordings, *near):
            if digest not in known and folder not in loaded and (folder / INDEX).is_file():
                loaded.add(folder)
                found = Recording.load(folder)
                known.setdefault(found.digest(), (folder, found))
        if digest not in known:
            raise InvalidInputError(
                f"{output}: none of the recordings given is the one that it was made from; name its folder "
                "by --recording, or reconstruct again if it was changed since"
            )
        sources.append(_Source(output, record, *known[digest]))
    return sources


def _search(sources: Iterable[_Source], subjects: Sequence[str], choice: Choice) -> Search:
    """Return the search for all names that must not be in a bundle."""
    names, phrases = [*choice.forbidden], of_this_machine()
    allowed = [*choice.allowed, *subjects]
    for source in sources:
        session = source.recording.session
        names += [session.subject, session.operator]
        phrases.append(session.place)
        allowed += [text for label, text in session.plain().items() if label in choice.keep]
        titles = (source.recording.name, source.folder.resolve().name)
        phrases += [title for title in titles if not title.isalpha() or not title.islower()]  # walk is no name
    return Search(names, phrases, allowed)


# --- what is written -----------------------------------------------------------------------------


def _collect(
    folder: Path,
    sources: Sequence[_Source],
    subjects: Sequence[str],
    files: Sequence[Path],
    choice: Choice,
    search: Search,
) -> tuple[list[Run], list[str], list[str]]:
    """Write all members but the manifest; return the runs, what was kept and what was left out."""
    places: dict[Path, str] = {}
    runs, kept, left_out = list[Run](), list[str](), list[str]()
    for number, source in enumerate(sources, start=1):
        subject = subjects[number - 1]
        if source.folder not in places:
            count = sum(place.startswith(f"{RECORDINGS}/{subject}-") for place in places.values())
            name = f"{subject}-{count + 1}"
            places[source.folder] = f"{RECORDINGS}/{name}"
            bare, labels = _bare(source.recording, name, subject, choice)
            bare.save(folder / RECORDINGS / name)
            _forget_manifest(folder / RECORDINGS / name)
            if Recording.load(folder / RECORDINGS / name).digest() != source.record["recording_sha256"]:
                raise InvalidInputError(f"{source.folder}: cannot be written with exactly these numbers")
            kept.append(f"{name}: {', '.join(_told(bare))}")
            left_out.append(f"{name}: {', '.join(labels)}")
        result = f"{RESULTS}/{number}"
        own = _own_files(folder, source, files)
        _write_result(folder / result, source, Path(places[source.folder]).name, choice, search)
        runs.append(Run(places[source.folder], result, source.record, own))
    left_out += [
        "video and pictures: none was read",
        "names of folders, this user and this machine",
        "figures, tables and files for other programs: rtof-kin export and report make them again",
    ]
    return runs, kept, left_out


def _subjects(sources: Sequence[_Source], choice: Choice) -> list[str]:
    """Return a pseudonym for the person of each output; unnamed people are one for each recording."""
    keys = [source.recording.session.subject or f"\0{source.folder}" for source in sources]
    people = [*dict.fromkeys(keys)]
    if choice.ids and len(choice.ids) != len(people):
        raise InvalidInputError(f"--id: {len(choice.ids)} given for {len(people)} people")
    ids = choice.ids or tuple(f"S{number:02}" for number in range(1, len(people) + 1))
    if len({*ids}) < len(ids):
        raise InvalidInputError("--id: two people have the same one")
    if wrong := [one for one in ids if not one.replace("-", "").isalnum() or not one.isascii()]:
        raise InvalidInputError(f"--id: {wrong[0]!r} has other characters than letters, digits and -")
    return [ids[people.index(key)] for key in keys]


def _bare(recording: Recording, name: str, subject: str, choice: Choice) -> tuple[Recording, list[str]]:
    """Return a recording without labels, and which of them it had."""
    texts = asdict(recording.session) | {"notes": recording.notes, "acknowledgement": recording.acknowledgement}
    own = {label: texts[label] if label in choice.keep else "" for label in LABELS}
    session = Session(subject, *(own[label] for label in ("operator", "date", "place", "protocol")))
    bare = replace(recording, name=name, session=session, notes=own["notes"], acknowledgement=own["acknowledgement"])
    gone = [label for label in LABELS if texts[label] and not own[label]]
    gone = (["name of the subject"] if texts["subject"] else []) + gone
    return bare, ["title", *gone]


def _told(recording: Recording) -> list[str]:
    """Return what a bundled recording tells of a person, in words."""
    facts = {"height": recording.height, "mass": recording.mass_kg}
    units = {"height": "m", "mass": "kg"}
    told = [f"{what} {value:g} {units[what]}" for what, value in facts.items() if value is not None]
    told += [f"sex {recording.sex}"] if recording.sex else []
    told.append("lengths of the body")
    if recording.keypoints is not None:
        cameras = 1 + len(recording.views)
        told.append(f"keypoints of {cameras} camera{'s' if cameras > 1 else ''} with their calibration")
    if recording.imus is not None:
        told.append(f"sensors named {', '.join(recording.imus.names)}")
    told += ["reference motion"] if recording.truth is not None else []
    told += [f"{k} {v!r}" for k, v in recording.session.plain().items() if k != "subject"]
    notes = {"notes": recording.notes, "acknowledgement": recording.acknowledgement}
    return [*told, *(name for name, text in notes.items() if text)]


def _own_files(folder: Path, source: _Source, files: Sequence[Path]) -> dict[str, str]:
    """Copy weights and calibration of a run that are not shipped; return their members."""
    shipped = {file_digest(model_path(name)) for name in LIFTERS.values()}
    given = {file_digest(path): path for path in files}
    out = {}
    for use, ending in (("model", ".pt"), ("calibration", ".toml")):
        digest = source.record.get(f"{use}_sha256")
        if digest is None or digest in shipped:
            continue
        if digest not in given:
            raise InvalidInputError(
                f"{source.output}: was made with a {use} that is not shipped; name its file by --with FILE"
            )
        out[use] = f"{FILES}/{digest[:16]}{ending}"
        (folder / FILES).mkdir(exist_ok=True)
        shutil.copyfile(given[digest], folder / out[use])
    return out


def _write_result(folder: Path, source: _Source, name: str, choice: Choice, search: Search) -> None:
    """Write what is kept of an output."""
    folder.mkdir(parents=True)
    for file in RESULT_FILES[:-1]:
        if (source.output / file).is_file():
            shutil.copyfile(source.output / file, folder / file)
    whole = load_json(source.output / "summary.json")
    summary = {"recording": name} | {field: whole[field] for field in _SUMMARY if field in whole}
    inputs = summary.get("inputs") or {}
    summary["inputs"] = {field: inputs[field] for field in _INPUTS if field in inputs}
    settings = summary.get("settings") or {}
    if settings.get("lifter") not in (*LIFTERS, None):
        settings["lifter"] = "own"
    if choice.redact:
        summary = _redacted(summary, search)
    text = json.dumps(summary, indent=2) + "\n"
    (folder / RESULT_FILES[-1]).write_text(text, encoding="utf-8")


def _redacted(data: Any, search: Search) -> Any:
    """Return plain data with sentences that identify replaced."""
    if isinstance(data, str):
        return REDACTED if search.in_text("", data) else data
    if isinstance(data, dict):
        return {key: _redacted(value, search) for key, value in data.items()}
    return [_redacted(value, search) for value in data] if isinstance(data, list) else data


def _forget_manifest(folder: Path) -> None:
    """Remove the hidden list of files, which the bundle's own replaces."""
    for path in folder.glob(".*"):
        path.unlink()


def _refuse(findings: Iterable[Finding]) -> None:
    """Raise if anything that identifies was found."""
    found = [*findings]
    if found:
        more = f"; and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        raise InvalidInputError(
            f"not bundled, it would tell who, where or when: {'; '.join(map(str, found[:_NAMED]))}{more}. "
            "Take it out of the recording and reconstruct again; --redact replaces sentences of the summary, "
            "and --allow WORD says that a word is harmless"
        )
