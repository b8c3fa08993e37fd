"""The numbers of six seconds of the demo in all seven modes, as a user gets them: compiled code and the shipped lifter.

Mode imu alone has an energy of its own: tests/solve/test_energy.py compiles one without a camera.
"""

from __future__ import annotations

from typing import Any

import pytest

from rtof_kin import ReconstructionSettings, Recording, reconstruct
from rtof_kin.core.resources import model_path

GOLDEN: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "rtof": ({"mode": "rtof"}, (28.93, 168.19, 3.26)),
    "calibrated": ({"mode": "rtof", "calibrate": True}, (27.02, 92.7, 2.16)),
    "cartesian": ({"mode": "rtof", "settings": ReconstructionSettings(space="cartesian")}, (34.58, 118.68, 3.2)),
    "rto": ({"mode": "rto"}, (69.69, 146.76, 11.35)),
    "sf2": ({"mode": "sf2"}, (33.49, 124.12, 3.4)),
    "lift": ({"mode": "lift"}, (72.26, 136.75, 12.81)),
    "imu": ({"mode": "imu"}, (59.18, 126.01, 3.68)),
}
"""Name -> arguments of `reconstruct`; root-relative and absolute error of the joints, mm, and of flexion, deg."""


@pytest.mark.parametrize("name", GOLDEN)
def test_the_demo_has_the_errors_that_it_had(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "imu":
        monkeypatch.setenv("RTOF_KIN_COMPILE", "never")
    arguments, expected = GOLDEN[name]
    result = reconstruct(Recording.load(model_path("demo")).between(8.0, 14.0), **arguments)
    found = result.stage_metrics[arguments["mode"]]
    assert [found[key] for key in ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg")] == pytest.approx(expected, abs=0.04)
