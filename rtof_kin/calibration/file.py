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
from typing import Any

import tomli_w

from rtof_kin.calibration.result import Detector, Quantity, SelfCalibration
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.section import Section
from rtof_kin.core.files.text import write_text

SCHEMA_VERSION = 1


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
    file = Section.of_file(Path(path))
    if not file.has("quantities"):
        raise FileFormatError(
            path,
            "no calibration that `rtof-kin calibrate` wrote, as it has no table [quantities]; give "
            "the file named by its -o",
        )
    version = file.integer("schema_version")
    if version != SCHEMA_VERSION:
        raise file.error(
            "schema_version",
            f"{version} is not {SCHEMA_VERSION}, which this version of the package "
            "reads; use the version that wrote it, or a newer one",
        )
    kinds, landmarks = file.table("quantities"), file.table("detector")
    try:
        calibration = SelfCalibration(
            tuple(
                _quantity(kinds.table(kind), item)
                for kind in kinds.keys()  # noqa: SIM118
                for item in kinds.table(kind).keys()  # noqa: SIM118
            ),
            tuple(_detector(landmarks, name) for name in landmarks.keys()),  # noqa: SIM118
            file.number("middle_s"),
            bool(file.integer("converged")),
        )
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
    file.close()
    return calibration


def _quantity(kind: Section, item: str) -> Quantity:
    section = kind.table(item)
    value = section.numbers("value")
    sigma, sigma_prior = (section.array(n, value.shape) for n in ("sigma", "sigma_prior"))
    known = section.number("known")
    doubt = section.text("doubt", "")
    section.close()
    return Quantity(kind.name.partition(".")[2], item, value, sigma, sigma_prior, known, doubt)


def _detector(landmarks: Section, name: str) -> Detector:
    section = landmarks.table(name)
    found = Detector(name, section.number("sigma_px"), section.number("memory_s"))
    section.close()
    return found
