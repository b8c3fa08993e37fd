"""Planted physics obeys the laws, every wrong declaration of it is found and rightly named."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_support import moved, read_as

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.plausibility import Check, Verdict
from rtof_kin.data.imu_declaration import CHOICES, Declaration
from rtof_kin.data.imu_stream import SensorLog, SensorStream
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial import gravity, turning
from rtof_kin.inertial.alternatives import fixed_axes, likely_changes, likely_rate, redeclared
from rtof_kin.inertial.physics import LAWS, check_log, check_stream

PLAIN = Declaration()
DATA = Path(__file__).parents[1] / "fixtures" / "inertial"
OF_MATRICES = [name for name in CHOICES if name != "quaternion_order"]


def failed(checks: tuple[Check, ...]) -> dict[str, Check]:
    return {check.name: check for check in checks if check.failed}


def of(name: str, stream: SensorStream, declared: Declaration = PLAIN) -> Check:
    return next(check for check in check_stream(stream, declared) if check.name == name)


def without(stream: SensorStream, *names: str) -> SensorStream:
    return replace(stream, **dict.fromkeys(names))


def truths(seed: int, count: int) -> list[Declaration]:
    """Declarations with gravity in the data, every choice of every field among them."""
    every = [
        dict(zip(CHOICES, values, strict=True))
        for values in product(*CHOICES.values())
        if values[1] == "included"
    ]
    rng = np.random.default_rng(seed)
    return [Declaration(**every[i]) for i in rng.choice(len(every), count, replace=False)]


# --- good data -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 200.0])
def test_what_obeys_physics_passes_at_rest_and_in_motion(seed: int, rests: bool, rate_hz: float) -> None:
    checks = check_stream(moved(12.0, rate_hz, seed, rests), PLAIN)
    assert not failed(checks)
    assert {c.name for c in checks if c.passed} >= {*LAWS, "jump of the orientation"}


@pytest.mark.parametrize("means", truths(1, 8))
def test_what_is_rightly_declared_passes_whatever_it_is(means: Declaration) -> None:
    assert not failed(check_stream(read_as(moved(), means, means), means))


@pytest.mark.parametrize(
    "absent",
    [("w_sensor",), ("R_inertial_sensor", "quaternion_norm"), ("f_sensor",), ("f_sensor", "w_sensor"),
     ("f_sensor", "w_sensor", "R_inertial_sensor", "quaternion_norm")],
)  # fmt: skip
def test_what_is_not_measured_cannot_be_told_and_does_not_fail(absent: tuple[str, ...]) -> None:
    checks = check_stream(without(moved(), *absent), PLAIN)
    assert not failed(checks)
    unknown = [check for check in checks if check.verdict is Verdict.NOT_POSSIBLE]
    assert unknown
    assert all(check.advice and np.isnan(check.value) for check in unknown)


@pytest.mark.parametrize("T", [1, 2, 3, 12])
def test_a_few_samples_fail_nothing(T: int) -> None:
    whole = moved(seconds=4.0)
    short = SensorStream(
        "short", whole.times[:T], whole.f_sensor[:T], whole.R_inertial_sensor[:T],
        whole.w_sensor[:T], None, whole.quaternion_norm[:T],
    )  # fmt: skip
    assert not failed(check_stream(short, PLAIN))


@pytest.mark.parametrize("value", [np.nan, 0.0, 1e300])
@pytest.mark.parametrize("name", ["f_sensor", "w_sensor"])
def test_damaged_numbers_give_a_verdict_and_no_warning(name: str, value: float) -> None:
    stream = moved(seconds=6.0)
    array = np.full((len(stream), 3), value)
    assert failed(check_stream(replace(stream, **{name: array}), PLAIN))


@pytest.mark.parametrize("value", [np.nan, np.eye(3)])
def test_orientations_that_are_missing_or_never_change_give_a_verdict(value: object) -> None:
    R = np.broadcast_to(value, moved().R_inertial_sensor.shape)
    assert failed(check_stream(replace(moved(), R_inertial_sensor=R), PLAIN))


def test_a_log_of_orientations_that_never_move_fails_only_by_being_stuck() -> None:
    T = np.arange(300) / 60
    still = SensorStream("still", T, None, np.tile(np.eye(3), (300, 1, 1)))
    assert list(failed(check_stream(still, PLAIN))) == ["stuck values of orientation"]


def test_gaps_and_missing_samples_do_not_disturb_the_laws() -> None:
    stream = moved()
    keep = np.ones(len(stream), dtype=bool)
    keep[300:330] = keep[700:703] = False
    f, R = np.array(stream.f_sensor), np.array(stream.R_inertial_sensor)
    f[100:110], R[200:215] = np.nan, np.nan
    holed = SensorStream(
        "holed", stream.times[keep], f[keep], R[keep], stream.w_sensor[keep], None, np.ones(keep.sum())
    )
    assert not failed(check_stream(holed, PLAIN))


# --- wrong declarations --------------------------------------------------------------------------


@pytest.mark.parametrize("means", truths(2, 6))
@pytest.mark.parametrize("field", list(CHOICES))
def test_one_wrong_field_is_found_and_the_right_value_named(means: Declaration, field: str) -> None:
    for value in CHOICES[field]:
        if value == getattr(means, field):
            continue
        declared = means.changed(**{field: value})
        checks = check_stream(read_as(moved(), means, declared), declared)
        likely = [dict(c.likely) for c in checks if c.failed and c.name in LAWS]
        assert likely, f"{field} = {value} is not noticed"
        assert all(change == {field: getattr(means, field)} for change in likely)


@pytest.mark.parametrize("field", OF_MATRICES)
def test_files_of_matrices_are_read_otherwise_too(field: str) -> None:
    stream = without(moved(), "quaternion_norm")
    for value in CHOICES[field][1:]:
        declared = PLAIN.changed(**{field: value})
        checks = check_stream(read_as(stream, PLAIN, declared), declared)
        likely = {tuple(c.likely.items()) for c in checks if c.failed}
        assert likely == {((field, CHOICES[field][0]),)}


def test_two_wrong_fields_are_named_together() -> None:
    declared = Declaration("g", angular_unit="deg/s")
    checks = failed(check_stream(read_as(moved(), PLAIN, declared), declared))
    expected = {"acceleration_unit": "m/s2", "angular_unit": "rad/s"}
    assert {"specific force", "gyroscope against orientation"} <= set(checks)
    assert all(dict(c.likely) == expected for c in checks.values())


def test_without_orientation_the_size_of_gravity_tells_the_unit() -> None:
    stream = without(moved(), "R_inertial_sensor", "quaternion_norm")
    for unit in ("g", "mg"):
        wrong = replace(stream, f_sensor=Declaration(unit).specific_force(stream.f_sensor))
        check = failed(check_stream(wrong, Declaration(unit)))["specific force"]
        assert dict(check.likely) == {"acceleration_unit": "m/s2"}


def test_gravity_that_was_removed_is_noticed_at_rest_and_in_motion() -> None:
    for rests in (True, False):
        means = Declaration(gravity="removed")
        checks = failed(check_stream(read_as(moved(rests=rests), means, PLAIN), PLAIN))
        assert checks
        assert all(dict(c.likely) == {"gravity": "removed"} for c in checks.values())


def test_where_gravity_was_removed_its_direction_cannot_be_told() -> None:
    means = Declaration(gravity="removed")
    direction = of("direction of gravity", read_as(moved(), means, means), means)
    assert direction.verdict is Verdict.NOT_POSSIBLE
    assert direction.advice == "gravity was removed, so that no direction of it is left"


def test_where_gravity_was_removed_turning_still_tells_a_wrong_unit() -> None:
    means = Declaration("mg", "removed")
    checks = failed(check_stream(read_as(moved(), means, Declaration("g", "removed")),
                                 Declaration("g", "removed")))  # fmt: skip
    assert "acceleration against turning" in checks
    assert "m" in checks["acceleration against turning"].advice
    assert all(c.likely.get("acceleration_unit") == "mg" for c in checks.values() if c.likely)


def test_a_wrong_rate_is_told_by_the_gyroscope() -> None:
    stream = moved(rate_hz=60.0)
    wrong = replace(stream, times=stream.times[0] + np.arange(len(stream)) / 100)
    checks = failed(check_stream(wrong, PLAIN))
    check = checks["gyroscope against orientation"]
    assert check.likely["rate_hz"] == pytest.approx(60.0, abs=0.5)
    assert "It would hold with rate_hz = " in check.advice


def test_all_sensors_of_a_log_are_judged_together() -> None:
    """One that hardly turns cannot tell the order of its quaternions, the others can."""
    declared = Declaration(quaternion_order="xyzw")
    streams = [moved(seed=seed, name=f"s{seed}") for seed in range(3)]
    log = SensorLog(Path("log"), "planted", tuple(read_as(s, PLAIN, declared) for s in streams), declared)
    checks = [check for check in check_log(log) if check.failed]
    assert {check.subject for check in checks} == {"s0", "s1", "s2"}
    assert all(dict(check.likely) == {"quaternion_order": "wxyz"} for check in checks)


def test_one_odd_sensor_does_not_blame_the_declaration_of_the_others() -> None:
    odd = read_as(moved(name="odd"), PLAIN, Declaration("mg"))
    log = SensorLog(Path("log"), "planted", (moved(seed=1, name="good"), odd), PLAIN)
    checks = [check for check in check_log(log) if check.failed]
    assert {check.subject for check in checks} == {"odd"}


def test_what_no_declaration_explains_is_said_so() -> None:
    rng = np.random.default_rng(0)
    stream = moved()
    noise = replace(stream, R_inertial_sensor=Rotation.random(len(stream), rng=rng).as_matrix())
    check = failed(check_stream(noise, PLAIN))["gyroscope against orientation"]
    assert not check.likely
    assert check.advice.endswith("No other declaration makes it hold")


def test_redeclaring_is_the_same_as_reading_again() -> None:
    stream = moved(seconds=5.0)
    for means, declared, other in zip(truths(5, 6), truths(6, 6), truths(7, 6), strict=True):
        again = redeclared(read_as(stream, means, declared), declared, other)
        expected = read_as(stream, means, other)
        np.testing.assert_allclose(again.R_inertial_sensor, expected.R_inertial_sensor, atol=1e-9)
        np.testing.assert_allclose(again.f_sensor, expected.f_sensor, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(again.w_sensor, expected.w_sensor, rtol=1e-9)


def test_accelerations_made_with_an_orientation_are_undone_with_one() -> None:
    with pytest.raises(InvalidInputError, match="were made with an orientation; give it"):
        Declaration(gravity="removed").filed_acceleration(np.zeros((2, 3)))
    with pytest.raises(InvalidInputError, match="wrist has no orientation to differentiate"):
        turning.rates_of_orientation(without(moved(), "R_inertial_sensor"))


def test_several_changes_that_cannot_be_told_apart_are_all_named() -> None:
    """A sensor that lies still, level and turned to no direction reads the same either way."""
    T = 300
    f = np.tile([0.0, 0.0, 9.81], (T, 1)) + np.random.default_rng(0).normal(0, 0.01, (T, 3))
    R = np.tile(np.diag([1.0, -1.0, -1.0]), (T, 1, 1))
    still = SensorStream("table", np.arange(T) / 60, f, R)
    changes = likely_changes([still], PLAIN)
    assert {"inertial_axes": "z down"} in changes
    check = failed(check_stream(still, PLAIN))["direction of gravity"]
    assert "inertial_axes = z down" in check.advice


# --- what else is wrong --------------------------------------------------------------------------


@pytest.mark.parametrize("late", [-12, -3, 2, 25])
def test_a_delay_of_the_gyroscope_is_found_in_samples(late: int) -> None:
    stream = moved(noise=0.0)
    shifted = replace(stream, w_sensor=np.roll(stream.w_sensor, late, axis=0))
    check = of("delay of the gyroscope", shifted)
    assert check.failed
    assert check.value == pytest.approx(abs(late), abs=0.1)
    assert ("after" if late > 0 else "before") in check.advice


def test_a_mean_rate_since_the_last_sample_is_half_a_sample_late_and_passes() -> None:
    stream = moved(noise=0.0)
    rate = np.array(stream.w_sensor)
    rate[1:] = (rate[1:] + rate[:-1]) / 2
    assert turning.delay(replace(stream, w_sensor=rate)) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    "axes, words",
    [
        (np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), "are y, -x, z of the orientation's axes"),
        (np.diag([1.0, 1, -1]), "are x, y, -z of the orientation's axes"),
        (np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]), "are y, x, z of the orientation's axes"),
    ],
)
def test_permuted_and_mirrored_axes_of_the_gyroscope_are_named(axes: np.ndarray, words: str) -> None:
    stream = moved()
    wrong = replace(stream, w_sensor=stream.w_sensor @ axes.T)
    check = failed(check_stream(wrong, PLAIN))["gyroscope against orientation"]
    assert words in check.advice
    assert not check.likely


def test_orientation_of_other_axes_is_recovered_as_one_rotation() -> None:
    stream = moved()
    R_sensor_segment = Rotation.from_rotvec([0.9, -1.1, 0.4])
    segment = replace(stream, R_inertial_sensor=stream.R_inertial_sensor @ R_sensor_segment.as_matrix())
    fixed = fixed_axes(segment)
    assert fixed is not None
    assert not fixed.mirrored
    off = R_sensor_segment.inv() * Rotation.from_matrix(fixed.R_sensor_oriented)
    assert np.degrees(off.magnitude()) < 1.0
    assert not failed(check_stream(fixed.applied(segment), PLAIN))
    check = failed(check_stream(segment, PLAIN))["direction of gravity"]
    degrees = np.degrees(R_sensor_segment.magnitude())
    assert f"by a constant {degrees:.0f}"[:-1] in check.advice
    assert check.advice.endswith("with that rotation gravity points up")


def test_a_rotation_and_other_reference_axes_are_named_together() -> None:
    turned = replace(
        moved(), R_inertial_sensor=moved().R_inertial_sensor @ Rotation.from_rotvec([0, 1, 1]).as_matrix()
    )
    wrong = read_as(turned, Declaration(inertial_axes="y up"), PLAIN)
    check = failed(check_stream(wrong, PLAIN))["direction of gravity"]
    assert check.advice.endswith("with that rotation, and inertial_axes = y up, gravity points up")


def test_turning_about_one_axis_tells_no_rotation_of_axes() -> None:
    T = np.arange(600) / 60
    R = Rotation.from_rotvec(np.outer(np.sin(3 * T), [0, 0, 1]))
    w = np.stack([3 * np.cos(3 * T), 0 * T, 0 * T], axis=-1)
    hinge = SensorStream("hinge", T, None, R.as_matrix(), w)
    assert fixed_axes(hinge) is None
    assert likely_rate(hinge) is None
    assert of("gyroscope against orientation", hinge).failed


def test_a_filter_that_is_reset_is_a_jump_and_does_not_spoil_the_rest() -> None:
    stream = moved()
    R = np.array(stream.R_inertial_sensor)
    R[700:] = Rotation.from_euler("z", 30, degrees=True).as_matrix() @ R[700:]
    checks = failed(check_stream(replace(stream, R_inertial_sensor=R), PLAIN))
    assert list(checks) == ["jump of the orientation"]
    assert checks["jump of the orientation"].value == pytest.approx(30, abs=2)
    assert checks["jump of the orientation"].advice.startswith("1 of ")


def test_quaternions_that_are_not_of_length_1_fail() -> None:
    norm = np.ones(len(moved()))
    norm[17] = 1.2
    check = failed(check_stream(replace(moved(), quaternion_norm=norm), PLAIN))
    assert list(check) == ["norm of quaternions, less 1"]
    assert check["norm of quaternions, less 1"].value == pytest.approx(0.2)
    assert "sample 17" in check["norm of quaternions, less 1"].advice


# --- the laws one by one -------------------------------------------------------------------------


def test_rests_are_the_same_under_every_declaration() -> None:
    stream = moved()
    expected = gravity.at_rest(stream)
    assert 0.2 < expected.mean() < 0.8
    for declared in truths(3, 10):
        np.testing.assert_array_equal(gravity.at_rest(read_as(stream, PLAIN, declared)), expected)


def test_turning_is_the_rate_at_the_middle_of_the_step() -> None:
    stream = moved(noise=0.0)
    times, w = turning.rates_of_orientation(stream)
    expected = (stream.w_sensor[1:] + stream.w_sensor[:-1]) / 2
    np.testing.assert_allclose(times, (stream.times[1:] + stream.times[:-1]) / 2)
    assert np.sqrt(np.mean((w - expected) ** 2)) < 0.03


def test_the_lever_arm_is_that_of_a_limb() -> None:
    stream = moved(noise=0.0)
    check = gravity.lever_arm(stream, gravity.turning_acceleration(stream))
    arm = float(check.advice.split()[-2])
    assert 0.15 < arm < 0.6


def test_a_bias_of_the_accelerometer_beyond_five_per_cent_fails() -> None:
    stream = moved()
    check = failed(check_stream(replace(stream, f_sensor=1.08 * stream.f_sensor), PLAIN))
    assert check["specific force"].value == pytest.approx(0.08 * 9.81, abs=0.1)
    assert "at rest" in check["specific force"].advice


# --- real recordings -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hipose_mtw17", "opensense_mtw8", "xio_lowerbody"])
def test_real_excerpts_obey_the_laws(name: str) -> None:
    checks = check_log(read_sensor_log(DATA / name))
    assert not [c.message for c in checks if c.failed and c.name in LAWS]
    assert sum(c.passed for c in checks if c.name in LAWS) >= 2


def test_free_acceleration_written_as_if_it_were_an_accelerometer_is_recognised() -> None:
    checks = failed(check_log(read_sensor_log(DATA / "xsens_dot_as_mtw")))
    assert dict(checks["specific force"].likely) == {"gravity": "removed"}


def test_orientations_of_segments_are_told_from_those_of_sensors() -> None:
    """In this recording quaternions are of the body's segments, gyroscopes in the sensors' axes."""
    checks = check_log(read_sensor_log(DATA / "qmt_walking"))
    of_gyroscope = [c for c in checks if c.name == turning.GYROSCOPE]
    assert all(c.failed for c in of_gyroscope)
    assert all(c.advice.endswith("with that rotation gravity points up") for c in of_gyroscope)
    assert "x, y, z are y, -z, -x of the orientation's axes" in of_gyroscope[1].advice
