"""Losses: distances, angles, and the likelihood of spreads."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from lifting.training import losses
from lifting.training.data import Batch
from lifting.training.losses import Validation
from lifting.windows import Estimate, rotations
from rtof_kin.core import rotations as so3

B, J = 6, 5


def axes_of(R: np.ndarray) -> Tensor:
    """(B, 3, 2, J) of rotations (B, J, 3, 3)."""
    return torch.from_numpy(R[..., [0, 2]]).permute(0, 2, 3, 1)


def batch(seed: int = 0, axes: Tensor | None = None) -> Batch:
    """Ground truth in double precision; the windows are not read."""
    generator = torch.Generator().manual_seed(seed)
    pose = torch.randn((B, 3, J), generator=generator, dtype=torch.float64)
    pose[:, :, 0] = 0.0
    root = torch.randn((B, 3), generator=generator, dtype=torch.float64) + 4
    if axes is None:
        axes = axes_of(so3.exp(np.random.default_rng(seed).normal(size=(B, J, 3))))
    body = support.tiny_corpus().body()
    observed = support.windows_of(body, support.scene_of(range(1), 3)[0])
    return Batch(observed, pose, root, axes)


def estimate(seed: int = 1, oriented: bool = True) -> Estimate:
    """An estimate that requires gradients."""
    made = batch(seed)
    generator = torch.Generator().manual_seed(seed + 10)
    spread = torch.rand((B, 2, J), generator=generator, dtype=torch.float64) - 2
    turn = torch.rand((B, J), generator=generator, dtype=torch.float64) - 2
    parts = made.pose, made.root, spread, made.axes, turn
    pose, root, spread, axes, turn = (x.detach().clone().requires_grad_() for x in parts)
    return Estimate(pose, root, spread, axes if oriented else None, turn if oriented else None)


def sample(dimensions: int, count: int, scale: float, seed: int = 0) -> np.ndarray:
    """Errors (count, dimensions) of density b^-n exp(-|e| / b): by rejection, from its definition."""
    rng = np.random.default_rng(seed)
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        e = rng.uniform(-18, 18, (2_000_000, dimensions))
        kept.append(e[rng.uniform(size=len(e)) < np.exp(-np.linalg.norm(e, axis=1))])
    return scale * np.concatenate(kept)[:count]


# --- distances and angles ------------------------------------------------------------------------


def test_losses_are_distances_in_metres() -> None:
    truth, pose = torch.zeros(2, 3, 5), torch.zeros(2, 3, 5)
    pose[:, 0, 1:], pose[:, 2, 1:] = 3.0, 4.0
    root = torch.tensor([[0.0, 2.0, 0.0], [0.0, 0.0, 4.0]])
    made = replace(batch(), pose=truth, root=torch.zeros(2, 3))
    total = losses.position_loss(Estimate(pose, root, torch.zeros(2, 2, 5), None, None), made)
    assert float(total) == pytest.approx(5.0 + 0.3 * 3.0)


def test_angles_are_those_between_rotations() -> None:
    rng = np.random.default_rng(4)
    R, turn = so3.exp(rng.normal(size=(B, J, 3))), rng.normal(size=(B, J, 3))
    chord = losses.turn_angles(axes_of(R @ so3.exp(turn)), axes_of(R)).numpy()
    peer = Rotation.from_rotvec(turn.reshape(-1, 3)).magnitude().reshape(B, J)
    np.testing.assert_allclose(chord, 2 * np.sin(peer / 2), atol=1e-12)
    small = losses.turn_angles(axes_of(R @ so3.exp(0.01 * turn)), axes_of(R)).numpy()
    np.testing.assert_allclose(small, 0.01 * np.linalg.norm(turn, axis=-1), rtol=1e-3)


# --- spreads -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_maximum_likelihood_recovers_a_planted_scale(dimensions: int) -> None:
    length = torch.from_numpy(np.linalg.norm(sample(dimensions, 4000, 0.07), axis=1))
    log_scale = torch.zeros((), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([log_scale], max_iter=50)

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = losses.likelihood(length, log_scale, dimensions).mean()
        value.backward()
        return value

    optimizer.step(closure)
    assert float(log_scale.detach().exp()) == pytest.approx(0.07, rel=0.05)


def test_spreads_do_not_change_gradients_of_positions_and_orientations() -> None:
    truth = batch()
    whole, bare = estimate(), estimate()
    losses.lifting_loss(whole, truth).backward()
    turn = losses.turn_angles(bare.axes, truth.axes).mean()
    (losses.position_loss(bare, truth) + losses.TURN_WEIGHT * turn).backward()
    for name in ("pose", "root", "axes"):
        torch.testing.assert_close(getattr(whole, name).grad, getattr(bare, name).grad)
    assert bare.log_spread.grad is None
    assert whole.log_spread.grad.abs().min() > 0
    assert whole.log_turn.grad.abs().min() > 0


CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def validation() -> Validation:
    return Validation(support.tiny_corpus(frames=60), 27, CPU, count=40)


def measured(
    validation: Validation, monkeypatch: pytest.MonkeyPatch, mm: float, degrees: float
) -> dict[str, dict[str, float]]:
    """Of answers that are wrong by so much: sideways in every joint, and about a bone's own y axis."""

    def estimate(self: Validation, network: object, batch: Batch) -> Estimate:
        pose, root = batch.pose.clone(), batch.root.clone()
        pose[:, 2, 1:] += mm / 1000
        root[:, 2] += mm / 1000
        R = rotations(batch.axes).permute(0, 3, 1, 2).numpy()
        R = R @ so3.about_axis("y", np.radians(degrees))
        axes = torch.from_numpy(R[..., [0, 2]]).permute(0, 2, 3, 1).float()
        B, _, J = pose.shape
        return Estimate(pose, root, torch.zeros(B, 2, J), axes, torch.zeros(B, J))

    monkeypatch.setattr(Validation, "_estimate", estimate)
    return validation.measure(support.tensor_network(support.untrained_lifter()))


def test_errors_are_millimetres_and_degrees(validation: Validation, monkeypatch: pytest.MonkeyPatch) -> None:
    for errors in measured(validation, monkeypatch, 21.0, 10.0).values():
        assert errors["rr_mm"] == pytest.approx(20.0, abs=0.05)
        assert errors["abs_mm"] == pytest.approx((21 + 20 * 42) / 21, abs=0.05)
        assert errors["pelvis_deg"] == pytest.approx(10.0, abs=0.05)
        assert errors["upper_trunk_deg"] == pytest.approx(10.0, abs=0.05)


def test_without_validation_subjects_there_are_no_errors() -> None:
    empty = Validation(support.tiny_corpus(clips=2, frames=40), 27, CPU, count=8)
    assert empty.measure(support.tensor_network(support.untrained_lifter())) == {}


def test_errors_are_split_along_and_across_the_ray_to_the_root() -> None:
    truth = batch()
    ray = torch.nn.functional.normalize(truth.root)
    side = torch.nn.functional.normalize(torch.linalg.cross(ray, ray.roll(1, dims=1)))
    up = torch.linalg.cross(ray, side)
    error = 0.3 * ray + 0.04 * side - 0.03 * up
    pose = truth.pose + error[:, :, None]
    root = truth.root + error * truth.root.norm(dim=1)[:, None]
    made = replace(estimate(), pose=pose, root=root)
    lengths = losses.errors_by_direction(made, truth)
    torch.testing.assert_close(lengths[:, 0], torch.full((B, J), 0.05).double())
    torch.testing.assert_close(lengths[:, 1], torch.full((B, J), 0.3).double())
