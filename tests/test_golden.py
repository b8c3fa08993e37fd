"""The demo's numbers in all seven modes, as a user gets them: compiled code and the shipped lifter."""

from __future__ import annotations

from typing import Any

import pytest

from rtof_kin import ReconstructionSettings, Recording, reconstruct
from rtof_kin.core.resources import model_path

GOLDEN: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "rtof": ({"mode": "rtof"}, (23.93, 98.2, 2.93)),
    "calibrated": ({"mode": "rtof", "calibrate": True}, (24.06, 89.88, 2.84)),
    "cartesian": ({"mode": "rtof", "settings": ReconstructionSettings(space="cartesian")}, (28.98, 98.11, 2.95)),
    "rto": ({"mode": "rto"}, (58.92, 150.95, 13.95)),
    "sf2": ({"mode": "sf2"}, (26.69, 130.96, 3.11)),
    "lift": ({"mode": "lift"}, (60.91, 168.34, 14.77)),
    "imu": ({"mode": "imu"}, (48.47, 313.7, 3.27)),
}
"""Name -> arguments of `reconstruct`; root-relative and absolute error of the joints, mm, and of flexion, deg."""


@pytest.mark.parametrize("name", GOLDEN)
def test_the_demo_has_the_errors_that_it_had(name: str) -> None:
    arguments, expected = GOLDEN[name]
    result = reconstruct(Recording.load(model_path("demo")), **arguments)
    found = result.stage_metrics[arguments["mode"]]
    assert [found[key] for key in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")] == pytest.approx(expected, abs=0.1)
