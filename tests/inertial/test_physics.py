"""Planted physics passes the checks; every wrong declaration of it is found and named."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_support import moved, read_as

from rtof_kin.core.checks import Check, Verdict
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import CHOICES, Declaration, SensorLog, SensorStream
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial import laws
from rtof_kin.inertial.laws import fixed_axes, likely_rate
from rtof_kin.inertial.physics import LAWS, check_log

PLAIN = Declaration()
DATA = Path(__file__).parents[1] / "fixtures" / "inertial"
GYROSCOPE, DIRECTION, JUMP = laws.GYROSCOPE, laws.DIRECTION, "jump of the orientation"
ORIENTATION = ("R_inertial_sensor", "quaternion_norm")


def checked(*streams: SensorStream, declared: Declaration = PLAIN) -> tuple[Check, ...]:
    return check_log(SensorLog(Path("log"), "planted", streams, declared))


def failed(stream: SensorStream, declared: Declaration = PLAIN) -> dict[str, Check]:
    return {check.name: check for check in checked(stream, declared=declared) if check.failed}


def of(name: str, stream: SensorStream, declared: Declaration = PLAIN) -> Check:
    return next(check for check in checked(stream, declared=declared) if check.name == name)


def without(stream: SensorStream, *names: str) -> SensorStream:
    return replace(stream, **dict.fromkeys(names))


def truths(seed: int, count: int) -> list[Declaration]:
    """Declarations with gravity included, over all choices of the other fields."""
    every = [dict(zip(CHOICES, values, strict=True)) for values in product(*CHOICES.values())]
    every = [fields for fields in every if fields["gravity"] == "included"]
    rng = np.random.default_rng(seed)
    return [Declaration(**every[i]) for i in rng.choice(len(every), count, replace=False)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 200.0])
def test_correct_streams_pass(seed: int, rests: bool, rate_hz: float) -> None:
    checks = checked(moved(12.0, rate_hz, seed, rests))
    assert not [check for check in checks if check.failed]
    assert {c.name for c in checks if c.passed} >= {*LAWS, JUMP}


@pytest.mark.parametrize("means", truths(1, 8))
def test_correct_declarations_pass(means: Declaration) -> None:
    assert not failed(read_as(moved(), means, means), means)


@pytest.mark.parametrize(
    "absent",
    [("w_sensor",), ORIENTATION, ("f_sensor",), ("f_sensor", "w_sensor"), ("f_sensor", "w_sensor", *ORIENTATION)],
)
def test_missing_channels_give_unknown_checks(absent: tuple[str, ...]) -> None:
    checks = checked(without(moved(), *absent))
    assert not [check for check in checks if check.failed]
    unknown = [check for check in checks if check.verdict is Verdict.NOT_POSSIBLE]
    assert unknown
    assert all(check.advice and np.isnan(check.value) for check in unknown)


@pytest.mark.parametrize("T", [1, 2, 3, 12])
def test_a_few_samples_fail_nothing(T: int) -> None:
    s = moved(seconds=4.0)
    short = SensorStream("short", s.times[:T], s.f_sensor[:T], s.R_inertial_sensor[:T], s.w_sensor[:T])
    assert not failed(short)


@pytest.mark.parametrize(
    "name, value",
    [(name, value) for name in ("f_sensor", "w_sensor") for value in (np.nan, 0.0, 1e300)]
    + [("R_inertial_sensor", np.nan), ("R_inertial_sensor", np.eye(3))],
)
def test_damaged_or_constant_channels_fail(name: str, value: object) -> None:
    stream = moved(seconds=6.0)
    array = np.broadcast_to(value, getattr(stream, name).shape)
    assert failed(replace(stream, **{name: array}))


def test_a_constant_orientation_alone_fails_as_stuck() -> None:
    still = SensorStream("still", np.arange(300) / 60, None, np.tile(np.eye(3), (300, 1, 1)))
    assert list(failed(still)) == ["stuck values of orientation"]


def test_gaps_do_not_disturb_the_laws() -> None:
    stream = moved()
    keep = np.ones(len(stream), dtype=bool)
    keep[300:330] = keep[700:703] = False
    f, R = np.array(stream.f_sensor), np.array(stream.R_inertial_sensor)
    f[100:110], R[200:215] = np.nan, np.nan
    assert not failed(SensorStream("holed", stream.times[keep], f[keep], R[keep], stream.w_sensor[keep]))


@pytest.mark.parametrize("means", truths(2, 6))
@pytest.mark.parametrize("field", list(CHOICES))
def test_a_wrong_field_is_found_and_its_value_named(means: Declaration, field: str) -> None:
    for value in set(CHOICES[field]) - {getattr(means, field)}:
        declared = means.changed(**{field: value})
        checks = failed(read_as(moved(), means, declared), declared)
        likely = [dict(c.likely) for c in checks.values() if c.name in LAWS]
        assert likely, f"{field} = {value} is not found"
        assert all(change == {field: getattr(means, field)} for change in likely)


@pytest.mark.parametrize("field", [name for name in CHOICES if name != "quaternion_order"])
def test_a_wrong_field_is_found_without_quaternions(field: str) -> None:
    stream = without(moved(), "quaternion_norm")
    for value in CHOICES[field][1:]:
        declared = PLAIN.changed(**{field: value})
        checks = failed(read_as(stream, PLAIN, declared), declared).values()
        assert {tuple(c.likely.items()) for c in checks} == {((field, CHOICES[field][0]),)}


def test_two_wrong_fields_are_named_together() -> None:
    declared = Declaration("g", angular_unit="deg/s")
    checks = failed(read_as(moved(), PLAIN, declared), declared)
    expected = {"acceleration_unit": "m/s2", "angular_unit": "rad/s"}
    assert {"specific force", GYROSCOPE} <= set(checks)
    assert all(dict(c.likely) == expected for c in checks.values())


@pytest.mark.parametrize("unit", ["g", "mg"])
def test_the_size_of_gravity_determines_the_unit_without_orientation(unit: str) -> None:
    stream = without(moved(), *ORIENTATION)
    wrong = replace(stream, f_sensor=Declaration(unit).specific_force(stream.f_sensor))
    check = failed(wrong, Declaration(unit))["specific force"]
    assert dict(check.likely) == {"acceleration_unit": "m/s2"}


@pytest.mark.parametrize("rests", [True, False])
def test_removed_gravity_is_found(rests: bool) -> None:
    means = Declaration(gravity="removed")
    checks = failed(read_as(moved(rests=rests), means, PLAIN))
    assert checks
    assert all(dict(c.likely) == {"gravity": "removed"} for c in checks.values())
    direction = of(DIRECTION, read_as(moved(), means, means), means)
    assert direction.verdict is Verdict.NOT_POSSIBLE
    assert "gravity was removed" in direction.advice


def test_turning_determines_the_unit_without_gravity() -> None:
    declared = Declaration("g", "removed")
    checks = failed(read_as(moved(), Declaration("mg", "removed"), declared), declared)
    assert laws.LEVER in checks
    assert all(c.likely.get("acceleration_unit") == "mg" for c in checks.values() if c.likely)


def test_the_gyroscope_determines_a_wrong_rate() -> None:
    stream = moved(rate_hz=60.0)
    check = failed(replace(stream, times=stream.times[0] + np.arange(len(stream)) / 100))[GYROSCOPE]
    assert check.likely["rate_hz"] == pytest.approx(60.0, abs=0.5)
    assert "rate_hz = " in check.advice


def test_sensors_of_a_log_share_the_likely_declaration() -> None:
    declared = Declaration(quaternion_order="xyzw")
    streams = [read_as(moved(seed=seed, name=f"s{seed}"), PLAIN, declared) for seed in range(3)]
    checks = [check for check in checked(*streams, declared=declared) if check.failed]
    assert {check.subject for check in checks} == {"s0", "s1", "s2"}
    assert all(dict(check.likely) == {"quaternion_order": "wxyz"} for check in checks)
    odd = read_as(moved(name="odd"), PLAIN, Declaration("mg"))
    checks = [check for check in checked(moved(seed=1, name="good"), odd) if check.failed]
    assert {check.subject for check in checks} == {"odd"}


def test_noise_is_explained_by_no_declaration() -> None:
    stream = moved()
    R = Rotation.random(len(stream), rng=np.random.default_rng(0)).as_matrix()
    check = failed(replace(stream, R_inertial_sensor=R))[GYROSCOPE]
    assert not check.likely
    assert check.advice.endswith("No other declaration makes it hold")


def test_a_missing_orientation_is_refused_where_it_is_needed() -> None:
    with pytest.raises(InvalidInputError, match="orientation"):
        Declaration(gravity="removed").filed_acceleration(np.zeros((2, 3)))
    with pytest.raises(InvalidInputError, match="wrist has no orientation"):
        laws.rates_of_orientation(without(moved(), "R_inertial_sensor"))


def test_equally_likely_changes_are_all_named() -> None:
    """A level sensor at rest is the same for several declarations."""
    f = np.tile([0.0, 0.0, 9.81], (300, 1)) + np.random.default_rng(0).normal(0, 0.01, (300, 3))
    still = SensorStream("table", np.arange(300) / 60, f, np.tile(np.diag([1.0, -1.0, -1.0]), (300, 1, 1)))
    assert "inertial_axes = z down" in failed(still)[DIRECTION].advice


@pytest.mark.parametrize("late", [-12, -3, 2, 25])
def test_a_delay_of_the_gyroscope_is_found(late: int) -> None:
    stream = moved(noise=0.0)
    check = of("delay of the gyroscope", replace(stream, w_sensor=np.roll(stream.w_sensor, late, axis=0)))
    assert check.failed
    assert check.value == pytest.approx(abs(late), abs=0.1)
    assert ("after" if late > 0 else "before") in check.advice


def test_a_mean_rate_is_half_a_sample_late() -> None:
    stream = moved(noise=0.0)
    rate = np.array(stream.w_sensor)
    rate[1:] = (rate[1:] + rate[:-1]) / 2
    assert laws.delay(replace(stream, w_sensor=rate)) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    "axes, words",
    [
        ([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "are y, -x, z of"),
        (np.diag([1, 1, -1]), "are x, y, -z of"),
        ([[0, 1, 0], [1, 0, 0], [0, 0, 1]], "are y, x, z of"),
    ],
)
def test_permuted_and_mirrored_axes_of_the_gyroscope_are_named(axes: object, words: str) -> None:
    stream = moved()
    check = failed(replace(stream, w_sensor=stream.w_sensor @ np.array(axes, dtype=float).T))[GYROSCOPE]
    assert words in check.advice
    assert not check.likely


def test_a_constant_rotation_of_the_orientation_is_found() -> None:
    stream, R = moved(), Rotation.from_rotvec([0.9, -1.1, 0.4])
    segment = replace(stream, R_inertial_sensor=stream.R_inertial_sensor @ R.as_matrix())
    fixed = fixed_axes(segment)
    off = R.inv() * Rotation.from_matrix(fixed[0])
    assert np.degrees(off.magnitude()) < 1.0
    assert not failed(replace(segment, R_inertial_sensor=segment.R_inertial_sensor @ fixed[0].T))
    check = failed(segment)[DIRECTION]
    assert f"by a constant {np.degrees(R.magnitude()):.0f}"[:-1] in check.advice
    assert check.advice.endswith("with that rotation gravity points up")


def test_a_rotation_and_other_reference_axes_are_named_together() -> None:
    turn = Rotation.from_rotvec([0, 1, 1]).as_matrix()
    turned = replace(moved(), R_inertial_sensor=moved().R_inertial_sensor @ turn)
    check = failed(read_as(turned, Declaration(inertial_axes="y up"), PLAIN))[DIRECTION]
    assert check.advice.endswith("with that rotation, and inertial_axes = y up, gravity points up")


def test_turning_about_one_axis_determines_no_rotation() -> None:
    T = np.arange(600) / 60
    R = Rotation.from_rotvec(np.outer(np.sin(3 * T), [0, 0, 1]))
    w = np.stack([3 * np.cos(3 * T), 0 * T, 0 * T], axis=-1)
    hinge = SensorStream("hinge", T, None, R.as_matrix(), w)
    assert fixed_axes(hinge) is None
    assert likely_rate(hinge) is None
    assert GYROSCOPE in failed(hinge)


def test_a_filter_reset_is_a_jump_only() -> None:
    stream = moved()
    R = np.array(stream.R_inertial_sensor)
    R[700:] = Rotation.from_euler("z", 30, degrees=True).as_matrix() @ R[700:]
    checks = failed(replace(stream, R_inertial_sensor=R))
    assert list(checks) == [JUMP]
    assert checks[JUMP].value == pytest.approx(30, abs=2)
    assert checks[JUMP].advice.startswith("1 of ")


def test_quaternions_without_unit_norm_fail() -> None:
    norm = np.ones(len(moved()))
    norm[17] = 1.2
    ((name, check),) = failed(replace(moved(), quaternion_norm=norm)).items()
    assert name.startswith("norm of quaternions")
    assert check.value == pytest.approx(0.2)
    assert "sample 17" in check.advice


def test_rests_are_independent_of_the_declaration() -> None:
    stream = moved()
    expected = laws.at_rest(stream)
    assert 0.2 < expected.mean() < 0.8
    for declared in truths(3, 10):
        np.testing.assert_array_equal(laws.at_rest(read_as(stream, PLAIN, declared)), expected)


def test_rates_of_the_orientation_are_those_at_the_middle_of_the_steps() -> None:
    stream = moved(noise=0.0)
    times, w = laws.rates_of_orientation(stream)
    expected = (stream.w_sensor[1:] + stream.w_sensor[:-1]) / 2
    np.testing.assert_allclose(times, (stream.times[1:] + stream.times[:-1]) / 2)
    assert np.sqrt(np.mean((w - expected) ** 2)) < 0.03
    arm = float(of(laws.LEVER, stream).advice.split()[-2])
    assert 0.15 < arm < 0.6


def test_an_accelerometer_scale_error_fails() -> None:
    stream = moved()
    check = failed(replace(stream, f_sensor=1.08 * stream.f_sensor))["specific force"]
    assert check.value == pytest.approx(0.08 * 9.81, abs=0.1)
    assert "at rest" in check.advice


@pytest.mark.parametrize("name", ["hipose_mtw17", "opensense_mtw8", "xio_lowerbody"])
def test_real_excerpts_obey_the_laws(name: str) -> None:
    checks = [check for check in check_log(read_sensor_log(DATA / name)) if check.name in LAWS]
    assert not [check.message for check in checks if check.failed]
    assert sum(check.passed for check in checks) >= 2


def test_real_free_acceleration_is_recognised() -> None:
    checks = check_log(read_sensor_log(DATA / "xsens_dot_as_mtw"))
    likely = [dict(c.likely) for c in checks if c.failed and c.name == laws.FORCE]
    assert likely
    assert likely[-1] == {"gravity": "removed"}


def test_real_orientations_of_segments_are_recognised() -> None:
    """In this recording orientations are of the body's segments, gyroscopes in the sensors' axes."""
    checks = [c for c in check_log(read_sensor_log(DATA / "qmt_walking")) if c.name == GYROSCOPE]
    assert all(c.failed and c.advice.endswith("with that rotation gravity points up") for c in checks)
    assert "x, y, z are y, -z, -x of the orientation's axes" in checks[1].advice


STREAM = moved()
RATE, LOST, JITTER = "rate against the declared one", "samples lost", "jitter of time stamps"
FIELD = "disturbed magnetic field"


def kept(keep: NDArray[np.bool_]) -> SensorStream:
    s = STREAM
    return SensorStream(s.name, s.times[keep], s.f_sensor[keep], s.R_inertial_sensor[keep], s.w_sensor[keep])


def test_a_correct_stream_passes() -> None:
    check = of(RATE, STREAM)
    assert check.verdict is Verdict.NOT_POSSIBLE
    assert "60 Hz" in check.advice
    assert not failed(replace(STREAM, times=np.round(STREAM.times, 3)), Declaration(rate_hz=60.0))
    assert not failed(STREAM, Declaration(rate_hz=60.2))


def test_a_wrong_declared_rate_is_found() -> None:
    check = of(RATE, STREAM, Declaration(rate_hz=100.0))
    assert check.failed
    assert check.value == pytest.approx(40.0, abs=0.01)
    assert dict(check.likely) == {"rate_hz": 60.0}


def test_times_of_arrival_are_jitter() -> None:
    late = np.sort(STREAM.times + np.random.default_rng(0).exponential(0.02, len(STREAM)))
    assert JITTER in failed(replace(STREAM, times=late))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
def test_lost_packets_are_counted(share: float) -> None:
    keep = np.random.default_rng(1).random(len(STREAM)) > share
    check = failed(kept(keep))[LOST]
    assert check.value == pytest.approx(100 * np.mean(~keep), abs=0.5)
    assert of(JITTER, kept(keep)).passed


def test_the_longest_gap_is_named() -> None:
    keep = np.ones(len(STREAM), dtype=bool)
    keep[300:420] = False
    advice = of(LOST, kept(keep)).advice
    assert advice.startswith("120 of ")
    assert "the longest gap is 2.02 s" in advice


def test_missing_stuck_and_constant_channels_are_found() -> None:
    f, w = np.array(STREAM.f_sensor), np.array(STREAM.w_sensor)
    f[::10, 1] = np.nan
    w[200:260] = w[200]
    checks = {check.name: check for check in checked(replace(STREAM, f_sensor=f, w_sensor=w))}
    assert checks["missing samples of acceleration"].value == pytest.approx(10, abs=0.1)
    assert checks["missing samples of acceleration"].failed
    assert checks["stuck values of gyroscope"].value == pytest.approx(59 / 60)
    assert "from 13.3" in checks["stuck values of gyroscope"].advice
    assert checks["stuck values of acceleration"].passed
    w[:, 2] = 0.0
    check = of("stuck values of gyroscope", replace(STREAM, w_sensor=w))
    assert check.failed
    assert check.advice == "Component z never changes"


@pytest.mark.parametrize("declared", [PLAIN, Declaration("g"), Declaration(gravity="removed")])
def test_saturation_is_found_in_the_axes_of_the_file(declared: Declaration) -> None:
    a = declared.filed_acceleration(STREAM.f_sensor, STREAM.R_inertial_sensor)
    limit = np.percentile(np.abs(a), 99)
    clipped = declared.specific_force(np.clip(a, -limit, limit), STREAM.R_inertial_sensor)
    assert "saturated samples of acceleration" in failed(replace(STREAM, f_sensor=clipped), declared)


def test_saturation_is_the_share_of_samples_at_the_ends_of_the_range() -> None:
    w = np.clip(STREAM.w_sensor, -5.0, 5.0)
    check = of("saturated samples of gyroscope", replace(STREAM, w_sensor=w))
    assert check.failed
    beyond = np.abs(STREAM.w_sensor).max(axis=1) > 5.0
    assert check.value == pytest.approx(100 * np.mean(beyond), abs=1)


def test_iron_disturbs_the_field_and_rotation_does_not() -> None:
    m = np.einsum("tji,j->ti", STREAM.R_inertial_sensor, [0.4, 0.0, -0.7])
    assert FIELD not in failed(replace(STREAM, m_sensor=m))
    near = np.array(m)
    near[:300] *= 1.5
    assert FIELD in failed(replace(STREAM, m_sensor=near))
    absent = of(FIELD, replace(STREAM, m_sensor=np.full_like(m, np.nan)))
    assert absent.verdict is Verdict.NOT_POSSIBLE


def test_one_sample_has_no_rate() -> None:
    one = SensorStream("one", np.array([0.0]), np.array([[0.0, 0.0, 9.81]]))
    assert of(LOST, one).verdict is Verdict.NOT_POSSIBLE
    assert not failed(one)
