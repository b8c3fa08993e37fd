"""Reader of ``summary.json`` with a check of the fields that a report needs."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.text import load_json
from rtof_kin.recording.labels import Session
from rtof_kin.reporting.audit_results import AuditResult

SUMMARY: Final = "summary.json"
SIGMAS: Final = ("relative_m", "world_m")
_NUMBERS: Final = ("_m", "_kg", "_hz", "_px", "_share", "_s", "_s2")  # suffixes of fields that are numbers
_COUNTS: Final = ("first_frame", "cameras")
_LISTS: Final = ("lever_arm_m", "landmarks")


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
    mean_sigmas: tuple[float, float] | None = None
    """Mean standard deviations per axis of the joints, relative to the root and in world, m; NaN where
    unknown, None of a motion without covariances."""

    @property
    def subject(self) -> dict[str, Any]:
        """'height_m', 'mass_kg', 'sex' and other properties of the subject."""
        return self.inputs.get("subject") or {}


def read_summary(path: str | Path) -> Summary:
    """Read the ``summary.json`` of a reconstruction.

    Raises:
        FileFormatError: the file is missing, no JSON, or not written by `export`.
    """
    data = load_json(path)
    if not isinstance(data, dict):
        raise FileFormatError(path, "not the summary of a reconstruction")
    try:
        texts = {name: data.get(name, "") for name in ("recording", "mode", "acknowledgement")}
        for name, text in texts.items():
            _check(name, text, str, "text")
        inputs, audit, settings = data.get("inputs", {}), data.get("audit"), data.get("settings")
        if settings is not None:
            _check_table("settings", settings, {"fragment", "frames", "threads"})
        _check_inputs(inputs)
        session = Session.of(inputs.get("session") or {})
        results = None
        if audit is not None:
            _check("audit", audit, list, "list")
            results = tuple(AuditResult.from_plain(entry) for entry in audit)
        sigmas = data.get("mean_sigma_m")
        if sigmas is not None:
            _check_table("mean_sigma_m", sigmas)
            sigmas = tuple(math.nan if sigmas.get(n) is None else float(sigmas[n]) for n in SIGMAS)
    except (InvalidInputError, ValueError) as error:
        raise FileFormatError(path, f"{error}; reconstruct again") from error
    return Summary(**texts, session=session, inputs=inputs, results=results, settings=settings, mean_sigmas=sigmas)


_TABLES = ("calibration", "camera_estimate")  #: Inputs with columns and rows


def _check_inputs(inputs: Any) -> None:
    """Raise `InvalidInputError` if the structure is not that of `report.provenance`."""
    _check_table("inputs", inputs, {"session", "subject", *_TABLES, "camera", "delay", "sensors"})
    for name in ("session", "subject", "camera", "delay"):
        _check_table(f"inputs, {name}", inputs.get(name) or {})
    sensors = inputs.get("sensors") or []
    _check("inputs, sensors", sensors, list, "list")
    for sensor in sensors:
        _check_table("inputs, sensors", sensor)
    for found in _TABLES:
        own = inputs.get(found) or {}
        _check_table(f"inputs, {found}", own, {"columns", "rows"})
        for name in ("columns", "rows"):
            _check(f"inputs, {found}, {name}", own.get(name, []), list, "list")
        for row in own.get("rows", []):
            _check(f"inputs, {found}, rows", row, list, "list")


def _check(name: str, value: Any, kind: type, what: str) -> None:
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name}: no {what}")


def _check_table(name: str, table: Any, skipped: Collection[str] = ()) -> None:
    """Raise unless a value is a table of numbers (by the suffixes of their names) and texts."""
    _check(name, table, dict, "table")
    for field, value in table.items():
        if field in skipped or value is None:
            continue
        number = field.endswith(_NUMBERS) or field in _COUNTS
        values = value if field in _LISTS and isinstance(value, list) else [value]
        if not all(isinstance(part, int | float if number else str | bool) for part in values):
            raise InvalidInputError(f"{name}, {field}: {str(value)[:40]!r} is not valid")
