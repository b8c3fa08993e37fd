from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.body import Body
from lifting.training.data import augmentation
from lifting.training.joint_errors import Draw
from lifting.training.noise import FOCAL_PX, TRAINING_NOISE, NoiseConfig, add_noise
from rtof_kin.core.errors import UnknownNameError

B, W = 600, 27
QUIET = replace(
    NoiseConfig(),
    clean=0.0,
    white=0.0,
    independent=1.0,
    amplitude=(1.0, 1.0),
    bias_px=0.0,
    drift_px=0.0,
    jitter_px=0.0,
    outlier_share=0.0,
    missing_share=0.0,
    gap_share=0.0,
    poor_share=0.0,
    sparse_share=0.0,
    truncated_share=0.0,
)
"""Independent errors, all switched off."""


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


def random(rows: int, seed: int = 0) -> Draw:
    return Draw(rows, torch.Generator().manual_seed(seed), torch.device("cpu"))


def noise_of(
    body: Body, config: NoiseConfig, seed: int = 0, rows: int = B, rate_hz: float = 60.0
) -> tuple[Tensor, Tensor]:
    """Errors (B, 2, W, J) in px, and what is seen, of landmarks in the middle of the image."""
    xy = torch.zeros(rows, 2, W, len(body.names))
    seen = torch.ones(rows, W, len(body.names), dtype=torch.bool)
    noisy, mask = add_noise(body, config, xy, seen, random(rows, seed), rate_hz)
    return noisy * FOCAL_PX, mask


def test_kinds_have_their_shares(body: Body) -> None:
    error, _ = noise_of(body, NoiseConfig())
    clean, white = round(0.20 * B), round(0.10 * B)
    assert error[:clean].abs().max() == 0
    assert torch.all(error[clean:].abs().amax(dim=(1, 2, 3)) > 0)
    one_step = (error[:, :, 1:] - error[:, :, :-1]).std(dim=(1, 2, 3))
    spread = error.std(dim=(1, 2, 3))
    correlated = 1 - (one_step / spread) ** 2 / 2
    assert correlated[clean : clean + white].abs().max() < 0.15
    assert correlated[clean + white :].min() > 0.5


def test_the_bias_is_constant_in_a_window_and_scaled_by_joint(body: Body) -> None:
    error, _ = noise_of(body, replace(QUIET, bias_px=6.0))
    assert (error - error[:, :, :1]).abs().max() == 0
    sigma = error[:, :, 0].std(dim=(0, 1))
    for name, expected in {"Hips": 6.0, "LeftHand": 7.8, "RightLeg": 4.8, "RightUpLeg": 6.0}.items():
        assert sigma[body.names.index(name)] == pytest.approx(expected, rel=0.1), name


@pytest.mark.parametrize(
    ("joint", "memory", "rate_hz"), [("Head", 0.5, 60.0), ("LeftHand", 0.3, 60.0), ("Head", 0.5, 50.0)]
)
def test_drift_is_an_ornstein_uhlenbeck_process(body: Body, joint: str, memory: float, rate_hz: float) -> None:
    error, _ = noise_of(body, replace(QUIET, drift_px=5.0), rows=4000, rate_hz=rate_hz)
    path = error[..., body.names.index(joint)].reshape(-1, W)
    factor = 1.3 if joint.endswith("Hand") else 1.0
    assert path.std() == pytest.approx(5.0 * factor, rel=0.05)
    correlation = np.corrcoef(path.numpy().T)
    lag = np.array([6, 12, 20])
    measured = [np.diag(correlation, k).mean() for k in lag]
    np.testing.assert_allclose(measured, np.exp(-lag / rate_hz / memory), atol=0.06)


@pytest.mark.parametrize("share", [0.03, 0.05, 0.2])
def test_missing_runs_cover_their_share_of_all_samples(body: Body, share: float) -> None:
    _, seen = noise_of(body, replace(QUIET, missing_share=share), rows=2000)
    assert 1 - seen.float().mean() == pytest.approx(share, rel=0.1)
    changes = (seen[:, 1:] != seen[:, :-1]).sum(dim=1)
    assert changes.max() <= 2  # one run, not scattered samples


def test_outliers_are_large_rare_and_constant_while_they_last(body: Body) -> None:
    error, _ = noise_of(body, replace(QUIET, outlier_share=0.04), rows=2000)
    there = error.abs().amax(dim=1) > 0
    assert there.float().mean() == pytest.approx(0.04, rel=0.1)
    assert error[:, 0][there].std() == pytest.approx(60.0, rel=0.1)
    both = there[:, 1:] & there[:, :-1]
    step = (error[:, :, 1:] - error[:, :, :-1]).abs().amax(dim=1)
    assert step[both].max() == 0


def test_gaps_hide_the_whole_body_but_never_the_whole_window(body: Body) -> None:
    _, seen = noise_of(body, replace(QUIET, gap_share=1.0))
    whole = seen.any(dim=2) == seen.all(dim=2)
    assert whole.all()
    assert (~seen).any()
    assert seen.any(dim=2).any(dim=1).all()


def test_sparse_detectors_lack_the_trunk_throughout(body: Body) -> None:
    _, seen = noise_of(body, replace(QUIET, sparse_share=1.0))
    assert torch.equal(seen.all(dim=1), seen.any(dim=1))
    lacking = {name for j, name in enumerate(body.names) if not seen[:, :, j].any()}
    trunk = {"Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck"}
    assert lacking == trunk | {"LeftShoulder", "RightShoulder"}


def test_training_noise_is_chosen_by_name(body: Body) -> None:
    assert TRAINING_NOISE["mixed"] == NoiseConfig()
    assert noise_of(body, TRAINING_NOISE["perfect"])[0].abs().max() == 0
    error, _ = noise_of(body, TRAINING_NOISE["realistic"])
    one_step = (error[:, :, 1:] - error[:, :, :-1]).std(dim=(1, 2, 3))
    assert (1 - (one_step / error.std(dim=(1, 2, 3))) ** 2 / 2).min() > 0.5
    with pytest.raises(UnknownNameError, match="'real'.*Known: mixed, perfect, realistic, independent"):
        augmentation("real")


def test_landmarks_outside_the_image_are_unseen(body: Body) -> None:
    xy = torch.zeros(4, 2, W, len(body.names))
    xy[:, 0, :, 3] = 0.80  # 1000 px right of the middle of 1920
    xy[:, 1, :, 4] = -0.40  # 500 px above the middle of 1080
    seen = torch.ones(4, W, len(body.names), dtype=torch.bool)
    _, mask = add_noise(body, replace(QUIET, truncated_share=1.0), xy, seen, random(4))
    assert not mask[..., 3].any()
    assert mask[..., 4].all()
