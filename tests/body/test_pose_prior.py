"""The shipped pose prior, its precision, and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtof_kin.body.pose_prior import PosePrior, has_prior, shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
PRIOR = shipped_prior(BODY.names)


def arrays(**changes: Any) -> dict[str, Any]:
    """Of a small prior of three joints."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    return {
        "mean_quat_wxyz": np.tile([1.0, 0, 0, 0], (2, 1)),
        "covariance": root @ root.T / 50,
        "sigma_jerk": np.array([300.0, 400.0, 500.0]),
        "sigma_root_jerk": np.array(50.0),
        **changes,
    }


def saved(folder: Path, **changes: Any) -> Path:
    path = folder / "prior.npz"
    write_npz(path, {k: np.asarray(v) for k, v in arrays(**changes).items() if v is not None})
    return path


def test_prior_is_shipped_for_the_21_joints_only() -> None:
    assert has_prior("total_capture")
    assert not has_prior("human36m")
    assert PRIOR.joints == BODY.names
    assert shipped_prior(BODY.names) is PRIOR


def test_covariance_and_jerk_are_physiological() -> None:
    assert np.linalg.eigvalsh(PRIOR.covariance)[0] > -1e-12
    sigma = np.sqrt(np.diag(PRIOR.covariance)).reshape(-1, 3)
    assert sigma.max() < np.radians(90.0)
    arm, spine = (BODY.index(name)[0] - 1 for name in ("LeftArm", "Spine1"))
    assert np.linalg.norm(sigma[arm]) > 3 * np.linalg.norm(sigma[spine])
    for name, axis in (("LeftLeg", 1), ("RightLeg", 1), ("LeftForeArm", 2), ("RightForeArm", 2)):
        own = sigma[BODY.index(name)[0] - 1]
        assert own[axis] > 3 * np.delete(own, axis).max(), f"{name} is no hinge"
    left, right = ([j - 1 for j in BODY.index(side + "Arm", side + "Leg")] for side in ("Left", "Right"))
    np.testing.assert_allclose(sigma[left], sigma[right], rtol=0.02, atol=1e-3)
    assert np.all((PRIOR.sigma_jerk >= 200.0) & (PRIOR.sigma_jerk < 20000.0))
    assert 5.0 < PRIOR.sigma_root_jerk < 500.0


@pytest.mark.parametrize("joints, scale", [(BODY.names[1:], 2.0), (("LeftArm", "Spine", "Head"), 1.0)])
def test_precision_is_the_inverse_of_the_inflated_marginal(joints: tuple[str, ...], scale: float) -> None:
    rows = np.concatenate([3 * (BODY.index(n)[0] - 1) + np.arange(3) for n in joints])
    inflated = scale**2 * PRIOR.covariance[np.ix_(rows, rows)] + np.radians(3.0) ** 2 * np.eye(len(rows))
    P = PRIOR.precision(joints, scale, np.radians(3.0))
    np.testing.assert_allclose(P @ inflated, np.eye(len(rows)), atol=1e-8)
    assert np.linalg.eigvalsh(P)[0] > 0


def test_precision_of_an_unknown_joint_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown joint of the pose prior 'LeftShin'"):
        PRIOR.precision(("LeftArm", "LeftShin"), 1.0, 0.1)


def test_prior_from_a_file_is_read_as_written(tmp_path: Path) -> None:
    path = saved(tmp_path)
    prior = PosePrior.load(("a", "b", "c"), path)
    for name, value in arrays().items():
        np.testing.assert_allclose(getattr(prior, name), value)
    with pytest.raises(ValueError, match="read-only"):
        prior.covariance[0, 0] = 1.0


def test_prior_of_another_skeleton_or_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    with pytest.raises(FileFormatError, match=r"prior\.npz.*no pose prior of 21 joints"):
        PosePrior.load(BODY.names, path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FileFormatError, match="damaged, or no NPZ archive"):
        PosePrior.load(BODY.names, path)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"covariance": None}, "covariance"),
        ({"sigma_jerk": np.ones(2)}, r"prior sigma_jerk: expected shape \(3\)"),
        ({"sigma_root_jerk": np.ones(2)}, "sigma_root_jerk"),
        ({"covariance": -np.eye(6)}, "not symmetric and positive semidefinite"),
        ({"covariance": np.triu(np.ones((6, 6))) + 5 * np.eye(6)}, "not symmetric"),
        ({"covariance": np.full((6, 6), np.nan)}, "not symmetric"),
        ({"mean_quat_wxyz": np.zeros((2, 4))}, "not unit quaternions"),
        ({"sigma_jerk": np.array([300.0, 0.0, 1.0])}, "jerk must be positive and finite"),
        ({"sigma_root_jerk": np.array(np.nan)}, "jerk must be positive and finite"),
    ],
)
def test_invalid_prior_is_refused_with_its_field(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = saved(tmp_path, **change)
    with pytest.raises(FileFormatError, match=rf"prior\.npz.*no pose prior of 3 joints.*{message}"):
        PosePrior.load(("a", "b", "c"), path)
