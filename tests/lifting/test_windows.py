"""From rays and axes to network input and back."""

from __future__ import annotations

import lifting_support as support
import numpy as np
import pytest
import torch
from lifting_support import assert_same_input, windows_of
from torch import Tensor

from lifting.body import Body
from lifting.windows import EncodedWindows, Estimate, decode, encode, mirror_features, mirror_output, rotations, sizes
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
            for part in fields(decode(body, torch.full((3, sizes(body)[2]), value).double(), encoded)):
                assert torch.isfinite(part).all()


def turned(R: np.ndarray, p: Tensor) -> Tensor:
    return torch.einsum("ij,bj...->bi...", torch.from_numpy(R), p)


def test_turning_the_world_about_the_vertical_leaves_the_input_unchanged(
    body: Body, scene: Tensor, axes: Tensor
) -> None:
    R = so3.about_axis("z", 2.1)
    straight = encode(body, windows_of(body, scene, axes))
    rotated = encode(body, windows_of(body, turned(R, scene), turned(R, axes)))
    assert_same_input(rotated, straight)
    estimate = decode(body, true_output(body, scene, axes, straight), rotated)
    now = scene[:, :, W // 2]
    torch.testing.assert_close(estimate.root, turned(R, now[:, :, 0]))
    torch.testing.assert_close(estimate.pose, turned(R, now - now[:, :, :1]))
    torch.testing.assert_close(estimate.axes, turned(R, axes[:, :, W // 2]))


def test_the_mirrored_scene_has_mirrored_features_and_output(body: Body, scene: Tensor, axes: Tensor) -> None:
    generator = torch.Generator().manual_seed(1)
    seen = torch.rand(everything(scene).shape, generator=generator) > 0.2
    sensed = torch.rand((3, W, 13), generator=generator) > 0.3
    here = encode(body, windows_of(body, scene, axes, seen=seen, sensed=sensed))
    there = encode(
        body,
        windows_of(
            body,
            mirrored(body, scene),
            mirrored(body, axes),
            seen=seen[..., body.mirrored],
            sensed=sensed[..., body.mirrored_sensors],
        ),
    )
    torch.testing.assert_close(mirror_features(body, here.features), there.features)
    torch.testing.assert_close(here.constants, there.constants)
    output = true_output(body, scene, axes, here)
    flipped = decode(body, mirror_output(body, output), there)
    now = mirrored(body, scene[:, :, W // 2])
    log_spread, log_turn = spreads(body, 3)
    expected = [
        now - now[:, :, :1],
        now[:, :, 0],
        log_spread[..., body.mirrored],
        mirrored(body, axes[:, :, W // 2]),
        log_turn[:, body.mirrored],
    ]
    for is_, should in zip(fields(flipped), expected, strict=True):
        torch.testing.assert_close(is_, should, atol=1e-9, rtol=0)


@pytest.mark.parametrize("at", [W // 2, W - 1, 4])
def test_the_view_axis_is_the_ray_to_the_root(body: Body, scene: Tensor, at: int) -> None:
    encoded = encode(body, windows_of(body, scene, estimated=at))
    on_axis = torch.einsum("bij,bj->bi", encoded.R_view_world, scene[:, :, at, 0])
    assert on_axis[:, :2].abs().max() < 1e-9
    assert torch.all(on_axis[:, 2] > 0)
    assert encoded.features[:, at, [0, 21]].abs().max() < 1e-6
    assert encoded.features[:, 20 if at == 4 else 4, [0, 21]].abs().max() > 1e-3


def test_a_foot_on_the_floor_gives_its_distance(body: Body, scene: Tensor) -> None:
    lowest = scene.clone()
    lowest[:, 2, :, body.feet] = 0.08 - 1.6
    encoded = encode(body, windows_of(body, lowest))
    away = lowest[:, :2, :, body.feet].norm(dim=1)
    expected = (away * encoded.scale[:, None, None]).log()
    torch.testing.assert_close(encoded.features[..., 63:65], expected)
    assert torch.all(encoded.features[..., 65:67] == 1)


def test_unseen_rays_are_ignored(body: Body, scene: Tensor) -> None:
    seen = everything(scene)
    seen[:, :, 10] = False
    seen[:, 20:] = False
    expected = encode(body, windows_of(body, scene, seen=seen))
    changed = torch.where(seen[:, None], scene, 7.0)
    assert_same_input(encode(body, windows_of(body, changed, seen=seen)), expected)


def test_axes_are_features_in_the_ray_frame(body: Body, scene: Tensor, axes: Tensor) -> None:
    sensed = torch.ones((3, W, 13), dtype=torch.bool)
    sensed[1, 4, 7] = False
    encoded = encode(body, windows_of(body, scene, axes, sensed=sensed))
    read = encoded.features[..., 67:-13].reshape(3, W, 3, 2, 13)
    carried = axes[..., body.sensor_joints]
    expected = torch.einsum("bij,bjwas->bwias", encoded.R_ray_world, carried)
    expected[1, 4, :, :, 7] = 0.0
    torch.testing.assert_close(read, expected)
