"""File format of a self-calibration: TOML.

schema_version = 1
middle_s = 10.0                     # time stamp of the constants of what drifts
converged = 1
[quantities.mounting.LeftArm]       # kind, then item
value = [0.01, -0.02, 0.0]          # SI units or px
sigma = [0.01, 0.01, 0.03]
sigma_prior = [0.035, 0.035, 0.07]
known = 0.4                         # relative reduction of the prior's variance
doubt = "..."                       # - why the value may be wrong
[detector.LeftArm]                  # remaining reprojection errors of a landmark
sigma_px = 5.1
memory_s = 0.4
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import tomli_w

from rtof_kin.calibration.result import Detector, Quantity, SelfCalibration
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.input_table import InputTable, Integer, Number, Row
from rtof_kin.core.files.text import load_toml, write_text

SCHEMA_VERSION = 1


class QuantityTable(InputTable):
    """A quantity: SI units or px."""

    value: Row
    sigma: Row
    sigma_prior: Row
    known: Number
    """Relative reduction of the prior's variance."""
    doubt: str = ""
    """Why the value may be wrong."""


class DetectorTable(InputTable):
    """Remaining reprojection errors of a landmark."""

    sigma_px: Number
    memory_s: Number


class CalibrationTable(InputTable):
    """The file."""

    schema_version: Literal[1]
    middle_s: Number
    """Time stamp of the constants of what drifts."""
    converged: Integer
    quantities: dict[str, dict[str, QuantityTable]]
    """By kind and item."""
    detector: dict[str, DetectorTable] = {}


def write_self_calibration_toml(path: str | Path, calibration: SelfCalibration, overwrite: bool = False) -> None:
    """Write a calibration; `read_self_calibration_toml` restores it exactly.

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for.
        RtofError: it cannot be written.
    """
    quantities: dict[str, dict[str, Any]] = {}
    for q in calibration.quantities:
        quantities.setdefault(q.kind, {})[q.item] = {
            "value": q.value.tolist(),
            "sigma": q.sigma.tolist(),
            "sigma_prior": q.sigma_prior.tolist(),
            "known": q.known,
            **({"doubt": q.doubt} if q.doubt else {}),
        }
    content = {
        "schema_version": SCHEMA_VERSION,
        "middle_s": calibration.middle,
        "converged": int(calibration.converged),
        "quantities": quantities,
        "detector": {d.landmark: {"sigma_px": d.sigma_px, "memory_s": d.memory} for d in calibration.detector},
    }
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def read_self_calibration_toml(path: str | Path) -> SelfCalibration:
    """Read a calibration.

    Raises:
        FileFormatError, UnknownNameError: the message names file, field and remedy.
    """
    data = load_toml(path)
    if "quantities" not in data:
        raise FileFormatError(
            path,
            "no calibration that `rtof-kin calibrate` wrote, as it has no table [quantities]; give "
            "the file named by its -o",
        )
    if (version := data.get("schema_version", SCHEMA_VERSION)) != SCHEMA_VERSION:
        raise FileFormatError(
            path,
            f"schema_version: {version} is not {SCHEMA_VERSION}, which this version of the package "
            "reads; use the version that wrote it, or a newer one",
        )
    file = CalibrationTable.of(data, Path(path))
    try:
        return SelfCalibration(
            tuple(_quantity(one, kind, item) for kind, items in file.quantities.items() for item, one in items.items()),
            tuple(Detector(name, one.sigma_px, one.memory_s) for name, one in file.detector.items()),
            file.middle_s,
            bool(file.converged),
        )
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _quantity(table: QuantityTable, kind: str, item: str) -> Quantity:
    for name in ("sigma", "sigma_prior"):
        if (shape := getattr(table, name).shape) != table.value.shape:
            raise table.error(name, f"expected {len(table.value)} numbers, got shape {shape}")
    return Quantity(kind, item, table.value, table.sigma, table.sigma_prior, table.known, table.doubt)
