"""``subject.toml``, what is known of one person, and the `Recording` of that person with it where it is silent.

The file is described in docs/subject.md. Each value has a standard deviation, or stands for a usual one where a person
typed it. `merged` combines estimates of one constant as an information filter does: precisions add.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Generic, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, Strict

from rtof_kin.body.pose_prior import NeutralPosture
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.input_table import InputTable, Number, Positive, Vector3, explained_by
from rtof_kin.core.files.text import write_text
from rtof_kin.recording.index import body_of, shipped
from rtof_kin.recording.recording import Recording

CONTRADICTION: Final = 3.0  #: Standard deviations of a difference beyond which two estimates contradict each other
USUAL_SD: Final = {
    "height_m": 0.01,
    "mass_kg": 3.0,
    "sex": 1.0,
    "ankle_height_m": 0.01,
    "joint_offsets_m": 0.01,
    "posture_deg": 3.0,
    "image_points_m": 0.01,
}
"""Standard deviation of a value without one, per axis, in its unit: of a person who measured it, clothes included."""
SHARED_SD: Final = {
    "height_m": 0.003,
    "mass_kg": 0.5,
    "ankle_height_m": 0.004,
    "joint_offsets_m": 0.015,
    "posture_deg": 2.0,
    "image_points_m": 0.004,
}
"""What no number of estimates falls below, of bones relative to their length. Precisions of errors that all recordings
share do not add: estimates of bones from 43 recordings had a common error of 1.7 % (benchmarks/results/subject.md).
"""
_SPREAD_OF_PLACES: Final = 0.015
"""[m] Standard deviation per axis between persons of where a detector sees a joint; estimates are shrunk by it."""
_UNKNOWN: Final = 0.036  #: Standard deviation of bones by the height, relative to their length
_HEIGHT_BY_BONES: Final = 0.04  #: [m] Standard deviation of the height that bones make
_Value = TypeVar("_Value")
Identifier = Annotated[
    str,
    Field(pattern=r"^[\w-]{1,64}$"),
    explained_by("is no identifier; use up to 64 letters, digits, - and _, and no name of a person"),
]


Height = Annotated[Number, Field(gt=0.4, lt=2.6), explained_by("is no human height; give metres")]
Mass = Annotated[Number, Field(gt=2, lt=500), explained_by("is no person's mass; give kilograms")]


class Estimate(InputTable, Generic[_Value]):
    """A value of a person."""

    value: _Value
    """In the unit of the field."""
    sd: Positive | None = None
    """Standard deviation of each number, in the same unit; left out where a person measured or typed the value."""
    source: str = "typed"
    """Where it comes from."""
    date: str = ""
    """Day of it, as 2026-01-31."""


class Past(Estimate[Any]):
    """An estimate that was merged or refused."""

    refused: str = ""
    """Why it was not merged; empty where it was."""


class Subject(InputTable):
    """What is known of one person; constants of the body, none of a recording."""

    schema_version: Literal[1] = 1
    """Version of this format."""
    subject: Identifier
    """An identifier that you choose."""
    skeleton: Literal["total_capture", "human36m"] = "total_capture"
    """Table of the skeleton whose joints are named here."""
    height_m: Estimate[Height] | None = None
    """Standing height."""
    mass_kg: Estimate[Mass] | None = None
    """Body mass."""
    sex: Estimate[Literal["female", "male"]] | None = None
    """For the inertia of segments."""
    ankle_height_m: Estimate[Positive] | None = None
    """Height of the ankle joints over the floor in standing."""
    joint_offsets_m: dict[str, Estimate[Vector3]] = {}
    """Each joint in its parent's link frame: its length is that of the bone."""
    posture_deg: dict[str, Estimate[Vector3]] = {}
    """Rotation vector of joints relative to their parents when the person stands in the T-pose."""
    image_points_m: dict[str, dict[str, Estimate[Vector3]]] = {}
    """By detector's layout and joint: how far from their usual place it sees the points next to the joint, in the axes
    of their segments."""
    history: dict[str, Annotated[tuple[Past, ...], Strict(False)]] = {}
    """All estimates by field, as joint_offsets_m.LeftLeg, merged and refused, in the order in which they came."""

    @property
    def known(self) -> dict[str, Estimate[Any]]:
        """Estimates by the path of their field, as ``joint_offsets_m.LeftLeg``."""
        return {path: one for name in USUAL_SD for path, one in _flat(name, getattr(self, name))}

    def with_known(self, known: Mapping[str, Estimate[Any]], history: Mapping[str, Sequence[Past]]) -> Self:
        """Return the person with other estimates, by path."""
        data: dict[str, Any] = {"subject": self.subject, "skeleton": self.skeleton}
        data["history"] = {field: [*map(_plain, rows)] for field, rows in history.items()}
        for path, one in known.items():
            *tables, last = path.split(".", 2)
            inner = data
            for table in tables:
                inner = inner.setdefault(table, {})
            inner[last] = _plain(one)
        return type(self).of(data, self.path)

    def informed(self, recording: Recording) -> dict[str, Any]:
        """Return the fields of a recording of this person that the file knows and the recording does not give."""
        one = {"height": self.height_m, "mass_kg": self.mass_kg, "sex": self.sex}
        facts: dict[str, Any] = {k: v.value for k, v in one.items() if v is not None and getattr(recording, k) is None}
        if not recording.session.subject:
            facts["session"] = replace(recording.session, subject=self.subject)
        if self.skeleton != recording.skeleton_table:
            return facts
        if not recording.bones_given and ("height" in facts or self.joint_offsets_m):
            body = body_of(self.skeleton, height=facts.get("height", recording.height))
            body = body.with_offsets({joint: one.value for joint, one in self.joint_offsets_m.items()})
            facts["joint_offsets"] = body.joint_offsets
        if "joint_offsets" in facts and self.joint_offsets_m:
            own = {joint: sd_of("joint_offsets_m", one) for joint, one in self.joint_offsets_m.items()}
            rows = [(own.get(joint, _UNKNOWN * length), length) for joint, length in body.bone_lengths.items()]
            sd, length = np.sqrt(np.mean(np.square(rows), axis=0))
            facts["sigma_bones"] = min(float(sd / length), _UNKNOWN)
        if recording.posture is None and self.posture_deg:
            turns = np.radians([one.value for one in self.posture_deg.values()])
            sigmas = np.radians([sd_of("posture_deg", one) for one in self.posture_deg.values()])
            facts["posture"] = NeutralPosture(tuple(self.posture_deg), so3.to_quat_wxyz(so3.exp(turns)), sigmas)
        if self.image_points_m and recording.calibration is None:  # with sensors they gain nothing
            facts["image_points"] = {
                layout: {
                    joint: np.array(one.value) / (1 + (sd_of("image_points_m", one) / _SPREAD_OF_PLACES) ** 2)
                    for joint, one in own.items()
                }
                for layout, own in self.image_points_m.items()
            }
        return facts


