"""Samples of sensors and points from the channels of a stream."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import SourceError
from rtof_kin.data.imu_stream import Declaration
from rtof_kin.live.lsl import FrameChannels, ImuChannels

ONE = ["qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z"]


def test_samples_of_two_sensors_are_planted_motion() -> None:
    rng = np.random.default_rng(1)
    R, f = so3.exp(rng.normal(size=(5, 2, 3))), 9.8 * rng.normal(size=(5, 2, 3))
    declaration = Declaration(acceleration_unit="g", inertial_axes="z down")
    quat = declaration.filed_quaternions(R.reshape(-1, 3, 3)).reshape(5, 2, 4)
    values = np.concatenate([quat, declaration.filed_acceleration(f)], axis=2).reshape(5, 14)
    labels = [f"{sensor}_{label}" for sensor in ("pelvis", "head") for label in ONE]
    units = ["", "", "", "", "g", "g", "g"] * 2
    channels = ImuChannels("xsens", labels, units, declared={"inertial_axes": "z down"})
    assert channels.names == ("pelvis", "head")
    samples = channels.samples(np.arange(5) / 60, values)
    assert [(s.sensor, s.time) for s in samples[:3]] == [("pelvis", 0.0), ("head", 0.0), ("pelvis", 1 / 60)]
    np.testing.assert_allclose([s.R_inertial_sensor for s in samples], R.reshape(-1, 3, 3), atol=1e-12)
    np.testing.assert_allclose([s.f_sensor for s in samples], f.reshape(-1, 3), atol=1e-12)


def test_missing_numbers_are_nan() -> None:
    channels = ImuChannels("s", ONE[:4])
    assert "acceleration" in channels.notes[0]
    unknown, zero = channels.samples([0.0, 1.0], [[np.nan] * 4, [0.0] * 4])
    assert np.isnan([unknown.R_inertial_sensor, zero.R_inertial_sensor]).all()
    assert np.isnan(unknown.f_sensor).all()
    assert channels.samples([], np.zeros((0, 4))) == []


def test_sensor_without_orientation_is_named() -> None:
    with pytest.raises(SourceError, match=r"stream s: sensor b .*qw"):
        ImuChannels("s", [*(f"a_{one}" for one in ONE), *(f"b_{one}" for one in ONE[4:])])


@pytest.mark.parametrize("values", [np.zeros((1, 6)), np.zeros(7), [["text"] * 7]])
def test_wrong_number_of_values_names_the_stream(values: object) -> None:
    with pytest.raises(SourceError, match="stream s.*7"):
        ImuChannels("s", ONE).samples([0.0], values)  # type: ignore[arg-type]


def test_frames() -> None:
    channels = FrameChannels("s", ["Nose_x", "Nose_y", "Nose_confidence"])
    seen, unseen = channels.samples([0.0, 0.04], [[3.0, 4.0, 0.8], [3.0, 4.0, 0.0]])
    assert (seen.uv_px.tolist(), seen.confidence.tolist()) == ([[3, 4]], [0.8])
    assert (unseen.time, unseen.confidence.tolist()) == (0.04, [0])
    assert np.isnan(unseen.uv_px).all()
    with pytest.raises(SourceError, match="stream s.*3"):
        channels.samples([0.0], [[1, 2]])
    with pytest.raises(SourceError, match="stream s"):
        FrameChannels("s", ["time"])
