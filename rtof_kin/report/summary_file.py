"""What a report takes from ``summary.json``, checked before anybody relies on its shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rtof_kin.errors import FileFormatError, ShapeError
from rtof_kin.io.text import load_json
from rtof_kin.report.findings import Finding

SUMMARY = "summary.json"
_TABLES = ("session", "subject", "camera", "calibration")
_NUMBERS = ("_m", "_kg", "_hz", "_px", "_share", "_s2")
"""Ends of the names of fields that hold numbers."""


@dataclass(frozen=True)
class Summary:
    """What a report takes from ``summary.json``."""

    recording: str
    mode: str
    acknowledgement: str
    inputs: dict[str, Any]
    """As `report.facts` has them; empty where the file has none."""
    findings: tuple[Finding, ...] | None
    """Of the audit; None where the file has none."""

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
    inputs, audit = data.get("inputs", {}), data.get("audit")
    try:
        _check_inputs(inputs)
        if not (audit is None or isinstance(audit, list)):
            raise ShapeError("audit: no list")
        findings = None if audit is None else tuple(Finding.from_plain(entry) for entry in audit)
    except ShapeError as error:
        raise FileFormatError(path, f"{error}; reconstruct again") from error
    return Summary(**texts, inputs=inputs, findings=findings)


def _check_inputs(inputs: Any) -> None:
    """Raise `ShapeError` where they are not such as `report.facts` makes them."""
    if not isinstance(inputs, dict):
        raise ShapeError("inputs: no table")
    for name in _TABLES:
        table = inputs.get(name)
        if table is not None:
            _check_table(name, table)
    sensors = inputs.get("sensors") or []
    if not isinstance(sensors, list):
        raise ShapeError("inputs, sensors: no list")
    for sensor in sensors:
        _check_table("sensors", sensor)
    for name in ("columns", "rows"):
        if not isinstance((inputs.get("calibration") or {}).get(name, []), list):
            raise ShapeError(f"inputs, calibration, {name}: no list")


def _check_table(name: str, table: Any) -> None:
    if not isinstance(table, Mapping):
        raise ShapeError(f"inputs, {name}: no table")
    for field, value in table.items():
        wanted: tuple[type, ...] = (int, float) if field.endswith(_NUMBERS) else (str, bool, list)
        wanted = (str,) if name == "session" else wanted
        if field == "lever_arm_m":
            values = value if isinstance(value, list) else [] if value is None else [""]
        else:
            values = [] if value is None else [value]
        if not all(isinstance(part, wanted) for part in values):
            raise ShapeError(f"inputs, {name}, {field}: {str(value)[:40]!r} is not what belongs there")