def read_subject(path: str | Path) -> Subject:
    """Read a person's file; `FileFormatError` or `UnknownNameError`, which names file, field and remedy."""
    if not (path := Path(path)).exists():
        raise FileFormatError(path, "there is no such file; --update-subject makes it, or write it (docs/subject.md)")
    subject = Subject.read(path)
    joints = shipped(subject.skeleton).names[1:]
    named = {name: getattr(subject, name) for name in ("joint_offsets_m", "posture_deg")}
    named |= {f"image_points_m.{layout}": own for layout, own in subject.image_points_m.items()}
    for field, own in named.items():
        if unknown := [name for name in own if name not in joints]:
            raise UnknownNameError("joint", unknown, joints, path, f"[{field}]")
    for joint, one in subject.joint_offsets_m.items():
        if not 1e-4 < np.linalg.norm(one.value) < 1.0:
            raise subject.error(f"joint_offsets_m.{joint}", "is no bone of a person; give its offset in metres")
    return subject


def write_subject(path: str | Path, subject: Subject, overwrite: bool = False) -> None:
    """Write a person's file atomically, a value a line; errors as `write_text`."""
    lines = ["# What is known of one person: docs/subject.md. sd: standard deviation, in the unit of the field."]
    lines += [f"{name} = {_toml(getattr(subject, name))}" for name in ("schema_version", "subject", "skeleton")]
    table = ""
    for path_, one in subject.known.items():
        *tables, last = path_.split(".", 2)
        if (own := ".".join(map(_key, tables))) != table:
            lines += ["", f"[{own}]"]
            table = own
        lines.append(f"{_key(last)} = {_inline(one)}")
    lines += ["", "[history]"] if subject.history else []
    for field, rows in subject.history.items():
        lines += [f"{_key(field)} = [", *(f"    {_inline(past)}," for past in rows), "]"]
    write_text(Path(path), "\n".join(lines) + "\n", overwrite)


