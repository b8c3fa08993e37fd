"""Errors on fixed validation windows, in mm and deg."""

from __future__ import annotations

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.training import losses as module
from lifting.training.data import Batch
from lifting.training.losses import Validation
from lifting.windows import Estimate, rotations
from rtof_kin.core import rotations as so3

CPU = torch.device("cpu")
SENSED = {"realistic, 8 sensors", "realistic, 10 sensors"}
ALWAYS = {"perfect", "realistic", "independent", "perfect, bones unknown", "realistic, floor known"}


@pytest.fixture(scope="module")
def validation() -> Validation:
    return Validation(support.tiny_corpus(frames=60), 27, CPU, count=40)


def measured(
    validation: Validation, monkeypatch: pytest.MonkeyPatch, mm: float, degrees: float
) -> dict[str, dict[str, float]]:
    """Of answers that are wrong by so much: sideways in every joint, and about a bone's own y axis."""

    def estimate(self: Validation, network: object, batch: Batch, flip: bool) -> Estimate:
        pose, root = batch.pose.clone(), batch.root.clone()
        pose[:, 2, 1:] += mm / 1000
        root[:, 2] += mm / 1000
        R = rotations(batch.axes).permute(0, 3, 1, 2).numpy()
        R = R @ so3.about_axis("y", np.radians(degrees))
        axes = torch.from_numpy(R[..., [0, 2]]).permute(0, 2, 3, 1).float()
        B, _, J = pose.shape
        return Estimate(pose, root, torch.zeros(B, 2, J), axes, torch.zeros(B, J))

    monkeypatch.setattr(Validation, "_estimate", estimate)
    return validation.measure(support.untrained_lifter().network)


def test_errors_are_millimetres_and_degrees(validation: Validation, monkeypatch: pytest.MonkeyPatch) -> None:
    for errors in measured(validation, monkeypatch, 21.0, 10.0).values():
        assert errors["rr_mm"] == pytest.approx(20.0, abs=0.05)
        assert errors["abs_mm"] == pytest.approx((21 + 20 * 42) / 21, abs=0.05)
        assert errors["pelvis_deg"] == pytest.approx(10.0, abs=0.05)
        assert errors["upper_trunk_deg"] == pytest.approx(10.0, abs=0.05)


def test_kinds_with_sensors_need_a_body_with_sensors(validation: Validation) -> None:
    assert set(validation.batches) == ALWAYS | SENSED
    bare = Validation(support.tiny_corpus(frames=60, table=support.TABLE_17), 27, CPU, count=40)
    assert set(bare.batches) == ALWAYS


def test_windows_are_reproducible_and_share_the_motion_between_kinds(validation: Validation) -> None:
    again = Validation(support.tiny_corpus(frames=60), 27, CPU, count=40)
    for kind, batch in validation.batches.items():
        assert torch.equal(batch.windows.rays_world, again.batches[kind].windows.rays_world), kind
        assert torch.equal(batch.windows.axes_world, again.batches[kind].windows.axes_world), kind
        assert torch.equal(batch.pose, validation.batches["realistic"].pose), kind

    def rays(kind: str) -> Tensor:
        return validation.batches[kind].windows.rays_world

    assert torch.equal(rays("realistic"), rays("realistic, 8 sensors"))


def test_without_validation_subjects_there_are_no_errors() -> None:
    empty = Validation(support.tiny_corpus(clips=2, frames=40), 27, CPU, count=8)
    assert empty.measure(support.untrained_lifter().network) == {}


def test_a_network_is_measured_with_its_own_windows(validation: Validation) -> None:
    errors = validation.measure(support.untrained_lifter().network)
    assert set(errors) == ALWAYS | SENSED
    assert errors["realistic"] != errors["realistic, 8 sensors"]
    assert all(np.isfinite(value) for kind in errors.values() for value in kind.values())
    assert module.SEED == 20_000
