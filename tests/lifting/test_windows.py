"""From rays and axes to network input and back."""

from __future__ import annotations

import lifting_support as support
import pytest
import torch
from lifting_support import windows_of
from torch import Tensor

from lifting.body import Body
from lifting.windows import EncodedWindows, Estimate, decode, encode, rotations, sizes
from rtof_kin.core import rotations as so3

W = 27
ACROSS = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
"""Signs of a vector's components in the mirrored scene."""


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


@pytest.fixture(scope="module")
def scene() -> Tensor:
    """Points (B, 3, W, J) from the optical centre of a camera at 1.6 m, some way off along x."""
    return support.scene_of(range(3), W)[0]


@pytest.fixture(scope="module")
def axes() -> Tensor:
    """Axes (B, 3, W, 2, J) of the same people's segments."""
    return support.scene_of(range(3), W)[1]


def everything(scene: Tensor) -> Tensor:
    return torch.ones(scene.shape[0], *scene.shape[2:], dtype=torch.bool)


def mirrored(body: Body, values: Tensor) -> Tensor:
    """Points or axes (B, 3, ..., J) of the mirrored scene."""
    return (values * ACROSS.reshape(3, *[1] * (values.ndim - 2)))[..., body.mirrored]


def spreads(body: Body, B: int) -> tuple[Tensor, Tensor]:
    """Some logarithms of spreads (B, 2, J) and (B, J), all different."""
    generator = torch.Generator().manual_seed(3)
    J = len(body.names)
    make = [torch.rand((B, *n), generator=generator, dtype=torch.float64) - 4 for n in ((2, J), (J,))]
    return make[0], make[1]


def true_output(body: Body, scene: Tensor, axes: Tensor, encoded: EncodedWindows, at: int = W // 2) -> Tensor:
    """Output of an exact network."""
    now = scene[:, :, at]
    pose = torch.bmm(encoded.R_ray_world, now - now[:, :, :1])[:, :, 1:]
    root = torch.einsum("bij,bj->bi", encoded.R_view_world, now[:, :, 0])
    shift = root[:, :2] / root[:, 2:] / encoded.scale[:, None]
    distance = (root.norm(dim=1) * encoded.scale).log()
    log_spread, log_turn = spreads(body, len(scene))
    parts = [pose.flatten(1), shift, distance[:, None], log_spread.flatten(1)]
    if body.sensors:
        in_ray = torch.einsum("bij,bjaJ->baiJ", encoded.R_ray_world, axes[:, :, at])
        parts += [in_ray.flatten(1), log_turn]
    return torch.cat(parts, dim=1)


def fields(estimate: Estimate) -> list[Tensor]:
    """All there is in it."""
    assert estimate.axes is not None
    assert estimate.log_turn is not None
    return [estimate.pose, estimate.root, estimate.log_spread, estimate.axes, estimate.log_turn]


# --- there and back ------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [W // 2, W - 1, 0])
def test_decoding_the_exact_output_gives_the_scene(body: Body, scene: Tensor, axes: Tensor, at: int) -> None:
    encoded = encode(body, windows_of(body, scene, axes, estimated=at))
    estimate = decode(body, true_output(body, scene, axes, encoded, at), encoded)
    now = scene[:, :, at]
    log_spread, log_turn = spreads(body, 3)
    expected = [now - now[:, :, :1], now[:, :, 0], log_spread, axes[:, :, at], log_turn]
    for is_, should in zip(fields(estimate), expected, strict=True):
        torch.testing.assert_close(is_, should, atol=1e-9, rtol=0)


def test_decoded_axes_are_orthonormal_and_z_keeps_its_direction(body: Body, scene: Tensor, axes: Tensor) -> None:
    encoded = encode(body, windows_of(body, scene))
    output = true_output(body, scene, axes, encoded)
    askew = output.clone()
    at = 5 * 21
    z = output[:, at + 63 : at + 126].reshape(3, 3, 21)
    askew[:, at : at + 63] = 3 * (output[:, at : at + 63] + 0.4 * z.flatten(1))
    askew[:, at + 63 : at + 126] *= 0.2
    for one in (decode(body, askew, encoded), decode(body, output, encoded)):
        R = rotations(one.axes).permute(0, 3, 1, 2)
        assert so3.is_rotation(R.numpy())
        torch.testing.assert_close(one.axes, axes[:, :, W // 2], atol=1e-9, rtol=0)


# --- what is not there ---------------------------------------------------------------------------


def test_degenerate_scenes_stay_finite(body: Body, scene: Tensor, axes: Tensor) -> None:
    nothing = windows_of(body, scene, seen=~everything(scene))
    behind = windows_of(body, -scene + 2 * scene[..., :1], axes)
    point = windows_of(body, scene[..., :1].expand(scene.shape), axes)
    above = windows_of(body, scene * torch.tensor([0.0, 0.0, 1.0])[:, None, None].double())
    for windows in (nothing, behind, point, above):
        encoded = encode(body, windows)
        assert torch.isfinite(encoded.features).all()
        assert torch.isfinite(encoded.constants).all()
        for value in (1e6, 0.0):
            for part in fields(decode(body, torch.full((3, sizes(body)[2]), value), encoded)):
                assert torch.isfinite(part).all()
