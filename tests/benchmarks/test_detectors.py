"""The benchmark of detectors: its arithmetic, on a short walk."""

from __future__ import annotations

import numpy as np
import pytest
from detector_support import walking

from benchmarks.detectors import KINDS, measure, table
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.vision.landmark_regression import LandmarkRegression


def test_the_adapter_is_better_in_every_row_and_layouts_are_recognised() -> None:
    motion = walking()
    clip = MocapClip("walk", motion.poses[::5], np.array(motion.skeleton.joint_offsets))
    adapter = LandmarkRegression.default()
    rows = measure([clip], adapter)
    assert len(rows) == (len(adapter.table.layouts) - 2) * len(KINDS)
    for row in rows:
        assert row["adapter_px"] < row["naive_px"]
        assert row["recognised"] == 1.0
        assert row["given"] == 1.0 if row["kind"] == "exact" else row["given"] > 0.7
        assert row["rms_px"] >= row["all_joints_px"]
        joints = row["per_joint_px"]["adapter"]
        assert np.mean(list(joints.values())) == pytest.approx(row["all_joints_px"], rel=0.1)
    exact = {row["layout"]: row["adapter_px"] for row in rows if row["kind"] == "exact"}
    noisy = {row["layout"]: row["adapter_px"] for row in rows if row["kind"] == "noisy"}
    assert all(noisy[layout] > exact[layout] + 1 for layout in exact)
    assert len(table(rows).splitlines()) == 2 + len(rows)
