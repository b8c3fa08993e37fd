"""Pooled errors of joint angles against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from comparison_support import angles_of

from rtof_kin.clinical.angle_errors import (
    ALL,
    AngleDifferences,
    AngleErrors,
    angle_differences,
    angle_errors,
    error_rows,
)

RNG = np.random.default_rng(3)
CURVES = {
    ("left_knee_flexion", "walk", "a"): np.radians(RNG.normal(2.0, 3.0, 50)),
    ("right_knee_flexion", "walk", "a"): np.radians(RNG.normal(-1.0, 2.0, 40)),
    ("right_knee_flexion", "squat", "b"): np.radians(RNG.normal(5.0, 1.0, 30)),
    ("spine_flexion", "squat", "b"): np.radians(RNG.normal(0.0, 4.0, 30)),
}
"""Angle, movement, take -> differences."""
DIFFERENCES = [AngleDifferences(*labels, curve) for labels, curve in CURVES.items()]


def row(rows: tuple[AngleErrors, ...], angle: str, movement: str) -> AngleErrors:
    (found,) = [one for one in rows if (one.angle, one.movement) == (angle, movement)]
    return found


def test_every_metric_is_the_closed_form_of_its_pooled_samples() -> None:
    found = row(error_rows(DIFFERENCES, ["squat", "walk"]), "knee_flexion", ALL)
    own = [curve for (angle, _, _), curve in CURVES.items() if "knee" in angle]
    d = np.concatenate(own)
    assert (found.takes, found.samples) == (2, 120)
    assert found.rmse == pytest.approx(np.sqrt(np.mean(d**2)))
    assert found.mae == pytest.approx(np.abs(d).mean())
    assert found.median == pytest.approx(np.median(np.abs(d)))
    assert found.offset == pytest.approx(d.mean())
    variances = np.average([c.var() for c in own], weights=[len(c) for c in own])
    assert found.offset_removed == pytest.approx(np.sqrt(variances))
    assert np.isnan(found.within)


def test_rows_are_everything_then_classes_then_angles() -> None:
    labels = [(one.angle, one.movement) for one in error_rows(DIFFERENCES, ["walk", "squat", "arms"])]
    assert labels == [
        (ALL, ALL),
        (ALL, "walk"),
        (ALL, "squat"),
        ("knee_flexion", ALL),
        ("knee_flexion", "walk"),
        ("knee_flexion", "squat"),
        ("spine_flexion", ALL),
        ("spine_flexion", "squat"),
    ]


def test_one_curve_has_the_standard_deviation_without_its_offset() -> None:
    one = angle_errors(DIFFERENCES[:1])
    assert one.offset_removed == pytest.approx(next(iter(CURVES.values())).std())


def test_bands_that_are_right_hold_95_percent_of_the_samples() -> None:
    sigma = RNG.uniform(0.01, 0.1, 40_000)
    right = AngleDifferences("spine_flexion", "walk", "a", sigma * RNG.standard_normal(40_000), sigma)
    assert angle_errors([right]).within == pytest.approx(0.95, abs=0.004)
    # Curves without bands count in the errors, not in the share.
    assert angle_errors([right, *DIFFERENCES]).within == angle_errors([right]).within


def test_differences_have_the_sign_of_the_estimate_and_the_shift_is_of_the_reference() -> None:
    times = np.arange(0, 4, 0.02)
    curve = 30 * np.sin(3 * times)
    estimate = angles_of(times, {"left_knee_flexion": curve + 4.0}, sigma=5.0)
    late = angles_of(times + 0.5, {"left_knee_flexion": curve})
    (found,), left_out = angle_differences(estimate, late, "walk", "a", shift=-0.5)
    np.testing.assert_allclose(np.degrees(found.difference), 4.0, atol=1e-9)
    assert found.sigma is not None
    np.testing.assert_allclose(np.degrees(found.sigma), 5.0)
    assert angle_errors([found]).within == 1.0
    assert left_out == {}


def test_what_cannot_be_compared_is_left_out_with_its_reason() -> None:
    times = np.arange(0, 2, 0.02)
    moving = 10 * np.sin(times)
    estimate = angles_of(times, {"left_knee_flexion": moving, "spine_flexion": moving, "pelvis_tilt": moving})
    reference = angles_of(
        times,
        {
            "left_knee_flexion": moving,
            "spine_flexion": 0.0,
            "pelvis_opensim_rotation": moving,
            "right_knee_flexion": moving,
            "left_hip_flexion": np.nan,
        },
    )
    found, left_out = angle_differences(estimate, reference, "walk", "a")
    assert [one.angle for one in found] == ["left_knee_flexion"]
    assert left_out == {
        "spine_flexion": "does not move in the reference: its model holds it fixed",
        "pelvis_opensim_rotation": "depends on the direction of the world's axes",
        "right_knee_flexion": "not observed in the estimate",
        "left_hip_flexion": "not in the reference",
    }
