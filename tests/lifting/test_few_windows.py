"""`FewWindows` gives the answer of the windows' own encoding, network and decoding."""

from __future__ import annotations

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting import windows
from lifting.models import FoldedNetwork
from lifting.predict import Lifter
from lifting.streaming import FewWindows
from rtof_kin.core import rotations as so3

SIZE = 27


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture(scope="module")
def scene() -> tuple[Tensor, Tensor]:
    points, axes = support.scene_of(range(5), SIZE)
    return points.float(), axes.float()


@pytest.mark.parametrize("flip", [True, False])
@pytest.mark.parametrize("height", [1.6, 0.1, np.nan])
@pytest.mark.parametrize("known", [True, False])
def test_the_answer_is_that_of_torch(
    lifter: Lifter, scene: tuple[Tensor, Tensor], flip: bool, height: float, known: bool
) -> None:
    body, rng = lifter.description.body, np.random.default_rng(0)
    bones = lifter.bones_of(support.TABLE.offsets if known else None)
    seen = torch.from_numpy(rng.uniform(size=(5, SIZE, 21)) > 0.3)
    seen[0, :, 0] = seen[1, 13] = False  # no root; nothing in the estimated frame
    seen[2] = seen[3, :, body.hips[0]] = False
    sensed = torch.from_numpy(rng.uniform(size=(5, SIZE, len(body.sensors))) > 0.5)
    observed = support.windows_of(
        body, *scene, seen=seen, sensed=sensed, bones=torch.from_numpy(bones).expand(5, -1), height=height
    )
    p, sigma_m, R, sigma_rad = FewWindows(body, lifter.network, bones, height, flip)(observed)
    with torch.inference_mode():
        encoded = windows.encode(body, observed)
        output = FoldedNetwork(body, lifter.network, flip)(encoded.features, encoded.constants)
        estimate = windows.decode(body, output, encoded)
    assert estimate.axes is not None
    assert estimate.log_turn is not None
    expected = (estimate.pose + estimate.root[:, :, None]).transpose(1, 2)
    np.testing.assert_allclose(p, expected, rtol=1e-5, atol=2e-5)
    np.testing.assert_allclose(sigma_m, estimate.sigma_m(), rtol=1e-4)
    assert so3.is_rotation(R, tolerance=1e-9)
    np.testing.assert_allclose(R[..., [0, 2]], estimate.axes.permute(0, 3, 1, 2), atol=1e-4)
    np.testing.assert_allclose(sigma_rad, windows.SIGMA_TURN * estimate.log_turn.exp(), rtol=1e-4)
