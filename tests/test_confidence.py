"""The record of how well a motion is known: what it tells, keeps and refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.confidence import WORLD, Confidence, joined, per_axis
from rtof_kin.errors import ShapeError, UnknownNameError
from rtof_kin.motion_files import write_motion_files
from rtof_kin.skeleton import SkeletonModel

Array = NDArray[np.float64]
NAMES = ("Hips", "LeftUpLeg", "LeftLeg")
PAIRS = ((WORLD, "Hips"), ("Hips", "LeftUpLeg"))


def covariances(*shape: int, seed: int = 0) -> Array:
    root = np.random.default_rng(seed).normal(size=(*shape, 3, 3))
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def confidence(frames: int = 6, **changes: Any) -> Confidence:
    return Confidence(**{
        "times": np.arange(frames) / 60,
        "names": NAMES,
        "position_covariance": covariances(frames, 3),
        "relative_covariance": covariances(frames, 3, seed=1),
        "pairs": PAIRS,
        "turn_covariance": covariances(frames, 2, seed=2),
        **changes,
    })  # fmt: skip


def test_a_sigma_is_the_root_mean_square_over_the_axes() -> None:
    found = confidence(position_covariance=np.tile(np.diag([1.0, 4.0, 7.0]), (6, 3, 1, 1)))
    np.testing.assert_allclose(found.position_sigma, 2.0)
    np.testing.assert_allclose(found.relative_sigma, per_axis(found.relative_covariance))
    np.testing.assert_allclose(found.orientation_sigma[:, 0], per_axis(found.turn_covariance[:, 0]))


def test_a_pair_that_is_not_told_of_is_nan() -> None:
    found = confidence()
    np.testing.assert_array_equal(found.turn("Hips", "LeftUpLeg"), found.turn_covariance[:, 1])
    assert np.isnan(found.turn("LeftUpLeg", "Hips")).all()
    assert np.isnan(found.orientation_sigma[:, 1:]).all()


def test_what_is_cut_and_joined_is_as_it_was() -> None:
    whole = confidence()
    again = joined([whole[:2], whole[2:5], whole[5:]])
    for field in ("times", "position_covariance", "relative_covariance", "turn_covariance"):
        np.testing.assert_array_equal(getattr(again, field), getattr(whole, field))
    assert len(whole[1::2]) == 3


def test_arrays_are_read_only_copies() -> None:
    given = covariances(6, 3)
    found = confidence(position_covariance=given)
    given[:] = 0
    assert found.position_sigma.min() > 0
    with pytest.raises(ValueError, match="read-only"):
        found.turn_covariance[0, 0, 0, 0] = 1.0


def spoilt(value: float, *where: int) -> Array:
    out = covariances(6, 3)
    out[where] = value
    return out


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"position_covariance": covariances(5, 3)}, r"position_cov.*: expected shape \(6, 3, 3, 3\)"),
        ({"turn_covariance": covariances(6, 3)}, r"turn_covariance: expected shape \(6, 2, 3, 3\)"),
        ({"position_covariance": spoilt(np.nan, 1, 2, 0, 0)}, "position_covariance: not finite; write"),
        ({"relative_covariance": spoilt(np.inf, 1, 2)}, "relative_covariance: not finite"),
        ({"relative_covariance": spoilt(50.0, 1, 2, 0, 1)}, "relative_cov.*: a matrix is not symmetric"),
        ({"relative_covariance": -covariances(6, 3)}, "relative_covariance: a variance is negative"),
        ({"times": np.zeros(6)}, "time does not increase"),
        ({"names": ("Hips", "Hips", "LeftLeg")}, "Hips stands there more than once"),
        ({"pairs": (PAIRS[0], PAIRS[0])}, "pairs: one stands there more than once"),
    ],
)  # fmt: skip
def test_what_is_no_covariance_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        confidence(**changes)


def test_a_pair_of_an_unknown_segment_is_refused_with_a_hint() -> None:
    with pytest.raises(UnknownNameError, match="'LeftLegs'.*Did you mean 'LeftLeg'"):
        confidence(pairs=((WORLD, "Hips"), ("Hips", "LeftLegs")))


def test_nothing_known_is_nan_and_allowed() -> None:
    unknown = covariances(6, 3)
    unknown[2:4] = np.nan
    sigma = confidence(position_covariance=unknown).position_sigma
    np.testing.assert_array_equal(np.isnan(sigma).all(axis=1), [False, False, True, True, False, False])


# --- with a motion -------------------------------------------------------------------------------

BODY = SkeletonModel.default()


def of_body(frames: int) -> Confidence:
    J, pairs = len(BODY.names), ((WORLD, "Hips"), ("Hips", "LeftUpLeg"), ("LeftUpLeg", "LeftLeg"))
    return confidence(
        frames, names=BODY.names, position_covariance=covariances(frames, J),
        relative_covariance=covariances(frames, J), pairs=pairs,
        turn_covariance=covariances(frames, 3),
    )  # fmt: skip


def test_a_motion_is_cut_together_with_its_confidence() -> None:
    motion = planted.moving(BODY, 9)
    assert motion[2:5].confidence is None
    known = replace(motion, confidence=of_body(9))[2:5].confidence
    assert known is not None
    np.testing.assert_array_equal(known.times, motion.times[2:5])
    np.testing.assert_array_equal(known.turn_covariance, of_body(9).turn_covariance[2:5])


@pytest.mark.parametrize("other", [of_body(8), confidence(9), replace(of_body(9), times=np.arange(9.0))])
def test_a_confidence_of_another_motion_is_refused(other: Confidence) -> None:
    with pytest.raises(ShapeError, match="confidence is of other joints or other times"):
        replace(planted.moving(BODY, 9), confidence=other)


def test_files_that_want_even_times_are_written_of_a_motion_that_has_a_confidence(tmp_path: Path) -> None:
    motion = planted.moving(BODY, 9)
    times = motion.times + 1e-5 * np.sin(np.arange(9))
    poses = replace(motion.poses, times=times)
    told = replace(of_body(9), times=times)
    write_motion_files(tmp_path, replace(motion, poses=poses, confidence=told), ["trc"])
    assert (tmp_path / "motion.trc").is_file()
