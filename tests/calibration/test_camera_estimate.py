"""Unknowns of a camera: corrections, recovery from planted evidence, what remains, and its table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.camera_estimate import (
    FOCAL,
    HEIGHT,
    NOT_FOUND,
    PITCH,
    UNKNOWNS,
    CameraEstimate,
    Evidence,
    corrected,
    estimate_camera,
    pitch_and_roll,
    prior_sigma,
)
from rtof_kin.core.errors import ViewError
from rtof_kin.core.jobs import work_shared
from rtof_kin.data.camera import Camera, CameraUncertainty

Array = NDArray[np.float64]
UNSURE = CameraUncertainty(focal=0.1, tilt=np.radians(5.0), height=0.05, k1=0.02)
LEVEL = replace(Camera.looking_at([0, 0, 1.4], [1, 0, 1.4], 1200.0), uncertainty=UNSURE)
POINTS = np.random.default_rng(0).uniform([3, -1, 0], [6, 1, 1.8], (30, 3))
PLANTED = np.array([0.08, np.radians(4.0), np.radians(-3.0), 0.03, 0.0])
SIGMA_PX = 0.5


def of_points(camera: Camera) -> Evidence:
    """Known points, seen by the camera with the planted errors."""
    seen = corrected(LEVEL, PLANTED).project(POINTS)
    off = (camera.project(POINTS) - seen).ravel()
    return Evidence(off, np.full(len(off), SIGMA_PX))


def test_a_correction_turns_about_the_centre_and_scales_the_image() -> None:
    camera = corrected(LEVEL, PLANTED)
    np.testing.assert_allclose(camera.center_world, [0, 0, 1.43], atol=1e-12)
    assert camera.K[0, 0] == pytest.approx(1296.0)
    np.testing.assert_array_equal(camera.K[:2, 2], LEVEL.K[:2, 2])
    assert corrected(LEVEL, np.array([0, 0, 0, 0, 0.1])).distortion[0] == pytest.approx(0.1)


def test_pitch_is_down_and_roll_is_the_right_side_down() -> None:
    down = Camera.looking_at([0, 0, 2.0], [2, 0, 0.0], 1000.0)
    np.testing.assert_allclose(pitch_and_roll(down), [np.pi / 4, 0], atol=1e-12)
    pitch, roll = pitch_and_roll(corrected(LEVEL, np.array([0, 0, 0.1, 0, 0])))
    ahead = corrected(LEVEL, np.array([0, 0, 0.1, 0, 0])).R_camera_world @ [0, 0, 1]  # up in the image
    assert (pitch, abs(roll)) == (pytest.approx(0, abs=1e-12), pytest.approx(0.1))
    assert np.sign(roll) == -np.sign(ahead[0])  # up leans to the left where the right side is down


def test_planted_errors_are_recovered_and_the_rest_is_stated() -> None:
    found = estimate_camera(LEVEL, of_points)
    np.testing.assert_allclose(found.value, PLANTED, atol=2e-3)
    assert (found.sigma[:4] < 0.1 * prior_sigma(LEVEL)[:4]).all()
    assert found.sigma[4] == UNSURE.k1  # nothing was asked about it
    assert found.found.uncertainty.focal == found.sigma[FOCAL]


def test_the_estimate_does_not_depend_on_the_number_of_cores() -> None:
    found = []
    for cores in (1, 2):
        with work_shared(cores):
            found.append(estimate_camera(LEVEL, of_points))
    np.testing.assert_array_equal(found[0].value, found[1].value)
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


def test_the_covariance_is_that_of_linear_least_squares() -> None:
    """Against the closed form of an evidence that is linear in the unknowns."""
    A = np.random.default_rng(1).normal(size=(6, 4))

    def linear(camera: Camera) -> Evidence:
        y = [camera.K[0, 0] / 1200 - 1, pitch_and_roll(camera)[0], 0.0, camera.center_world[2] - 1.4]
        return Evidence(A @ y - 0.02, np.full(6, 0.05))

    sure = replace(LEVEL, uncertainty=replace(UNSURE, tilt=1e-9))
    found = estimate_camera(sure, linear)
    own = [FOCAL, HEIGHT]
    B = A[:, [0, 3]] / 0.05
    precision = B.T @ B + np.diag(1 / prior_sigma(sure)[own] ** 2)
    np.testing.assert_allclose(found.covariance[np.ix_(own, own)], np.linalg.inv(precision), rtol=1e-6)
    expected = np.linalg.solve(precision, B.T @ np.full(6, 0.02 / 0.05))
    np.testing.assert_allclose(found.value[own], expected, atol=1e-6)


def test_without_evidence_all_is_as_assumed() -> None:
    found = estimate_camera(LEVEL, lambda _: Evidence(np.full(3, np.nan), np.ones(3)))
    np.testing.assert_array_equal(found.value, 0)
    np.testing.assert_allclose(found.sigma, prior_sigma(LEVEL))
    assert all(row[-1] == NOT_FOUND for row in found.table())
    assert any("walk two metres towards the camera" in text for text in found.sentences)
    far = CameraEstimate(LEVEL, np.array([0.0, 4 * UNSURE.tilt, 0, 0, 0]), found.covariance)
    assert any(f"the {UNKNOWNS[PITCH]} found is more than three" in text for text in far.sentences)


def test_a_large_pitch_is_found_where_bodies_lean_off_a_wrong_floor() -> None:
    """A lean that saturates, as a lifted body's does, and that a floor below or above the feet turns."""
    unsure = replace(LEVEL, uncertainty=CameraUncertainty(0.0, np.radians(10.0), 0.4, 0.0, np.radians(4.0)))
    pitch, height, distance = np.radians(18.0), 1.9, 4.0

    def leaning(camera: Camera) -> Evidence:
        down, right = pitch_and_roll(camera)
        floor = camera.center_world[2] - height - distance * (down - pitch)
        lean = np.tanh(2 * (down - pitch)) + 0.3 * np.sin(6 * floor)
        return Evidence(np.array([floor, lean, right]), np.array([0.03, 0.03, 0.03]))

    found = estimate_camera(unsure, leaning)
    assert pitch_and_roll(found.found)[0] == pytest.approx(pitch, abs=2.5 * found.sigma[PITCH])
    assert found.found.center_world[2] == pytest.approx(height, abs=2.5 * found.sigma[HEIGHT])
    assert found.sigma[PITCH] < np.radians(3.0)
    assert found.found.uncertainty.of_motion
    assert found.found.uncertainty.roll == pytest.approx(found.sigma[2])


