"""The baseline VideoPose3D: input, output, recipe, training and prediction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lifting import videopose3d
from lifting.body import Body
from lifting.model import NetworkConfig
from lifting.models import model_of
from lifting.predict import Lifter
from lifting.source import Source
from lifting.training.data import MotionBank, plain
from lifting.training.run import Published
from lifting.training.settings import TrainConfig
from lifting.training.train import train
from lifting.videopose3d import PoseAndRootNetwork, bridged, decode, encode
from lifting.windows import Picture, Windows
from rtof_kin.data.camera import Camera

CPU = torch.device("cpu")
BODY = replace(support.tiny_corpus(frames=8).body(), sensors=())
J = len(BODY.names)
MODEL = model_of("videopose3d")
CAMERA = Camera(
    [[900.0, 0.0, 480.0], [0.0, 930.0, 520.0], [0.0, 0.0, 1.0]],
    Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 900.0).R_camera_world,
    Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 0.9], 900.0).t_camera_world,
    1000,
    1002,
)


def windows_of(camera: Camera = CAMERA, frames: int = 27) -> tuple[Windows, Tensor]:
    """The window around the middle of a motion, and its joints (1, 3, J) in the camera."""
    p = support.positions(1, frames)
    keypoints = support.seen_by(camera, p)
    source = Source.of(BODY, keypoints, None)
    middle = frames // 2
    bones = np.full(len(BODY.nominal_bones), np.nan)
    windows = source.windows(keypoints.times[[middle]], frames, middle, 60.0, bones, np.nan)
    return windows, torch.from_numpy(camera.to_camera(p[middle]).T[None]).float()


def network_of(seed: int = 0, causal: bool = False, channels: int = 16) -> PoseAndRootNetwork:
    torch.manual_seed(seed)
    inputs, constants, outputs = videopose3d.sizes(BODY)
    shape = NetworkConfig(inputs, constants, outputs, channels=channels, causal=causal, model="videopose3d")
    return PoseAndRootNetwork(shape).eval()


# --- what it reads and answers -------------------------------------------------------------------


def test_pixels_are_divided_by_half_of_the_images_width_from_its_middle() -> None:
    windows, _ = windows_of()
    uv = torch.from_numpy(CAMERA.project(support.positions(1, 27))).float()
    features = encode(BODY, windows).features[0].reshape(27, 2, J)
    torch.testing.assert_close(features[:, 0], uv[..., 0] / 1000 * 2 - 1, atol=1e-6, rtol=0)
    torch.testing.assert_close(features[:, 1], uv[..., 1] / 1000 * 2 - 1.002, atol=1e-6, rtol=0)


def test_a_perfect_answer_in_the_cameras_frame_is_the_scene_in_world() -> None:
    windows, p = windows_of()
    pose = (p - p[..., :1])[..., 1:]
    output = torch.cat([pose.flatten(1), p[..., 0]], dim=1)
    estimate = decode(BODY, output, encode(BODY, windows))
    truth = torch.from_numpy(support.positions(1, 27)[13] - CAMERA.center_world).float()
    torch.testing.assert_close(estimate.root[0], truth[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(estimate.pose[0].T, truth - truth[0], atol=1e-5, rtol=0)
    assert estimate.log_spread.isnan().all()
    assert estimate.axes is None


def mirrored(picture: Picture) -> Picture:
    """The mirror image, seen by the mirrored camera; orientation does not enter the input."""
    sign = torch.tensor([-1.0, 1.0])[:, None, None]
    return Picture(picture.xy[..., BODY.mirrored] * sign, picture.R_camera_world)


@pytest.mark.parametrize("causal", [False, True])
def test_the_mirrored_picture_has_the_mirrored_answer(causal: bool) -> None:
    network, (windows, _) = network_of(causal=causal), windows_of()
    assert windows.picture is not None
    there = encode(BODY, replace(windows, picture=mirrored(windows.picture)))
    here = encode(BODY, windows)
    torch.testing.assert_close(MODEL.mirror_features(BODY, here.features), there.features)
    both = MODEL.answer(BODY, network, here, flip=True)
    torch.testing.assert_close(MODEL.answer(BODY, network, there, flip=True), MODEL.mirror_output(BODY, both))
    assert not torch.allclose(MODEL.answer(BODY, network, here, flip=False), both, atol=1e-4)
    estimate, other = decode(BODY, both, here), decode(BODY, MODEL.mirror_output(BODY, both), here)
    in_camera = torch.bmm(here.R_camera_world, estimate.pose)[0]
    mirror_image = torch.bmm(here.R_camera_world, other.pose)[0]
    sign = torch.tensor([-1.0, 1.0, 1.0])[:, None]
    torch.testing.assert_close(mirror_image, in_camera[:, BODY.mirrored] * sign)


def test_unseen_landmarks_are_taken_from_the_nearest_frame() -> None:
    xy = torch.arange(6.0).reshape(1, 1, 6, 1).expand(1, 2, 6, 3).clone()
    seen = torch.ones(1, 6, 3, dtype=torch.bool)
    seen[0, :, 0] = torch.tensor([False, False, True, False, False, True])
    seen[0, :, 1] = False
    filled = bridged(torch.where(seen[:, None], xy, torch.nan), seen)
    assert filled[0, 0, :, 0].tolist() == [2, 2, 2, 2, 5, 5]
    mean = (2 + 5 + sum(range(6))) / 8
    assert filled[0, 1, :, 1].tolist() == pytest.approx([mean] * 6)
    assert filled[0, 0, :, 2].tolist() == list(range(6))
    nothing = bridged(torch.full_like(xy, torch.nan), torch.zeros_like(seen))
    assert torch.equal(nothing, torch.zeros_like(xy))


# --- the network ---------------------------------------------------------------------------------


def test_each_network_has_the_published_size() -> None:
    body = Body(support.TABLE_17.names, support.TABLE_17.parents, ())
    inputs, constants, outputs = videopose3d.sizes(body)
    assert (inputs, constants, outputs) == (34, 0, 51)
    network = PoseAndRootNetwork(NetworkConfig(inputs, constants, outputs, channels=1024))
    root = sum(p.numel() for p in network.root.parameters())
    pose = sum(p.numel() for p in network.parameters()) - root
    assert round(pose / 1e6, 1) == 8.6
    assert pose - root == (48 - 3) * 1025


# --- the recipe ----------------------------------------------------------------------------------


def test_the_recipe_is_the_published_one() -> None:
    config = TrainConfig.for_model("videopose3d", windows=1)
    assert (config.channels, config.dropout, config.batch) == (1024, 0.25, 1024)
    assert config.filter_widths == (3, 3, 3)
    network = network_of()
    recipe = Published(config, network, BODY)
    optimizer = recipe.optimizer
    assert isinstance(optimizer, torch.optim.Adam)
    assert not isinstance(optimizer, torch.optim.AdamW)
    assert optimizer.defaults["amsgrad"]
    norms = [layer for layer in network.modules() if isinstance(layer, nn.BatchNorm1d)]
    rates_set = []
    for share in (0.0, 0.5 / 60, 1 / 60 + 1e-9, 30 / 60, 59.5 / 60, 1.0):
        recipe.set_rates(share)
        assert len({norm.momentum for norm in norms}) == 1
        rates_set.append((optimizer.param_groups[0]["lr"], norms[0].momentum))
    rates, momenta = zip(*rates_set, strict=True)
    assert rates == pytest.approx([1e-3 * 0.95**k for k in (0, 0, 1, 30, 59, 59)])
    assert momenta == pytest.approx([0.1 * 0.01 ** (k / 60) for k in (0, 0, 1, 30, 59, 59)])
    assert recipe.memory(100) == 0.0


def test_the_root_error_is_weighted_by_its_depth() -> None:
    bank = MotionBank(support.tiny_corpus(frames=40), [0, 1], CPU)
    batch = bank.draw(8, 27, plain(), torch.Generator().manual_seed(0))
    assert batch.windows.picture is not None
    recipe = Published(TrainConfig.for_model("videopose3d", windows=1), network_of(), BODY)
    R = batch.windows.picture.R_camera_world
    output = torch.cat(
        [torch.bmm(R, batch.pose)[..., 1:].flatten(1), torch.bmm(R, batch.root[..., None])[..., 0]], dim=1
    )
    encoded = encode(BODY, batch.windows)
    assert recipe.loss(decode(BODY, output, encoded), batch) == pytest.approx(0.0, abs=1e-5)
    output[:, -1] += 0.3
    expected = (0.3 / torch.bmm(R, batch.root[..., None])[:, 2, 0]).mean()
    assert recipe.loss(decode(BODY, output, encoded), batch) == pytest.approx(float(expected), abs=1e-5)
    output[:, -1] -= 0.3
    output[:, : J - 1] += 0.02
    assert recipe.loss(decode(BODY, output, encoded), batch) == pytest.approx(0.02, abs=1e-5)


# --- through train and predict -------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A baseline that knows one motion from one camera placement by heart, a little."""
    corpus = replace(support.tiny_corpus(clips=2, frames=60), split=("train", "validation"))
    augment = replace(plain(), mirror=0.5, distance=(4.0, 4.0), camera_height=(1.5, 1.5), off_axis=0.0, roll=0.0)
    config = TrainConfig.for_model(
        "videopose3d",
        windows=16_000,
        batch=64,
        channels=48,
        dropout=0.0,
        learning_rate=3e-3,
        skeletons=0,
        validations=1,
        validation_windows=32,
        augment=augment,
    )
    return train(config, corpus, tmp_path_factory.mktemp("baseline") / "baseline.pt")


def test_it_trains_loads_and_predicts(trained: Path) -> None:
    lifter, p = Lifter.load(trained), support.positions(0, 60)
    keypoints = support.seen_by(Camera.looking_at([4.0, 0.0, 1.5], p[30, 0], 1250.0), p)
    lifted = lifter.predict(keypoints)
    error = lifted.p_world_joint - p
    assert np.linalg.norm(error - error[:, :1], axis=-1).mean() < 0.15
    assert np.linalg.norm(error[:, 0], axis=-1).mean() < 0.6
    assert np.isnan(lifted.sigma_m).all()
    assert np.isnan(lifted.R_world_bone).all()
