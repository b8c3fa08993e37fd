"""Recordings of healthy people below a folder, from which a reference of the gait scores is made."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rtof_kin.body.motion_file import MotionReader, file_in, motion_path
from rtof_kin.clinical.gait_variables import GaitCycles, gait_cycles, joined_cycles
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.reporting.audit_results import Grade
from rtof_kin.reporting.headline import headline
from rtof_kin.reporting.summary_file import SUMMARY, read_summary

_ANALYSED = "gait_cycles.csv"
"""File of an analysis, which may be without its motion."""


@dataclass(frozen=True)
class Found:
    """Strides of the people below a folder."""

    people: dict[str, GaitCycles]
    """Code of a person -> strides of all recordings."""
    recordings: dict[str, list[str]]
    """Code -> folders of the recordings, relative."""
    left_out: dict[str, str]
    """Folder -> why it is not used."""
    skeletons: tuple[str, ...]
    """Names of the models."""


def read_cycles(path: str | Path, from_standing: bool = False) -> tuple[GaitCycles, str]:
    """Return the strides of a motion, and the name of its skeleton.

    Args:
        from_standing: see `gait_cycles`.

    Raises:
        FileFormatError: it is none of these, or damaged.
    """
    with MotionReader(motion_path(path)) as reader:
        source = reader
        return gait_cycles(source, from_standing=from_standing), source.skeleton.name


def find_people(folder: str | Path, from_standing: bool = False) -> Found:
    """Return the strides of all motions below a folder, by person.

    A person is the subject of the recording's session; without one, each recording is a person of its own,
    named by its folder. Motions whose audit failed are left out.

    Args:
        from_standing: see `gait_cycles`.

    Raises:
        FileFormatError: there is no such folder. InvalidInputError: there is no motion in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder; name the one with the healthy recordings")
    parts: dict[str, list[GaitCycles]] = {}
    recordings: dict[str, list[str]] = {}
    left_out: dict[str, str] = {}
    skeletons = []
    for place in _places(folder):
        name = place.relative_to(folder).as_posix() if place != folder else folder.resolve().name
        try:
            person = _person(place, name)
            cycles, skeleton = read_cycles(place, from_standing)
        except RtofError as error:
            left_out[name] = str(error)
            continue
        if cycles.why_not:
            left_out[name] = cycles.why_not
            continue
        parts.setdefault(person, []).append(cycles)
        recordings.setdefault(person, []).append(name)
        skeletons.append(skeleton)
    if not parts and not left_out:
        raise InvalidInputError(
            f"{folder}: no motion below it; name the folder with the outputs of reconstruct, run or batch"
        )
    people = {person: joined_cycles(own) for person, own in parts.items()}
    return Found(people, recordings, left_out, tuple(dict.fromkeys(skeletons)))


def _places(folder: Path) -> Iterator[Path]:
    """Folders with a motion, and those with an analysis alone; hidden ones are not searched."""
    for place, inner, files in os.walk(folder):
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        if file_in(Path(place)) or (_ANALYSED in files and not file_in(Path(place).parent)):
            yield Path(place)


def _person(place: Path, name: str) -> str:
    """Code of the person of a motion.

    Raises:
        InvalidInputError: there is no motion, or its audit failed.
    """
    if file_in(place) is None:
        raise InvalidInputError("an analysis without its motion.h5; name the output of reconstruct or run")
    if not (path := place / SUMMARY).is_file():
        return name
    summary = read_summary(path)
    if summary.results:
        verdict = headline(summary.results)
        if verdict.grade is Grade.FAIL:
            raise InvalidInputError(f"its audit fails: {verdict.text}")
    return summary.session.subject or name
