"""Range of motion and angular velocity of planted movements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from clinical_support import limb, posture
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.range_of_motion import RangeOfMotion, angular_velocity, ranges_of_motion
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
T = 240
TIMES = np.arange(T) / 60


def swinging_knee() -> ClinicalAngles:
    """The right knee between 10 and 70 degrees, once in two seconds."""
    flexion = np.radians(40 - 30 * np.cos(np.pi * TIMES))
    return clinical_angles(posture(BODY, T, **limb("right", ("shank", "foot"), so3.about_axis("y", flexion))), BODY)


def of(angles: ClinicalAngles, name: str) -> RangeOfMotion:
    return next(r for r in ranges_of_motion(angles) if r.name == name)


def test_range_and_velocity_of_a_planted_swing() -> None:
    knee = of(swinging_knee(), "right_knee_flexion")
    assert np.degrees([knee.low, knee.high, knee.mean]) == pytest.approx([10, 70, 40], abs=0.2)
    assert np.degrees(knee.range) == pytest.approx(60, abs=0.1)
    assert knee.time_high == pytest.approx(1.0)
    assert np.degrees(knee.peak_velocity) == pytest.approx(30 * np.pi, rel=0.01)
    assert knee.known_share == 1
    assert knee.singular_share == 0
    angles = swinging_knee()
    velocity = angular_velocity(angles, angles.names.index("right_knee_flexion"))
    expected = np.radians(30) * np.pi * np.sin(np.pi * TIMES)
    np.testing.assert_allclose(velocity[12:-12], expected[12:-12], atol=0.01)


def test_noise_is_filtered_before_it_is_differentiated() -> None:
    angles = swinging_knee()
    noisy = replace(angles, values=angles.values + np.random.default_rng(0).normal(0, 0.01, (T, 51)))
    column = angles.names.index("left_hip_flexion")
    filtered = angular_velocity(noisy, column)
    raw = np.gradient(noisy.values[:, column], TIMES)
    assert filtered.std() < 0.3 * raw.std()


def test_velocity_does_not_reach_across_gaps() -> None:
    angles = swinging_knee()
    values = np.array(angles.values)
    values[100:110] = np.nan
    values[110:] += 1.0
    values[200:210:2] = np.nan
    broken = replace(angles, values=values)
    column = angles.names.index("right_knee_flexion")
    velocity = angular_velocity(broken, column)
    assert np.isnan(velocity[100:110]).all()
    assert np.isnan(velocity[201:209]).all()  # single frames have none
    assert np.nanmax(np.abs(velocity)) < 2.2
    assert of(broken, "right_knee_flexion").known_share == pytest.approx(225 / 240)


def test_unobserved_angles_have_no_range() -> None:
    angles = swinging_knee()
    values = np.array(angles.values)
    values[:, angles.names.index("left_wrist_flexion")] = np.nan
    wrist = of(replace(angles, values=values), "left_wrist_flexion")
    assert np.isnan([wrist.low, wrist.high, wrist.range, wrist.peak_velocity]).all()
    assert wrist.known_share == 0


def test_singular_angles_have_no_range() -> None:
    """The plane of elevation of hanging arms is undefined."""
    plane = of(swinging_knee(), "right_shoulder_plane_of_elevation")
    assert np.isnan(plane.range)
    assert plane.known_share == 1
    assert plane.singular_share == 1
    assert of(swinging_knee(), "right_shoulder_elevation").high == pytest.approx(0, abs=1e-9)


def with_sigma(degrees: Array | float, noise: Array | float = 0.0) -> ClinicalAngles:
    angles = swinging_knee()
    sigma = np.broadcast_to(np.radians(degrees), (T,))[:, None] * np.ones(len(angles.rows))
    values = angles.values + np.broadcast_to(noise, (T,))[:, None]
    return replace(angles, values=values, sigma=np.where(angles.known, sigma, np.nan))


def test_a_range_has_the_deviations_of_its_two_ends() -> None:
    growing = np.linspace(1, 4, T)
    knee = of(with_sigma(growing), "right_knee_flexion")
    low, high = (np.interp(t, TIMES, growing) for t in (knee.time_low, knee.time_high))
    assert np.degrees([knee.low_sigma, knee.high_sigma]) == pytest.approx([low, high])
    assert np.degrees(knee.range_sigma) == pytest.approx(np.hypot(low, high))
    plain = of(swinging_knee(), "right_knee_flexion")
    assert np.isnan([plain.low_sigma, plain.high_sigma, plain.range_sigma]).all()


def test_planted_errors_stay_within_the_bands_of_a_range() -> None:
    """Half of the variance is a bias, which cancels in a range, the other half is correlated over 0.3 s."""
    sigma, inside = 3.0, []
    rng = np.random.default_rng(0)
    for seed in range(60):
        error = rng.normal(0, 1) + planted.smooth_noise(seed, (T,), 18, 1.0)
        noisy = with_sigma(sigma, np.radians(sigma / np.sqrt(2) * error))
        (knee,) = ranges_of_motion(noisy.select(["right_knee_flexion"]))
        inside.append(abs(np.degrees(knee.range) - 60) < 1.96 * np.degrees(knee.range_sigma))
    assert np.mean(inside) >= 0.9


def test_headings_are_marked_as_no_range_of_motion() -> None:
    headings = {row.name for row in ranges_of_motion(swinging_knee()) if row.about_vertical}
    assert headings == {"pelvis_rotation", "pelvis_opensim_rotation"}


def with_uncertain_deepest(degrees: float = 40.0) -> ClinicalAngles:
    """The knee's swing with a standard deviation of 2 deg, where it is above 60 deg of so many."""
    angles = with_sigma(2.0)
    column = angles.names.index("right_knee_flexion")
    deep = np.degrees(angles.values[:, column]) > 60
    sigma, trusted = np.array(angles.sigma), np.ones(angles.values.shape, dtype=bool)
    sigma[deep, column], trusted[deep, column] = np.radians(degrees), False
    return replace(angles, sigma=sigma, trusted=trusted)


