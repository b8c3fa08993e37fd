"""Fragments that share unknowns: the profile against finite differences."""

from __future__ import annotations

from dataclasses import replace

import calibration_support as cs
import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.calibration.estimate import calibrate, shared_fragments
from rtof_kin.calibration.priors import OVERCOUNT
from rtof_kin.calibration.shared_fragments import Excerpt, SharedFragments, Slice, learned_precision
from rtof_kin.core import rotations as so3
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.imu import BoneImuSequence

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


def test_restart_at_the_estimate_stays_there() -> None:
    truth = cs.motion(48)
    bias = 8 * np.random.default_rng(2).normal(size=(21, 2))
    wrong = cs.biased(planted.recording(truth, sigma_px=2.0), bias)
    priors = cs.only("image bias", "heading")
    found = cs.fragments(wrong, truth.poses, priors).estimate(6)
    again = cs.fragments(wrong, truth.poses, priors).estimate(6, start=found.y)
    assert again.energies[0] < found.energies[0]
    assert all(b <= a * (1 + 1e-3) for a, b in zip(found.energies, found.energies[1:], strict=False))
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
    zero = np.zeros(G)
    np.testing.assert_allclose(learned_precision(GIVEN, np.zeros((G, G)), zero, zero, [KIND]), GIVEN)


def test_result_does_not_depend_on_the_linearisation_point() -> None:
    rng = np.random.default_rng(3)
    D, slope, y = information(rng), rng.normal(size=G), SIGMA * rng.normal(size=G)
    at_zero = learned_precision(GIVEN, D, slope, np.zeros(G), [KIND])
    elsewhere = learned_precision(GIVEN, D, slope + D @ y, y, [KIND])
    np.testing.assert_allclose(elsewhere, at_zero, rtol=1e-6)


N = cs.FRAMES
FOUR = 4 * N / 60
"""[s] of four fragments."""


def whole(frames: int, **errors: float) -> Slice:
    truth = cs.motion(frames)
    return cs.whole(planted.recording(truth, **errors), truth.poses)


def chosen(*slices: Slice, seconds: float = FOUR) -> Excerpt:
    return Excerpt.chosen(slices, N, cs.SETTINGS, seconds)


def with_accelerations(part: Slice, change: Array) -> Slice:
    """Accelerations times factors (T,)."""
    bone_imus = part.bone_imus
    return replace(part, bone_imus=replace(bone_imus, a_world=bone_imus.a_world * change[:, None, None]))


def part_of(one: Slice, frames: slice) -> Slice:
    """Some frames of a slice, with all of its sensors' samples."""
    recording, guess = one.recording, one.guess
    return Slice(
        replace(recording, keypoints=recording.video[frames]),
        replace(guess, poses=guess.poses[frames], sigma_root=guess.sigma_root[frames]),
        one.bone_imus[frames],
    )


def test_the_liveliest_fragment_of_each_part_is_chosen() -> None:
    lively = np.zeros(12 * N)
    for fragment in (1, 3, 8, 9):  # of parts of three
        lively[fragment * N : (fragment + 1) * N] = 1.0
    lively[4 * N : 5 * N] = 0.01
    lively[10 * N : 11 * N] = 3.0
    excerpt = chosen(with_accelerations(whole(12 * N), lively))
    assert excerpt.fragments == tuple((0, k * N) for k in (1, 3, 8, 10))


def test_fragments_without_landmarks_are_not_chosen() -> None:
    part = whole(8 * N)
    blind = planted.unseen(part.recording.keypoints, slice(2 * N, 3 * N))
    excerpt = chosen(replace(part, recording=replace(part.recording, keypoints=blind)))
    assert (0, 2 * N) not in excerpt.fragments
    assert len(excerpt.fragments) == 4


@pytest.mark.parametrize("frames", [4 * N, 8 * N, 20 * N + 5])
def test_an_excerpt_is_as_long_as_asked_for_whatever_the_recording(frames: int) -> None:
    excerpt = chosen(whole(frames))
    assert len(excerpt.times) == 4 * N
    assert np.all(np.diff(excerpt.times) > 0)
    assert excerpt.times[-1] > (frames / 60) / 2
    assert len(excerpt.observations.rows["uv_px"]) == 4 * N
    short = chosen(whole(N - 3))
    assert (short.fragments, len(short.times)) == (((0, 0),), N - 3)


