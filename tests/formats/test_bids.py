"""A Motion-BIDS data set: valid for the official validator, its sensors read back, its motion as plain numbers."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_files import truth, write_csv

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.bids import motion_system, sensor_systems, write_bids
from rtof_kin.formats.sensors.files import read_sensor_log

VALIDATOR = Path(sys.executable).with_name("bids-validator-deno")
needs_validator = pytest.mark.skipif(not VALIDATOR.exists(), reason="needs bids-validator-deno")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    """Two sensors of all quantities; the second began later, and lost a gyroscope's sample."""
    folder = tmp_path_factory.mktemp("log")
    first, second = read_sensor_log(write_csv(folder, [truth(1), truth(2)])).streams
    w = np.array(second.w_sensor)
    w[3] = np.nan
    streams = (first, replace(second, times=second.times + 0.25, w_sensor=w))
    return SensorLog(folder, "", streams, read_sensor_log(folder).declaration)


@pytest.fixture(scope="module")
def dataset(log: SensorLog, motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    valid = np.array(motion.poses.valid)
    valid[:5, -1] = False
    poses = replace(motion.poses, valid=valid)
    folder = tmp_path_factory.mktemp("bids")
    systems = [*sensor_systems(log), motion_system(MotionSource.of(replace(motion, poses=poses)))]
    write_bids(folder, systems, "P07", {"height_m": 1.72, "sex": "female"})
    return folder


def issues(folder: Path) -> list[dict[str, Any]]:
    """What the validator says; it exits with 1 where there are errors."""
    done = subprocess.run([VALIDATOR, folder, "--format", "json"], capture_output=True, text=True, check=False)
    return list(json.loads(done.stdout)["issues"]["issues"])


@needs_validator
def test_the_official_validator_finds_no_error_and_would_find_one(dataset: Path) -> None:
    found = issues(dataset)
    assert [one for one in found if one["severity"] == "error"] == []
    assert {one["code"] for one in found} <= {
        *("JSON_KEY_RECOMMENDED", "SIDECAR_KEY_RECOMMENDED", "NO_AUTHORS", "TOO_FEW_AUTHORS", "EVENTS_TSV_MISSING")
    }
    path = next(dataset.glob("sub-P07/motion/*tracksys-imu_motion.json"))
    kept = path.read_text()
    path.write_text(kept.replace('"TaskName"', '"Task"'))
    wrong = [one for one in issues(dataset) if one["severity"] == "error"]
    path.write_text(kept)
    assert wrong[0]["subCode"] == "TaskName"


def test_sensors_are_read_back_at_their_times(dataset: Path, log: SensorLog) -> None:
    for label, true in zip(("imu", "imu2"), log.streams, strict=True):
        (stream,) = read_sensor_log(dataset / f"sub-P07/motion/sub-P07_task-motion_tracksys-{label}_motion.tsv").streams
        assert (stream.name, stream.holds) == (true.name, true.holds)
        for name in ("times", *true.holds):
            np.testing.assert_allclose(getattr(stream, name), getattr(true, name), atol=1e-6)


def test_the_motion_is_in_world_with_units_and_what_was_unobserved_is_missing(dataset: Path, motion: Motion) -> None:
    stem = f"{dataset}/sub-P07/motion/sub-P07_task-motion_tracksys-rtofkin"
    with Path(f"{stem}_channels.tsv").open() as stream:
        channels = list(csv.DictReader(stream, delimiter="\t"))
    values = np.genfromtxt(f"{stem}_motion.tsv", delimiter="\t", missing_values="n/a")
    at = {one["name"]: column for column, one in enumerate(channels)}
    assert (len(at), values.shape) == (len(channels), (len(motion.times), len(channels)))
    np.testing.assert_allclose(values[:, 0], motion.times, atol=1e-6)
    for j, name in enumerate(motion.skeleton.names):
        p = values[:, [at[f"{name}_POS_{axis}"] for axis in "xyz"]]
        last = j == len(motion.skeleton.names) - 1
        assert np.isnan(p).any(axis=1).tolist() == [last] * 5 + [False] * (len(p) - 5)
        np.testing.assert_allclose(p[5:], motion.poses.p_world_joint[5:, j], atol=1e-6)
        quat = values[5:, [at[f"{name}_ORNT_quat_{axis}"] for axis in "wxyz"]]
        R = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        np.testing.assert_allclose(R, motion.poses.R_world_bone[5:, j], atol=1e-6)
    knee = next(one for one in channels if one["name"] == "LeftLeg_y_JNTANG")
    assert (knee["type"], knee["units"], knee["tracked_point"]) == ("JNTANG", "deg", "LeftLeg")
    assert "left knee flexion" in knee["description"]
    column = 7 + motion.skeleton.dof_names.index("LeftLeg_y")
    np.testing.assert_allclose(values[5:, at["LeftLeg_y_JNTANG"]], np.degrees(motion.q[5:, column]), atol=1e-5)
    frames = json.loads(Path(f"{stem}_channels.json").read_text())["reference_frame"]["Levels"]
    assert (frames["world"]["SpatialAxes"], frames["world"]["RotationRule"]) == ("FLU", "right-hand")
    facts = json.loads(Path(f"{stem}_motion.json").read_text())
    assert (facts["SamplingFrequency"], facts["POSChannelCount"]) == (60, 3 * len(motion.skeleton.names))
    assert "sub-P07\tF\t1.72\tn/a" in (dataset / "participants.tsv").read_text()
