"""The command retarget, and live --robot: their files and sentences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from clinical_support import walk
from live_support import FakeEstimator
from robots_support import GR1

from rtof_kin.body.motion_file import write_motion
from rtof_kin.core.resources import model_path

Cli = Any


def test_first_line_says_what_was_reached(cli: Cli, tmp_path: Path) -> None:
    write_motion(tmp_path / "motion.h5", walk()[:40])
    done = cli.ok("retarget", tmp_path, "--robot", GR1, "-o", tmp_path / "robot")
    assert done.out.startswith("robot gr1: feet slip 0.")
    done.says("limits broken in 0 of 40 frames", "robot_joint_trajectory.json", "robot_qpos.npz")
    assert "--overwrite" in cli.refused("retarget", tmp_path, "--robot", GR1, "-o", tmp_path / "robot").err
    other = cli.refused("retarget", tmp_path, "--robot", GR1, "--map", "talos", "-o", tmp_path / "other")
    assert "link of talos.toml in the robot" in other.err


def test_live_robot_is_summed_up_at_the_end(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    fake: Any = FakeEstimator()
    fake.calibration = None
    monkeypatch.setattr("rtof_kin.live.estimator.OnlineEstimator", lambda *_: fake)
    demo = model_path("demo")
    options = ("--camera", demo, "--imus", demo, "--speed", "inf", "--seconds", 1)
    done = cli.ok("live", demo, *options, "--robot", GR1, "--send", "ws:0")
    done.says("robot gr1: feet slip ")
    assert "--robot: nobody would get its joints" in cli.refused("live", demo, *options, "--robot", GR1).err
