"""The numbers of three seconds of the demo in all modes, as a user gets them: compiled code and the shipped lifter.

Modes imu and rto have energies of their own, which are interpreted: tests/solve/test_energy.py compiles others.
"""

from __future__ import annotations

from typing import Any

import pytest

from rtof_kin import ReconstructionSettings, Recording, reconstruct
from rtof_kin.core.resources import model_path

GOLDEN: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "rtof": ({"mode": "rtof"}, (27.42, 142.51, 2.77)),
    "calibrated": ({"mode": "rtof", "calibrate": True}, (26.01, 84.79, 1.83)),
    "cartesian": ({"mode": "rtof", "settings": ReconstructionSettings(space="cartesian")}, (34.83, 101.44, 2.93)),
    "rto": ({"mode": "rto"}, (64.15, 133.81, 11.55)),
    "sf2": ({"mode": "sf2"}, (33.25, 97.39, 3.08)),
    "lift": ({"mode": "lift"}, (66.32, 120.09, 12.69)),
    "imu": ({"mode": "imu"}, (62.95, 68.67, 3.25)),
}
"""Name -> arguments of `reconstruct`; root-relative and absolute error of the joints, mm, and of flexion, deg."""


@pytest.mark.parametrize("name", GOLDEN)
def test_the_demo_has_the_errors_that_it_had(name: str) -> None:
    arguments, expected = GOLDEN[name]
    result = reconstruct(Recording.load(model_path("demo")).between(11.0, 14.0), **arguments)
    found = result.stage_metrics[arguments["mode"]]
    assert [found[key] for key in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")] == pytest.approx(expected, abs=0.04)
