"""The study of planted errors: planting is what `SelfCalibration.apply` undoes, rows and tables add up."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import planted as synthetic
import pytest
from numpy.typing import NDArray

from benchmarks.calibration import planting
from benchmarks.calibration.planting import ERRORS, Wrong
from rtof_kin.calibration_priors import CalibrationPriors
from rtof_kin.recording import Recording
from rtof_kin.self_calibration import BONE_GROUPS, Quantity, SelfCalibration
from rtof_kin.skeleton import SkeletonModel

Array = NDArray[np.float64]
SIZES = {name: error.size for name, error in ERRORS.items()}


@cache
def recording() -> Recording:
    body = SkeletonModel.default()
    return synthetic.recording(synthetic.human(body, 60), sigma_px=0.0, degrees=0.0)


def calibration(wrong: Wrong) -> SelfCalibration:
    """What a perfect calibration finds."""
    known = planting.unknowns(recording(), wrong)
    quantities = []
    for (kind, item), value in known.items():
        if (kind, item) != ("bones", "all"):
            ones = np.ones(len(value))
            quantities.append(Quantity(kind, item, value, ones, ones, 1.0))
    late = known["delay", "video"][0]
    return SelfCalibration(tuple(quantities), middle=planting.middle(recording().video.times) + late)


@pytest.mark.parametrize("chosen", [*((name,) for name in ERRORS), tuple(ERRORS)])
def test_a_perfect_calibration_takes_away_what_was_planted(chosen: tuple[str, ...]) -> None:
    right = recording()
    wrong = planting.drawn(right, {name: SIZES[name] for name in chosen}, seed=3)
    told = planting.planted(right, wrong)
    found = calibration(wrong)
    back = found.apply(told)
    assert right.truth is not None
    seen = found.moved(back.video, right.truth)
    np.testing.assert_allclose(seen.times, right.video.times, atol=1e-9)
    np.testing.assert_allclose(seen.uv_px, right.video.uv_px, atol=3.0 if "place" in chosen else 1e-6)
    np.testing.assert_allclose(back.video.camera.K, right.video.camera.K, rtol=1e-12)
    np.testing.assert_allclose(
        back.video.camera.R_camera_world, right.video.camera.R_camera_world, atol=1e-12
    )
    np.testing.assert_allclose(back.joint_offsets, right.joint_offsets, atol=1e-12)
    ours, theirs = back.bone_imus(times=right.imus.times), right.bone_imus(times=right.imus.times)  # type: ignore[union-attr]
    assert ours is not None
    assert theirs is not None
    np.testing.assert_allclose(ours.p_bone_sensor, theirs.p_bone_sensor, atol=1e-12)
    np.testing.assert_allclose(ours.R_world_bone, theirs.R_world_bone, atol=1e-4)


@pytest.mark.parametrize("name", list(ERRORS))
def test_an_error_changes_the_recording(name: str) -> None:
    right = recording()
    told = planting.planted(right, planting.drawn(right, {name: SIZES[name]}, seed=1))
    parts = ("uv_px", "times")
    same = all(np.array_equal(getattr(told.video, p), getattr(right.video, p)) for p in parts)
    same &= np.array_equal(told.joint_offsets, right.joint_offsets)
    same &= np.array_equal(told.video.camera.K, right.video.camera.K)
    same &= np.array_equal(told.video.camera.R_camera_world, right.video.camera.R_camera_world)
    ours, theirs = told.bone_imus(times=right.video.times), right.bone_imus()
    assert ours is not None
    assert theirs is not None
    same &= np.allclose(ours.R_world_bone, theirs.R_world_bone, atol=1e-7)
    same &= np.array_equal(ours.p_bone_sensor, theirs.p_bone_sensor)
    assert not same


def test_three_times_the_size_is_the_same_draw_times_three() -> None:
    once = planting.drawn(recording(), SIZES, seed=2)
    thrice = planting.drawn(recording(), {n: 3 * s for n, s in SIZES.items()}, seed=2)
    for name, values in once.items():
        for item, value in values.items():
            np.testing.assert_allclose(thrice[name][item], 3 * value)


def test_errors_are_as_large_as_they_say() -> None:
    draws = [planting.drawn(recording(), SIZES, seed) for seed in range(100)]
    for name, error in ERRORS.items():
        values = np.concatenate([np.concatenate(list(draw[name].values())) for draw in draws])
        assert np.sqrt(np.mean(values**2)) == pytest.approx(error.size, rel=0.15)


def test_groups_of_bones_have_the_size_and_their_proportion() -> None:
    wrong = {"size": {"all": np.array([0.03])}, "proportions": {"thighs": np.array([-0.02])}}
    known = planting.unknowns(recording(), wrong)
    assert known["bones", "thighs"][0] == pytest.approx(1.03 * 0.98 - 1)
    assert known["bones", "shanks"][0] == pytest.approx(0.03)


@pytest.mark.parametrize("name", list(ERRORS))
def test_opening_an_error_opens_its_prior(name: str) -> None:
    priors = ERRORS[name].opened(CalibrationPriors(), 0.01)
    changed = {k for k, v in vars(priors).items() if v != getattr(CalibrationPriors(), k)}
    assert changed
    assert all(getattr(priors, k) for k in changed)


def test_the_mean_slip_of_a_sensor_is_part_of_its_mounting() -> None:
    right = recording()
    assert right.calibration is not None
    slips = planting.slips(right)
    np.testing.assert_allclose(np.array(list(slips.values())), 0.0, atol=1e-4)
    turn = np.zeros((len(right.calibration.sensors), 3))
    turn[2] = [0.1, -0.05, 0.02]
    wrong = {"mounting": dict(zip(right.calibration.joints, turn, strict=True))}
    slipped = planting.slips(planting.planted(right, wrong))
    np.testing.assert_allclose(np.array(list(slipped.values())), turn, atol=1e-4)


def test_all_groups_of_bones_are_planted() -> None:
    draws = planting.drawn(recording(), SIZES, seed=0)
    assert set(draws["proportions"]) == set(BONE_GROUPS)
    told = planting.planted(replace(recording()), draws)
    factor = told.joint_offsets[1:] / np.where(recording().joint_offsets[1:], recording().joint_offsets[1:], 1)
    assert np.all(np.any(np.abs(factor) != 1, axis=1))
