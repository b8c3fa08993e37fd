"""The demo's numbers in all seven modes, as a user gets them: compiled code and the shipped lifter.

Mode imu alone has an energy of its own: tests/solve/test_energy.py compiles one without a camera.
"""

from __future__ import annotations

from typing import Any

import pytest

from rtof_kin import ReconstructionSettings, Recording, reconstruct
from rtof_kin.core.resources import model_path

GOLDEN: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "rtof": ({"mode": "rtof"}, (22.99, 88.13, 3.03)),
    "calibrated": ({"mode": "rtof", "calibrate": True}, (21.57, 97.38, 2.85)),
    "cartesian": ({"mode": "rtof", "settings": ReconstructionSettings(space="cartesian")}, (29.55, 81.1, 3.01)),
    "rto": ({"mode": "rto"}, (54.78, 118.09, 13.3)),
    "sf2": ({"mode": "sf2"}, (27.48, 99.96, 3.13)),
    "lift": ({"mode": "lift"}, (59.67, 129.19, 14.3)),
    "imu": ({"mode": "imu"}, (40.17, 301.48, 3.37)),
}
"""Name -> arguments of `reconstruct`; root-relative and absolute error of the joints, mm, and of flexion, deg."""


@pytest.mark.parametrize("name", GOLDEN)
def test_the_demo_has_the_errors_that_it_had(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "imu":
        monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    arguments, expected = GOLDEN[name]
    result = reconstruct(Recording.load(model_path("demo")), **arguments)
    found = result.stage_metrics[arguments["mode"]]
    assert [found[key] for key in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")] == pytest.approx(expected, abs=0.1)
