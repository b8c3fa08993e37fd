"""The numbers of three seconds of the demo in all seven modes, as a user gets them: compiled code and the shipped lifter.

Mode imu alone has an energy of its own: tests/solve/test_energy.py compiles one without a camera.
"""

from __future__ import annotations

from typing import Any

import pytest

from rtof_kin import ReconstructionSettings, Recording, reconstruct
from rtof_kin.core.resources import model_path

GOLDEN: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "rtof": ({"mode": "rtof"}, (28.01, 178.17, 3.66)),
    "calibrated": ({"mode": "rtof", "calibrate": True}, (28.76, 109.75, 3.27)),
    "cartesian": ({"mode": "rtof", "settings": ReconstructionSettings(space="cartesian")}, (31.6, 141.71, 3.36)),
    "rto": ({"mode": "rto"}, (75.42, 168.1, 11.17)),
    "sf2": ({"mode": "sf2"}, (31.1, 158.75, 3.72)),
    "lift": ({"mode": "lift"}, (78.66, 164.57, 12.88)),
    "imu": ({"mode": "imu"}, (54.63, 99.73, 4.13)),
}
"""Name -> arguments of `reconstruct`; root-relative and absolute error of the joints, mm, and of flexion, deg."""


@pytest.mark.parametrize("name", GOLDEN)
def test_the_demo_has_the_errors_that_it_had(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "imu":
        monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    arguments, expected = GOLDEN[name]
    result = reconstruct(Recording.load(model_path("demo")).between(8.0, 11.0), **arguments)
    found = result.stage_metrics[arguments["mode"]]
    assert [found[key] for key in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")] == pytest.approx(expected, abs=0.04)
