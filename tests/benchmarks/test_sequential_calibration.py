"""The study of the sequential calibration: errors and tables add up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.sequential_calibration import VARIANTS, errors, tables
from rtof_kin.calibration.result import Quantity, SelfCalibration

OPEN = "delay, heading, mounting"


def row(how: str, rr_mm: float, **more: Any) -> dict[str, Any]:
    about = {"session": "02", "camera": 0, "case": "right", "variant": "" if how == "none" else OPEN}
    return {**about, "how": how, "mpjpe_rr_mm": rr_mm, "mpjpe_mm": 100.0, "flexion_deg": 3.0, **more}


def test_errors_are_those_of_what_is_applied() -> None:
    one = np.ones(1)
    found = SelfCalibration(
        (
            Quantity("heading", "LeftArm", 0.2 * one, 0.1 * one, one, 0.99),
            Quantity("heading", "RightArm", 0.2 * one, 0.1 * one, one, 0.1),
        )
    )
    truth = {"heading": {"LeftArm": 0.3 * one, "RightArm": 0.0 * one}}
    before, remaining, stated = errors(found, truth)["heading"]
    assert before == pytest.approx(0.3 / np.sqrt(2), rel=1e-3)
    assert remaining == pytest.approx(0.1 / np.sqrt(2), rel=1e-3)
    assert stated == pytest.approx(0.1)


def test_tables_count_recordings_that_change() -> None:
    rows = [row("none", 30.0), row("60 s", 27.0, errors={"heading": [0.1, 0.05, 0.02]})]
    remaining, effects = tables(rows)
    (line,) = remaining.rows
    assert line[:3] == ("right", OPEN, "heading")
    assert line[3] == pytest.approx(np.degrees(0.1))
    (line,) = effects.rows
    assert line[3:6] == ("30.0", "-3.00", "1 / 0")
    assert line[8] == "0 / 0"


def test_variants_leave_open_what_they_are_named_after() -> None:
    fields = {"delay": "sigma_delay", "heading": "sigma_heading", "mounting": "sigma_swing"}
    for variant, priors in VARIANTS.items():
        for kind, field in fields.items():
            assert (getattr(priors, field) is not None) == (kind in variant)