def test_fragments_of_slices_keep_their_own_times_and_sensors() -> None:
    one = whole(12 * N)
    parts = [part_of(one, slice(0, 4 * N)), part_of(one, slice(7 * N, 12 * N))]
    excerpt, direct = chosen(*parts), chosen(one, seconds=1e3)
    of_slices = dict(excerpt.by_slice(excerpt.times))
    for i, part in enumerate(parts):
        assert np.isin(of_slices[i], part.guess.poses.times).all()
    at = np.searchsorted(direct.times, excerpt.times)
    turned = excerpt.observations.rows["quat_sensor"] * direct.observations.rows["quat_sensor"][at]
    np.testing.assert_allclose(np.abs(turned.sum(axis=-1)), 1.0)  # either sign
    np.testing.assert_array_equal(excerpt.observations.rows["uv_px"], direct.observations.rows["uv_px"][at])


def test_derivatives_of_accelerations_do_not_cross_jumps_in_time() -> None:
    part = whole(12 * N)
    lively = np.ones(12 * N)
    lively[: 3 * N] = 100.0
    given = chosen(with_accelerations(part, lively), seconds=2 * N / 60).observations
    own = chosen(part, seconds=2 * N / 60).observations
    np.testing.assert_allclose(given.jerk_world[N:], own.jerk_world[N:], atol=1e-3)


def test_the_cost_does_not_grow_with_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    solve, counted = LevenbergMarquardt.solve, []

    def counting(self: LevenbergMarquardt, x: Array, *given: object, **more: object) -> object:
        counted.append(len(x))
        return solve(self, x, *given, **more)

    monkeypatch.setattr(LevenbergMarquardt, "solve", counting)
    priors = cs.only("heading", most_seconds=2 * N / 60)
    costs = []
    for frames in (4 * N, 20 * N):
        counted.clear()
        calibrate([whole(frames, sigma_px=1.0, degrees=1.0)], priors, cs.SETTINGS, N)
        costs.append(sum(counted))
    assert costs[1] <= 1.5 * costs[0]


def test_a_delay_is_found_from_slices() -> None:
    truth = cs.motion(30 * N)
    late = cs.late(planted.recording(truth, sigma_px=0.5, degrees=0.5), 0.03)
    one = cs.whole(late, replace(truth.poses, times=late.keypoints.times))
    parts = [part_of(one, slice(2 * N, 8 * N)), part_of(one, slice(20 * N, 27 * N))]
    result = calibrate(parts, cs.only("delay"), cs.SETTINGS, 2 * N)
    assert result["delay", "video"].value[0] == pytest.approx(0.03, abs=0.006)
    assert parts[0].guess.poses.times[-1] < result.middle < parts[1].guess.poses.times[0]


def turned(part: Slice, joint: str, frames: slice) -> Slice:
    """A sensor 40 degrees askew, about an axis across its bone, in some frames."""
    own: BoneImuSequence = part.bone_imus
    R = own.R_world_bone.copy()
    s, across = own.joints.index(joint), np.linalg.svd(cs.BODY.bone_axis(joint)[None])[2][1]
    R[frames, s] = R[frames, s] @ so3.exp(np.radians(40.0) * across)
    return replace(part, bone_imus=replace(own, R_world_bone=R))


def test_a_slipped_sensor_is_left_out_where_it_contradicts_the_motion() -> None:
    part = turned(whole(20 * N, sigma_px=0.5), "LeftForeArm", slice(10 * N, None))
    shared = shared_fragments([part], cs.only("heading"), cs.SETTINGS, 2 * N)
    shared.begin()
    faults = shared.slipped()
    assert {fault.what for fault in faults} == {"LeftForeArm"}
    at = part.guess.poses.times[10 * N]
    assert min(fault.start for fault in faults) >= at - 0.1
    left_out = replace(shared.excerpt, left_out=faults).observations
    s = shared.data.sensors.index("LeftForeArm")
    assert not left_out.rows["w_sensor"][left_out.times > at + 0.4, s].any()
    assert left_out.rows["w_sensor"][left_out.times < at - 0.1, s].all()


def test_a_sensor_askew_all_the_time_is_a_wrong_mounting() -> None:
    part = turned(whole(8 * N, sigma_px=0.5), "LeftForeArm", slice(None))
    shared = shared_fragments([part], cs.only("mounting"), cs.SETTINGS, 2 * N)
    shared.begin()
    assert shared.slipped() == ()
