"""Reader of ``summary.json`` with a check of the fields that a report needs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rtof_kin.core.errors import FileFormatError, InvalidInputError, reading
from rtof_kin.core.files.text import load_json
from rtof_kin.recording.labels import Session
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.certificate import CertificateSummary

SUMMARY: Final = "summary.json"
SIGMAS: Final = ("relative_m", "world_m")
_READ: Final = ("recording", "mode", "acknowledgement", "inputs", "settings", "audit", "mean_sigma_m")
_NUMBERS: Final = ("_m", "_kg", "_hz", "_px", "_share", "_s", "_s2")  # suffixes of fields that are numbers
_COUNTS: Final = ("first_frame", "cameras")
_TABLES: Final = (
    *("settings", "mean_sigma_m", "inputs", "session", "subject", "camera", "delay"),
    *("calibration", "camera_estimate"),
)
_LISTS: Final = {
    **{"audit": dict, "sensors": dict, "rows": list},
    **dict.fromkeys(("columns", "landmarks", "lifts", "found_of_lifts", "corrections"), str),
}
"""List -> kind of its elements; those of other lists are numbers."""
_OWN: Final = ("audit", "session")  # tables that check themselves
_ANY: Final = ("fragment", "frames", "threads")  # settings of any kind


@dataclass(frozen=True)
class Summary:
    """Contents of ``summary.json`` that a report needs."""

    recording: str
    mode: str
    acknowledgement: str
    session: Session
    inputs: dict[str, Any]  #: See `report.provenance`; empty if the file has none
    results: tuple[AuditResult, ...] | None  #: Of the audit; None if the file has none
    settings: dict[str, Any] | None = None
    certificate: CertificateSummary | None = None  #: What left-out sensors say; None where it was not asked for
    mean_sigmas: tuple[float, float] | None = None
    """Mean standard deviations per axis of the joints, relative to the root and in world, m; NaN where
    unknown, None of a motion without covariances."""
    person: tuple[str, ...] = ()
    """Identifier in the person's file, and digest of the constants of the body that were used; empty without one."""

    @property
    def subject(self) -> dict[str, Any]:
        """'height_m', 'mass_kg', 'sex' and other properties of the subject."""
        return self.inputs.get("subject") or {}

    @property
    def sensors(self) -> int:
        """Number of sensors that the bands rest on."""
        recorded = [] if self.mode == "rto" else self.inputs.get("sensors") or []
        return sum(bool(one.get("segment")) for one in recorded)


def read_summary(path: str | Path) -> Summary:
    """Read the ``summary.json`` of a reconstruction. `FileFormatError`: the file is missing, no JSON, or not written by
    `export`.
    """
    data = load_json(path)
    if not isinstance(data, dict):
        raise FileFormatError(path, "not the summary of a reconstruction")
    with reading(path, "{}; reconstruct again", InvalidInputError, ValueError, TypeError, RecursionError):
        known = {name: data[name] for name in _READ if data.get(name) is not None}
        for name, value in known.items():
            _check(name, value)
        inputs, audit, sigmas = known.get("inputs", {}), known.get("audit"), known.get("mean_sigma_m")
        if sigmas is not None:
            sigmas = tuple(math.nan if sigmas.get(n) is None else float(sigmas[n]) for n in SIGMAS)
        return Summary(
            **{name: known.get(name, "") for name in _READ[:3]},
            session=Session.of(inputs.get("session") or {}),
            inputs=inputs,
            results=None if audit is None else tuple(map(AuditResult.from_plain, audit)),
            settings=known.get("settings"),
            certificate=None if data.get("certificate") is None else CertificateSummary(**data["certificate"]),
            mean_sigmas=sigmas,
            person=_person(data.get("run")),
        )


def _person(run: Any) -> tuple[str, ...]:
    found = run.get("person") if isinstance(run, dict) else None
    names = ("subject", "constants_sha256")
    return tuple(str(found[name]) for name in names) if isinstance(found, dict) and all(map(found.get, names)) else ()


def _check(name: str, value: Any) -> None:
    """Raise unless a value, and what is in it, is of the kind that the name of its field says."""
    field = name.rpartition(", ")[2]
    number = field.endswith(_NUMBERS) or field in _COUNTS
    kind: Any = dict if field in _TABLES else int | float if number else str | bool
    parts = [value]
    if field in _LISTS or field == "lever_arm_m":
        _expect(name, value, list)
        kind, parts = _LISTS.get(field, int | float), value
    for part in parts:
        _expect(name, part, kind)
        for key, own in part.items() if kind is dict and field not in _OWN else ():
            if own is not None and key not in _ANY:
                _check(f"{name}, {key}", own)


def _expect(name: str, value: Any, kind: Any) -> None:
    if not isinstance(value, kind):
        what = {dict: "no table", list: "no list"}.get(kind, f"{str(value)[:40]!r} is not valid")
        raise InvalidInputError(f"{name}: {what}")