def test_what_is_known_stays_and_is_not_listed() -> None:
    camera = replace(LEVEL, uncertainty=CameraUncertainty(focal=0.1))
    found = estimate_camera(camera, of_points)
    np.testing.assert_array_equal(found.value[1:], 0)
    assert [row[0] for row in found.table()] == [UNKNOWNS[FOCAL]]
    found = estimate_camera(replace(LEVEL, uncertainty=CameraUncertainty(k1=0.05)), of_points)
    np.testing.assert_array_equal(found.value, 0)  # a distortion alone stays as assumed
    np.testing.assert_array_equal(found.sigma, [0, 0, 0, 0, 0.05])


def test_steps_that_lose_the_person_are_shortened() -> None:
    def narrow(camera: Camera) -> Evidence:
        if pitch_and_roll(camera)[0] > np.radians(1.0):
            raise ViewError("the person is behind the camera")
        return of_points(camera)

    found = estimate_camera(LEVEL, narrow)
    assert pitch_and_roll(found.found)[0] <= np.radians(1.0)
    with pytest.raises(ViewError):
        estimate_camera(corrected(LEVEL, np.array([0, 0.2, 0, 0, 0])), narrow)


def test_deviations_have_the_covariance_that_remains() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(5, 5)) * prior_sigma(LEVEL)[:, None] / 3
    estimate = CameraEstimate(LEVEL, np.zeros(5), root @ root.T)

    def unknowns(camera: Camera) -> Array:
        R = camera.R_camera_world @ LEVEL.R_camera_world.T
        tilt = 0.5 * np.array([R[2, 1] - R[1, 2], R[1, 0] - R[0, 1]])
        return np.array([camera.K[0, 0] / 1200 - 1, *tilt, camera.center_world[2] - 1.4, camera.distortion[0]])

    steps = np.array([unknowns(camera) for camera in estimate.deviations()])
    np.testing.assert_allclose(steps.T @ steps, estimate.covariance, atol=3e-4 * prior_sigma(LEVEL).max())
    assert (steps[:, 3] >= 0).all()  # no camera below the floor
