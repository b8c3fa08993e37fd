"""What a report takes from ``summary.json``, checked before anybody relies on its shape."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rtof_kin.core.errors import FileFormatError, InvalidInputError, ShapeError
from rtof_kin.core.files.text import load_json
from rtof_kin.recording.session import Session
from rtof_kin.report.audit_results import Finding

SUMMARY = "summary.json"
_NUMBERS = ("_m", "_kg", "_hz", "_px", "_share", "_s2")
"""Ends of the names of fields that hold numbers."""
_LISTS = ("lever_arm_m", "landmarks")


@dataclass(frozen=True)
class Summary:
    """What a report takes from ``summary.json``."""

    recording: str
    mode: str
    acknowledgement: str
    session: Session
    """The recording's own labels."""
    inputs: dict[str, Any]
    """As `report.provenance` has them; empty where the file has none."""
    findings: tuple[Finding, ...] | None
    """Of the audit; None where the file has none."""
    settings: dict[str, Any] | None = None
    """As `rtof_kin.reconstruction.choices` has them; None where the file has none."""

    @property
    def subject(self) -> dict[str, Any]:
        """'height_m', 'mass_kg', 'sex' and what else the recording knew of the person."""
        return self.inputs.get("subject") or {}

    def with_inputs(self, inputs: dict[str, Any]) -> Summary:
        """The same, made from other inputs."""
        return replace(self, inputs=inputs)


def read_summary(path: str | Path) -> Summary:
    """The ``summary.json`` of a reconstruction.

    Raises:
        FileFormatError: missing, no JSON, or not what `export` writes.
    """
    data = load_json(path)
    if not isinstance(data, dict):
        raise FileFormatError(path, "not the summary of a reconstruction")
    texts = {}
    for name in ("recording", "mode", "acknowledgement"):
        texts[name] = data.get(name, "")
        if not isinstance(texts[name], str):
            raise FileFormatError(path, f"{name}: no text")
    inputs, audit, settings = data.get("inputs", {}), data.get("audit"), data.get("settings")
    try:
        if settings is not None:
            _check_table("settings", settings, {"fragment", "frames", "threads"})
        _check_inputs(inputs)
        session = Session.of(inputs.get("session") or {})
        if not (audit is None or isinstance(audit, list)):
            raise ShapeError("audit: no list")
        findings = None if audit is None else tuple(Finding.from_plain(entry) for entry in audit)
    except InvalidInputError as error:
        raise FileFormatError(path, f"{error}; reconstruct again") from error
    return Summary(**texts, session=session, inputs=inputs, findings=findings, settings=settings)


def _check_inputs(inputs: Any) -> None:
    """Raise `ShapeError` where they are not such as `report.provenance` makes them."""
    _check_table("inputs", inputs, {"session", "subject", "camera", "calibration", "sensors"})
    for name in ("session", "subject", "camera"):
        _check_table(f"inputs, {name}", inputs.get(name) or {})
    sensors = inputs.get("sensors") or []
    _check_list("inputs, sensors", sensors)
    for sensor in sensors:
        _check_table("inputs, sensors", sensor)
    calibration = inputs.get("calibration") or {}
    _check_table("inputs, calibration", calibration, {"columns", "rows"})
    for name in ("columns", "rows"):
        _check_list(f"inputs, calibration, {name}", calibration.get(name, []))
    for row in calibration.get("rows", []):
        _check_list("inputs, calibration, rows", row)


def _check_list(name: str, given: Any) -> None:
    if not isinstance(given, list):
        raise ShapeError(f"{name}: no list")


def _check_table(name: str, table: Any, parts: Collection[str] = ()) -> None:
    """Raise where this is no table of numbers (by the ends of their names) and texts; `parts` of it are
    looked at elsewhere.
    """
    if not isinstance(table, dict):
        raise ShapeError(f"{name}: no table")
    for field, value in table.items():
        if field in parts or value is None:
            continue
        wanted: type | tuple[type, ...] = (str, bool)
        if field.endswith(_NUMBERS) or field == "first_frame":
            wanted = (int, float)
        values = value if field in _LISTS and isinstance(value, list) else [value]
        if not all(isinstance(part, wanted) for part in values):
            raise ShapeError(f"{name}, {field}: {str(value)[:40]!r} is not what belongs there")
