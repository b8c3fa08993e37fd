"""Declarations bring a file's numbers to SI units; logs hand them to recordings."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtof_kin.errors import ShapeError, UnknownNameError
from rtof_kin.inertial.declaration import CHOICES, Declaration
from rtof_kin.inertial.streams import SensorLog, SensorStream

G = 9.81
UPRIGHT = {
    "z up": Rotation.identity(),
    "z down": Rotation.from_euler("x", 180, degrees=True),
    "y up": Rotation.from_euler("x", 90, degrees=True),
}


def planted(T: int = 12) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """Orientation in axes with z up, acceleration there, and specific force."""
    rng = np.random.default_rng(3)
    R = Rotation.random(T, rng=rng)
    a = rng.normal(0, 4, (T, 3))
    return R, a, R.inv().apply(a + np.array([0, 0, 9.81]))


@pytest.mark.parametrize(
    "unit, gravity, axes, order, maps, reference",
    list(product(*(CHOICES[k] for k in (
        "acceleration_unit", "gravity", "acceleration_axes", "quaternion_order", "orientation_maps",
        "inertial_axes",
    )))),
)  # fmt: skip
def test_what_is_declared_is_undone(
    unit: str, gravity: str, axes: str, order: str, maps: str, reference: str
) -> None:
    R, a, f = planted()
    d = Declaration(unit, gravity, axes, "rad/s", order, maps, reference)
    in_file = UPRIGHT[reference].inv() * R
    given = in_file if maps == "sensor to inertial" else in_file.inv()
    quat = given.as_quat(scalar_first=order == "wxyz")
    value = a + ([0, 0, 9.81] if gravity == "included" else [0, 0, 0])
    value = UPRIGHT[reference].inv().apply(value) if axes == "inertial" else R.inv().apply(value)
    value = value / {"m/s2": 1.0, "g": G, "mg": G / 1000}[unit]
    got = d.rotations(2.5 * quat)
    np.testing.assert_allclose(got, R.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(d.upright(given.as_matrix()), R.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(d.specific_force(value, got), f, atol=1e-9)


def test_degrees_per_second_become_radians_and_missing_quaternions_stay_missing() -> None:
    assert Declaration(angular_unit="deg/s").angular_velocity(np.array([[180.0, 0, 0]]))[0, 0] == np.pi
    R = Declaration().rotations(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0], [np.nan, 0, 0, 1]]))
    assert np.isfinite(R[0]).all()
    assert np.isnan(R[1:]).all()


def test_a_declaration_knows_its_values_and_what_it_cannot_do() -> None:
    with pytest.raises(UnknownNameError, match=r"acceleration unit 'G'.*Known: m/s2, g, mg"):
        Declaration(acceleration_unit="G")
    with pytest.raises(UnknownNameError, match=r"field of a declaration 'unit'"):
        Declaration().changed(unit="g")
    with pytest.raises(ShapeError, match="positive number of samples"):
        Declaration(rate_hz=0.0)
    with pytest.raises(ShapeError, match="log the raw accelerometer"):
        Declaration(gravity="removed").specific_force(np.zeros((2, 3)))
    assert Declaration().changed(gravity=None, acceleration_unit="g") == Declaration("g")


def stream(name: str, times: np.ndarray) -> SensorStream:
    R, _, f = planted(len(times))
    return SensorStream(name, times, f, R.as_matrix())


def log(*streams: SensorStream) -> SensorLog:
    return SensorLog(Path("walk"), "made here", streams, Declaration())


def test_sensors_with_the_same_times_leave_together() -> None:
    t = np.arange(12) / 60
    first, second = log(stream("a", t), stream("b", t + 0.004), stream("c", t)).imus()
    assert (first.names, second.names) == (("a", "c"), ("b",))
    np.testing.assert_array_equal(second.times, t + 0.004)
    np.testing.assert_array_equal(first.f_sensor[:, 1], planted()[2])


def test_a_log_selects_and_renames() -> None:
    t = np.arange(12) / 60
    both = log(stream("a", t), stream("b", t))
    assert both.select(["b"]).names == ("b",)
    assert both.renamed({"a": "pelvis"}).names == ("pelvis", "b")
    assert both.streams[0].rate_hz == pytest.approx(60)
    assert both.streams[0].holds == ("f_sensor", "R_inertial_sensor")
    with pytest.raises(UnknownNameError, match="sensor 'x'"):
        both.renamed({"x": "pelvis"})
    with pytest.raises(ShapeError, match="b"):
        both.renamed({"a": "b"})
    with pytest.raises(ShapeError, match="sensor a has no orientation"):
        SensorStream("a", t, f_sensor=np.zeros((12, 3))).imu()
    with pytest.raises(ShapeError, match=r"sensor a w_sensor.*\(12, 3\)"):
        SensorStream("a", t, w_sensor=np.zeros((11, 3)))