def _flat(path: str, node: Any) -> Iterator[tuple[str, Estimate[Any]]]:
    if isinstance(node, Estimate):
        yield path, node
    for name, inner in node.items() if isinstance(node, dict) else ():
        yield from _flat(f"{path}.{name}", inner)


def _plain(one: Estimate[Any]) -> dict[str, Any]:
    """Return an estimate as TOML has it."""
    data = {name: getattr(one, name) for name in type(one).model_fields if one.has(name)}
    return {k: np.asarray(v).tolist() for k, v in data.items() if v is not None and not (k == "refused" and not v)}


def _inline(one: Estimate[Any]) -> str:
    """Return an inline table."""
    return f"{{ {', '.join(f'{name} = {_toml(value)}' for name, value in _plain(one).items())} }}"


def _toml(value: Any) -> str:
    """Return a value as TOML, whose numbers, texts and lists are JSON's but for one character."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


# --- several estimates of one value --------------------------------------------------------------


def sd_of(field: str, one: Estimate[Any]) -> float:
    """Return the standard deviation of an estimate, the usual one of its field where it has none."""
    return one.sd if one.sd is not None else USUAL_SD[field.partition(".")[0]]


def contradiction(field: str, old: Estimate[Any], new: Estimate[Any]) -> str:
    """Return how two estimates of a field contradict each other, '' where they do not."""
    if isinstance(old.value, str):
        return "" if old.value == new.value else f"{new.value} is not {old.value}"
    away = float(np.max(np.abs(np.subtract(new.value, old.value))))
    sigma = float(np.hypot(sd_of(field, old), sd_of(field, new)))
    if away <= CONTRADICTION * sigma:
        return ""
    return f"{_shown(new.value)} is {away / sigma:.1f} standard deviations ({sigma:.2g}) from {_shown(old.value)}"


def combined(field: str, old: Estimate[Any], new: Estimate[Any], count: int = 2) -> Estimate[Any]:
    """Return the estimate of two, of `count` in all; precisions add down to `SHARED_SD`, and weigh the values."""
    if isinstance(old.value, str):
        return old
    w_old, w_new = sd_of(field, old) ** -2, sd_of(field, new) ** -2
    value = np.round((w_old * np.asarray(old.value) + w_new * np.asarray(new.value)) / (w_old + w_new), 6)
    kind = field.partition(".")[0]
    shared = SHARED_SD[kind] * (float(np.linalg.norm(value)) if kind == "joint_offsets_m" else 1.0)
    least = min(shared, sd_of(field, old), sd_of(field, new))
    sd, date = float(f"{max((w_old + w_new) ** -0.5, least):.6g}"), max(old.date, new.date)
    return type(old)(value=value if value.ndim else float(value), sd=sd, source=f"{count} estimates", date=date)


def merged(subject: Subject, news: Mapping[str, Estimate[Any]], doubt: str = "") -> tuple[Subject, tuple[str, ...]]:
    """Return a person with news by field, which are independent of what is known, and sentences on what changed and
    what was refused, since it contradicts what is known. All of them stand in the history.

    A source counts once, and a typed value that is known already does not count again. `doubt`: why nothing counts.
    """
    known, history = subject.known, {field: [*rows] for field, rows in subject.history.items()}
    changed, refused = list[str](), [f"nothing is merged: {doubt}"] if doubt else []
    for field, new in news.items():
        old, past = known.get(field), history.setdefault(field, [])
        if old is not None and not past:  # written by hand
            past.append(Past.of(_plain(old), Path()))
        counted = [one for one in past if not one.refused]
        if any(one.source == new.source != "typed" for one in counted) or (
            new.sd is None and any(np.array_equal(new.value, one.value) for one in (*counted, *filter(None, [old])))
        ):
            continue
        reason = doubt or (contradiction(field, old, new) if old is not None else "")
        if not (reason and any(one.source == new.source for one in past)):
            past.append(Past.of({**_plain(new), "refused": reason}, Path()))
        if not reason:
            known[field] = now = new if old is None else combined(field, old, new, 1 + len(counted))
            changed.append(f"{field}: {f'{_of(field, old)} -> ' if old else ''}{_of(field, now)}")
        elif not doubt:
            refused.append(f"{field} is refused: {reason}")
    return subject.with_known(known, {field: rows for field, rows in history.items() if rows}), (*changed, *refused)


def _of(field: str, one: Estimate[Any]) -> str:
    return _shown(one.value) if isinstance(one.value, str) else f"{_shown(one.value)} ± {sd_of(field, one):.2g}"


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else ", ".join(f"{number:.4g}" for number in np.atleast_1d(value))


# --- a recording and its person ------------------------------------------------------------------


def given_by(recording: Recording, source: str) -> dict[str, Estimate[Any]]:
    """Return what a recording itself says of its person, by field; without standard deviations."""
    values: dict[str, Any] = {"height_m": recording.height, "mass_kg": recording.mass_kg, "sex": recording.sex}
    found = {field: value for field, value in values.items() if value is not None}
    if recording.bones_given:
        offsets = dict(zip(recording.skeleton.names, recording.joint_offsets, strict=True))
        for joint in recording.bone_lengths or recording.skeleton.names[1:]:  # without those that follow the height
            found[f"joint_offsets_m.{joint}"] = offsets[joint]
    if (posture := recording.posture) is not None:
        for joint, turn in zip(posture.joints, np.degrees(so3.log(posture.R_parent_bone)), strict=True):
            found[f"posture_deg.{joint}"] = turn
    date = recording.session.date
    return {path: Estimate[Any](value=value, source=source, date=date) for path, value in found.items()}


def contradictions(subject: Subject, recording: Recording) -> tuple[str, tuple[str, ...]]:
    """Return why a recording is of another person than a file, '' where it is not, and sentences on single values that
    differ: the recording's is used.

    The heights decide, or any two of: mass, sex, bones and joints of the posture, those of both sides as one. Of the 60
    numbers of the right person's bones, one in six files has one beyond `CONTRADICTION`.
    """
    known, same = subject.known, subject.skeleton == recording.skeleton_table
    given = given_by(recording, "")
    if recording.bones_given and not recording.bone_lengths:
        given = {"height_m": Estimate[Any](value=recording.skeleton.height, sd=_HEIGHT_BY_BONES)} | given
    shared = {path: new for path, new in given.items() if path in known and (same or "." not in path)}
    found = {path: why for path, new in shared.items() if (why := contradiction(path, known[path], new))}
    name, kinds = subject.path.name, {path.replace("Left", "").replace("Right", "") for path in found}
    if "height_m" not in kinds and len(kinds) < 2:
        return "", tuple(f"{name} has another {path}, which is not used: {why}" for path, why in found.items())
    (path, why), *others = found.items()
    more = f" (and {len(others)} more)" if others else ""
    return f"{name} is likely of another person and is not used: {path} {why}{more}", ()
