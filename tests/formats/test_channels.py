"""Channels by their names: spellings, units, what is refused, points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.formats.channels import PointChannels, StreamChannels

SPELLINGS = {
    "short": ["qw", "qx", "qy", "qz", "ax", "ay", "az"],
    "underscored": ["quat_w", "quat_x", "quat_y", "quat_z", "acc_x", "acc_y", "acc_z"],
    "dotted": ["Quat.W", "Quat.X", "Quat.Y", "Quat.Z", "Acc.X", "Acc.Y", "Acc.Z"],
    "numbered": ["q0", "q1", "q2", "q3", "fx", "fy", "fz"],
    "words": [
        "orientation w",
        "orientation x",
        "orientation y",
        "orientation z",
        "accelerometer x",
        "accelerometer y",
        "accelerometer z",
    ],
}


def listed(columns: NDArray[Any] | None) -> Any:
    return None if columns is None else columns.tolist()


@pytest.mark.parametrize("labels", SPELLINGS.values(), ids=SPELLINGS)
@pytest.mark.parametrize(
    ("prefix", "name"), [("", "stream"), ("pelvis_", "pelvis"), ("L_LowArm/", "L_LowArm"), ("Pelvis.", "Pelvis")]
)
def test_spellings_of_one_sensor(labels: list[str], prefix: str, name: str) -> None:
    channels = StreamChannels.of("stream", [prefix + label for label in labels])
    (sensor,) = channels.sensors
    assert sensor.name == name
    assert (listed(sensor.quaternions), listed(sensor.acceleration)) == ([0, 1, 2, 3], [4, 5, 6])
    assert (sensor.gyroscope, channels.notes) == (None, ())


def test_readings_of_two_sensors_in_any_order_of_channels() -> None:
    labels = [
        f"{sensor}_{part}" for part in ("qz", "qy", "qx", "qw", "gyr_x", "gyr_y", "gyr_z") for sensor in ("a", "b")
    ]
    channels = StreamChannels.of("two", labels)
    values = np.arange(28.0).reshape(2, 14)
    for sensor, shift in zip(channels.sensors, (0, 1), strict=True):
        readings = sensor.readings(np.arange(2.0), values)
        quaternions, rates = listed(readings.quaternions), listed(readings.gyroscope)
        assert quaternions[0] == [6 + shift, 4 + shift, 2 + shift, shift]
        assert rates[0] == [8 + shift, 10 + shift, 12 + shift]
        assert readings.acceleration is None


def test_order_of_quaternions_is_declared_for_numbers_and_known_for_letters() -> None:
    R_half_turn_about_x = np.diag([1.0, -1.0, -1.0])
    for labels, values in ((["q0", "q1", "q2", "q3"], [1, 0, 0, 0]), (["qw", "qx", "qy", "qz"], [0, 1, 0, 0])):
        channels = StreamChannels.of("s", labels, declared={"quaternion_order": "xyzw"})
        reading = channels.sensors[0].readings(np.zeros(1), np.array([values], dtype=float))
        R = reading.stream(channels.declaration).R_inertial_sensor
        assert R is not None
        np.testing.assert_allclose(R[0], R_half_turn_about_x, atol=1e-12)


def test_units_of_the_metadata_and_their_replacement() -> None:
    labels = ["qw", "qx", "qy", "qz", "acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]
    units = [""] * 4 + ["G"] * 3 + ["dps"] * 3
    channels = StreamChannels.of("s", labels, units)
    assert (channels.declaration.acceleration_unit, channels.declaration.angular_unit) == ("g", "deg/s")
    other = StreamChannels.of("s", labels, units, declared={"acceleration_unit": "m/s2"})
    assert other.declaration.acceleration_unit == "m/s2"
    (note,) = other.notes
    assert "m/s2" in note


@pytest.mark.parametrize(("label", "axes"), [("FreeAcc", "inertial"), ("lin_acc", "sensor")])
def test_acceleration_without_gravity(label: str, axes: str) -> None:
    labels = ["qw", "qx", "qy", "qz", *(f"{label}_{axis}" for axis in "xyz")]
    declaration = StreamChannels.of("s", labels).declaration
    assert (declaration.gravity, declaration.acceleration_axes) == ("removed", axes)
    both = StreamChannels.of("s", [*labels, "acc_x", "acc_y", "acc_z"])
    assert both.declaration.gravity == "included"
    assert listed(both.sensors[0].acceleration) == [7, 8, 9]


@pytest.mark.parametrize(
    ("labels", "units", "named"),
    [
        (["a", "b"], [], "qw"),
        ([], [], "labels"),
        (["qw", "qx", "qz"], [], "no y"),
        (["qw", "qw"], [], "'qw'"),
        (["acc_x", "acc_y", "acc_z"], ["furlong/s2"] * 3, "furlong"),
        (["acc_x", "acc_y", "acc_z"], ["g", "mg", "g"], "acc_y"),
        ([f"{s}_{a}" for s in ("a_acc", "b_freeacc") for a in "xyz"], [], "gravity"),
    ],
)
def test_refusals_name_stream_and_channel(labels: list[str], units: list[str], named: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        StreamChannels.of("stream 7", labels, units)
    assert named in str(caught.value)
    assert "stream 7" in str(caught.value)


def test_unknown_declaration() -> None:
    with pytest.raises(UnknownNameError, match="quaternion_ordr"):
        StreamChannels.of("s", ["qw", "qx", "qy", "qz"], declared={"quaternion_ordr": "xyzw"})


def test_points() -> None:
    labels = ["LeftKnee_x", "LeftKnee_y", "LeftKnee_confidence", "Nose_y", "Nose_x", "frame"]
    channels = PointChannels.of("s", labels, ["px", "pixels", "", "", "", ""])
    assert channels.names == ("LeftKnee", "Nose")
    uv, confidence = channels.points(np.array([[1, 2, 0.5, 4, 3, 9], [1, 2, 0, 4, np.nan, 9.0]]))
    np.testing.assert_array_equal(uv, [[[1, 2], [3, 4]], [[np.nan] * 2, [np.nan] * 2]])
    np.testing.assert_array_equal(confidence, [[0.5, 1], [0, 0]])


@pytest.mark.parametrize(
    ("labels", "units", "named"),
    [
        (["frame"], [], "landmark"),
        (["Nose_x", "Nose_confidence"], [], "Nose_y"),
        (["Nose_x", "Nose_x"], [], "Nose"),
        (["Nose_x", "Nose_y"], ["m", "m"], "px"),
    ],
)
def test_refused_points(labels: list[str], units: list[str], named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        PointChannels.of("s", labels, units)