def test_frames_with_wide_bands_are_no_silent_end_of_a_range() -> None:
    knee = of(with_uncertain_deepest(), "right_knee_flexion")
    assert np.degrees(knee.range) == pytest.approx(49, abs=1)
    assert knee.uncertain_low is None
    assert knee.uncertain_high is not None
    assert np.degrees(knee.uncertain_high.value) == pytest.approx(70, abs=0.2)
    assert np.degrees(knee.uncertain_high.bound) == pytest.approx(70 + 1.96 * 40, abs=0.2)
    assert knee.text == f">= 49, the highest {knee.uncertain_high.seconds:.1f} s is uncertain (up to 70)"
    least, most = np.degrees(knee.range_interval)
    assert least < 49 < 60 < most
    assert np.degrees(knee.high_interval[1]) == pytest.approx(148.4, abs=0.2)
    assert knee.is_uncertain
    assert not knee.is_comparable


def test_a_certain_range_keeps_its_band_and_may_be_compared() -> None:
    knee = of(with_sigma(2.0), "right_knee_flexion")
    assert (knee.uncertain_low, knee.uncertain_high, knee.why_not_comparable) == (None, None, "")
    assert knee.is_comparable
    assert knee.text == "60 ± 6"
    assert np.degrees(knee.range_interval) == pytest.approx([60 - 5.54, 60 + 5.54], abs=0.1)
    assert of(swinging_knee(), "right_knee_flexion").text == "60"
    assert np.isnan(of(swinging_knee(), "right_knee_flexion").range_interval).all()


def test_unreliable_frames_inside_a_range_leave_it_certain() -> None:
    angles = with_sigma(2.0)
    column = angles.names.index("right_knee_flexion")
    trusted, sigma = np.ones(angles.values.shape, dtype=bool), np.array(angles.sigma)
    middle = np.abs(np.degrees(angles.values[:, column]) - 40) < 4
    trusted[middle, column], sigma[middle, column] = False, np.radians(15.0)
    knee = of(replace(angles, trusted=trusted, sigma=sigma), "right_knee_flexion")
    assert not knee.is_uncertain
    assert knee.trusted_share < 1
