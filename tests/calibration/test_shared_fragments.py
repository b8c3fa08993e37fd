"""Fragments that share unknowns: the profile against finite differences."""

from __future__ import annotations

from dataclasses import replace

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.estimate import shared_fragments
from rtof_kin.calibration.priors import OVERCOUNT
from rtof_kin.calibration.shared_fragments import SharedFragments, learned_precision

Array = NDArray[np.float64]


def fragments(*kinds: str, frames: int = 24, **more: float) -> SharedFragments:
    truth = cs.motion(frames)
    recording = planted.recording(truth, sigma_px=3.0, degrees=3.0)
    shared = cs.fragments(recording, truth.poses, cs.only(*kinds, **more))
    shared.begin()
    return shared


@pytest.mark.parametrize("kinds", [("heading", "image bias"), ("bones",)])
def test_profile_gradient_equals_finite_differences(kinds: tuple[str, ...]) -> None:
    shared = fragments(*kinds, frames=24)
    y = np.full(len(shared.prior), 0.01)
    evidence = shared.corrected(y)
    for _ in range(4):
        shared.settle(evidence)
    gradient = shared.profile(evidence, y)[1] + shared.prior @ y
    rng = np.random.default_rng(2)
    direction = 0.1 * np.sqrt(np.diag(np.linalg.inv(shared.prior))) * rng.normal(size=len(y))

    def energy(step: Array) -> float:
        y = 0.01 + step
        evidence = shared.corrected(y)
        total = [shared.settle(evidence) for _ in range(4)][-1]
        return total + 0.5 * float(y @ shared.prior @ y)

    slope = (energy(direction) - energy(-direction)) / 2
    # States are solved to 1e-4 of the energy.
    assert slope == pytest.approx(float(gradient @ direction), rel=0.1)


def test_size_is_unobserved_without_a_floor() -> None:
    truth, no_floor = cs.motion(24), replace(cs.SETTINGS, floor_height=None)
    recording = planted.recording(truth, sigma_px=3.0, degrees=3.0)
    shared = shared_fragments([cs.whole(recording, truth.poses)], cs.only("bones"), no_floor, cs.FRAMES)
    shared.begin()
    y = np.zeros(len(shared.prior))
    evidence = shared.corrected(y)
    for _ in range(4):
        shared.settle(evidence)
    told, gradient = shared.profile(evidence, y)
    all_alike = np.ones(len(y))
    assert abs(all_alike @ told @ all_alike) < 1e-4 * np.trace(told)
    assert abs(gradient @ all_alike) < 1e-3 * np.abs(gradient).sum()


def test_profile_hessian_is_positive_semidefinite() -> None:
    shared = fragments("delay", "heading", "mounting", "image bias", "bones")
    y = np.zeros(len(shared.prior))
    hessian, _ = shared.profile(shared.corrected(y), y)
    assert np.linalg.eigvalsh(hessian)[0] > -1e-6 * np.abs(hessian).max()


def test_energies_decrease() -> None:
    truth = cs.motion(48)
    recording = planted.recording(truth, sigma_px=2.0)
    wrong = cs.biased(recording, np.tile([8.0, -5.0], (21, 1)))
    shared = cs.fragments(wrong, truth.poses, cs.only("image bias", "heading")).estimate(4)
    assert shared.energies[-1] < shared.energies[0]
    assert all(b <= a * (1 + 1e-3) for a, b in zip(shared.energies, shared.energies[1:], strict=False))


def test_restart_at_the_estimate_stays_there() -> None:
    truth = cs.motion(48)
    bias = 8 * np.random.default_rng(2).normal(size=(21, 2))
    wrong = cs.biased(planted.recording(truth, sigma_px=2.0), bias)
    priors = cs.only("image bias", "heading")
    found = cs.fragments(wrong, truth.poses, priors).estimate(6)
    again = cs.fragments(wrong, truth.poses, priors).estimate(6, start=found.y)
    assert again.energies[0] < found.energies[0]
    np.testing.assert_allclose(again.y, found.y, atol=0.5)  # px and rad
    assert np.linalg.norm(found.y) > 0.5 * np.linalg.norm(bias)


KIND, OTHER = slice(0, 40), slice(40, 46)
G, SIGMA = 46, np.repeat([6.0, 0.05], [40, 6])
GIVEN = np.diag(1 / SIGMA**2)


def information(rng: np.random.Generator, unseen: int = 4) -> Array:
    """Of many directions, but of a few nothing."""
    axes = np.linalg.qr(rng.normal(size=(G, G)))[0]
    known = np.r_[np.zeros(unseen), rng.uniform(0.3, 30, G - unseen)]
    return (axes * known) @ axes.T / SIGMA[:, None] / SIGMA


def learned(share: float, seed: int) -> tuple[Array, Array]:
    """What is learned where errors are of a share of their variance; the information."""
    rng = np.random.default_rng(seed)
    D = information(rng)
    truth = SIGMA * rng.normal(size=G)
    truth[KIND] *= np.sqrt(share)
    L = np.linalg.cholesky(D + 1e-12 * GIVEN)
    slope = -D @ truth - np.sqrt(OVERCOUNT) * L @ rng.normal(size=G)  # at zero
    return learned_precision(GIVEN, D, slope, np.zeros(G), [KIND]), D


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_smaller_variance_is_learned(share: float) -> None:
    found = [1 / learned(share, seed)[0][0, 0] / SIGMA[0] ** 2 for seed in range(30)]
    assert np.mean(found) == pytest.approx(share, rel=0.25)


def test_correct_prior_is_nearly_unchanged() -> None:
    found = [1 / learned(1.0, seed)[0][0, 0] / SIGMA[0] ** 2 for seed in range(30)]
    assert np.mean(found) > 0.85
    assert max(found) <= 1 + 1e-12  # nobody learns that errors are larger


def test_other_kinds_keep_their_prior() -> None:
    precision, _ = learned(0.1, 0)
    np.testing.assert_array_equal(precision[OTHER, OTHER], GIVEN[OTHER, OTHER])
    np.testing.assert_array_equal(precision[KIND, OTHER], 0)


def test_no_information_leaves_the_prior_unchanged() -> None:
    precision = learned_precision(GIVEN, np.zeros((G, G)), np.zeros(G), np.zeros(G), [KIND])
    np.testing.assert_allclose(precision, GIVEN)


def test_result_does_not_depend_on_the_linearisation_point() -> None:
    rng = np.random.default_rng(3)
    D, slope, y = information(rng), rng.normal(size=G), SIGMA * rng.normal(size=G)
    at_zero = learned_precision(GIVEN, D, slope, np.zeros(G), [KIND])
    elsewhere = learned_precision(GIVEN, D, slope + D @ y, y, [KIND])
    np.testing.assert_allclose(elsewhere, at_zero, rtol=1e-6)
