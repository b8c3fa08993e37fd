from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.body import Body
from lifting.training.data import MotionBank, Moving, augmentation
from lifting.training.joint_errors import Draw
from lifting.training.noise import (
    FOCAL_PX,
    TRAINING_NOISE,
    NoiseConfig,
    RigConfig,
    SensorConfig,
    add_noise,
    exp,
    log,
    turns,
    with_errors,
    worn,
)
from lifting.windows import rotations
from rtof_kin.core import rotations as so3
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


def test_training_noise_is_chosen_by_name(body: Body) -> None:
    assert TRAINING_NOISE["mixed"] == NoiseConfig()
    assert noise_of(body, TRAINING_NOISE["perfect"])[0].abs().max() == 0
    error, _ = noise_of(body, TRAINING_NOISE["realistic"])
    one_step = (error[:, :, 1:] - error[:, :, :-1]).std(dim=(1, 2, 3))
    assert (1 - (one_step / error.std(dim=(1, 2, 3))) ** 2 / 2).min() > 0.5
    with pytest.raises(UnknownNameError, match="'real'.*Known: mixed, perfect, realistic, independent"):
        augmentation("real")


B_RIGS, W_RIGS = 200, 27


B_SENSORS, W_SENSORS = 2000, 4
DEFAULT = SensorConfig()
NO_ERROR = replace(DEFAULT, amplitude=(1.0, 1.0), misalignment=0.0, roll=0.0, heading=0.0)
LIMBS = {side + part for side in ("Left", "Right") for part in ("Arm", "ForeArm", "UpLeg", "Leg")}
ENDS = {side + part for side in ("Left", "Right") for part in ("ForeArm", "Leg")}


def draws_of_sensors(batch: int, seed: int = 0) -> Draw:
    return Draw(batch, torch.Generator().manual_seed(seed), torch.device("cpu"))


def measured_by_sensors(config: SensorConfig, R: np.ndarray, bones: Tensor, seed: int = 0) -> np.ndarray:
    """Rotations (B, W, S, 3, 3) as sensors report them whose true ones are R (B, W, S, 3, 3)."""
    axes = torch.from_numpy(R[..., [0, 2]]).permute(0, 3, 1, 4, 2).float()
    measured = with_errors(bones, axes, config, draws_of_sensors(len(R), seed))
    assert measured.shape == axes.shape
    x, z = np.moveaxis(measured.double().numpy(), (1, 3), (4, 0))
    return np.stack([x, np.cross(z, x), z], axis=-1)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Any rotations (B_SENSORS, W_SENSORS, 3, 3, 3) of three sensors."""
    return so3.exp(np.random.default_rng(0).normal(size=(B_SENSORS, W_SENSORS, 3, 3)))


BONES = torch.tensor([[0.0, 0.0, -1.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.0]])
"""Along z, askew, and a segment that is not one bone."""


# --- errors --------------------------------------------------------------------------------------


def in_segment(config: SensorConfig, truth: np.ndarray) -> np.ndarray:
    """Errors (B_SENSORS, W_SENSORS, S, 3) as rotation vectors in the segments' own frames."""
    return so3.log(np.swapaxes(truth, -1, -2) @ measured_by_sensors(config, truth, BONES))


@pytest.mark.parametrize("amplitude", [1.0, 2.0])
def test_misalignment_is_isotropic_in_the_segment(truth: np.ndarray, amplitude: float) -> None:
    config = replace(NO_ERROR, misalignment=0.06, amplitude=(amplitude, amplitude))
    error = in_segment(config, truth)[:, 0].reshape(-1, 3)
    covariance = error.T @ error / len(error) / (0.06 * amplitude) ** 2
    np.testing.assert_allclose(covariance, np.eye(3), atol=0.08)
    assert np.abs(error.mean(axis=0)).max() < 0.01


def test_soft_tissue_rolls_about_the_bone_only(truth: np.ndarray) -> None:
    error = in_segment(replace(NO_ERROR, roll=0.12), truth)[:, 0]
    along = np.einsum("bsi,si->bs", error, BONES.numpy())
    np.testing.assert_allclose(along.std(axis=0)[:2], 0.12, rtol=0.06)
    across = error - along[..., None] * BONES.numpy()
    assert np.abs(across).max() < 1e-5
    assert np.abs(error[:, 2]).max() < 1e-5, "there is no bone to roll about"


def test_limbs_err_as_measured_on_real_recordings(truth: np.ndarray) -> None:
    """Swing 2.7 and twist 4.7 degrees in the median, of bones that stand and lie."""
    error = np.degrees(in_segment(replace(DEFAULT, amplitude=(1.0, 1.0)), truth)[:, 0, 0])
    swing, twist = np.linalg.norm(error[:, :2], axis=-1), np.abs(error[:, 2])
    assert np.median(swing) == pytest.approx(2.7, abs=0.25)
    assert np.median(twist) == pytest.approx(4.7, abs=0.3)


# --- which are worn ------------------------------------------------------------------------------


def sets(body: Body, config: SensorConfig, batch: int = 20_000) -> list[frozenset[str]]:
    mask = worn(body, config, draws_of_sensors(batch, 4))
    assert mask.shape == (batch, len(body.sensors))
    names = np.array(body.sensors)
    return [frozenset(names[row]) for row in mask.numpy()]


ONLY: dict[str, set[str]] = {"none": set(), "limbs": LIMBS, "limbs_and_trunk": LIMBS | {"Hips", "Spine3"}, "ends": ENDS}


def test_sets_have_their_shares_and_the_rest_are_random_subsets(body: Body) -> None:
    found = sets(body, DEFAULT)
    share = {name: found.count(frozenset(joints)) / len(found) for name, joints in ONLY.items()}
    every = found.count(frozenset(body.sensors)) / len(found)
    rest = 1 - (0.30 + 0.30 + 0.12 + 0.08 + 0.06)
    # A random subset of 13 is empty, or whole, once in 14.
    assert share["none"] == pytest.approx(0.30 + rest / 14, abs=0.012)
    assert every == pytest.approx(0.06 + rest / 14, abs=0.008)
    assert share["limbs"] == pytest.approx(0.30, abs=0.012)
    assert share["limbs_and_trunk"] == pytest.approx(0.12, abs=0.01)
    assert share["ends"] == pytest.approx(0.08, abs=0.008)
    named = {frozenset(x) for x in (*ONLY.values(), set(body.sensors))}
    others = [len(x) for x in found if x not in named]
    assert np.bincount(others, minlength=13)[1:13].min() > len(others) / 12 / 2, "few or many alike"
    for joint in body.sensors:
        alone = sum(x == {joint} for x in found)
        assert alone > 0, joint


def test_the_bias_is_constant_in_a_window_and_scaled_by_joint(body: Body) -> None:
    error, _ = noise_of(body, replace(QUIET, bias_px=6.0))
    assert (error - error[:, :, :1]).abs().max() == 0
    sigma = error[:, :, 0].std(dim=(0, 1))
    for name, expected in {"Hips": 6.0, "LeftHand": 7.8, "RightLeg": 4.8, "RightUpLeg": 6.0}.items():
        assert sigma[body.names.index(name)] == pytest.approx(expected, rel=0.1), name


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


STILL = RigConfig(
    share=1.0, spread=0.0, spine=(0, 0, 0), pelvis=(0, 0, 0), clavicle=(0, 0, 0), mobility=(1.0, 1.0), places=0.0
)


@pytest.fixture(scope="module")
def bank() -> MotionBank:
    return MotionBank(support.tiny_corpus(), [0, 1], torch.device("cpu"))


def varied(bank: MotionBank, rigs: RigConfig, estimated: int = W_RIGS // 2) -> tuple[Moving, Moving]:
    """The same bodies as recorded and in another rig."""
    frames = torch.linspace(20, 150, B_RIGS).long()
    offset = (torch.arange(W_RIGS) - estimated + torch.zeros(B_RIGS, 1)).float()
    one, other = (
        bank._at(frames, offset, torch.zeros(B_RIGS, 1), torch.zeros(B_RIGS, dtype=torch.long))[0] for _ in range(2)
    )
    bank._vary(other, frames, offset, rigs, draws(B_RIGS))
    return one, other


@pytest.mark.parametrize("estimated", [W_RIGS // 2, W_RIGS - 1])
def test_bones_follow_their_segments(bank: MotionBank, estimated: int) -> None:
    """Independent reference: forward kinematics from orientations and offsets."""
    _, moving = varied(bank, RigConfig(share=1.0), estimated)
    R = rotations(moving.axes).permute(0, 3, 1, 2)
    bones = (R[:, bank.body.parents[1:]] @ moving.offsets[:, 1:, :, None])[..., 0]
    torch.testing.assert_close(moving.bones[:, :, estimated].transpose(1, 2), bones, atol=1e-5, rtol=0)
    torch.testing.assert_close(R @ R.transpose(-1, -2), torch.eye(3).expand_as(R), atol=1e-5, rtol=0)


def test_limbs_and_upper_trunk_keep_their_orientation(bank: MotionBank) -> None:
    one, other = varied(bank, RigConfig(share=1.0))
    changed = (one.axes - other.axes).abs().amax(dim=(0, 1, 2)) > 1e-6
    names = {bank.body.names[j] for j in changed.nonzero()[:, 0]}
    assert names == {"Hips", "Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder"}


def draws(batch: int) -> Draw:
    return Draw(batch, torch.Generator().manual_seed(0), torch.device("cpu"))


def test_a_bend_is_spread_and_a_clavicle_slowed(bank: MotionBank) -> None:
    """Planted: a bend of 40 degrees, all of it at one joint, becomes 10 degrees at each."""
    R = torch.eye(3).repeat(B_RIGS, W_RIGS, 8, 1, 1)
    R[:, :, 4:] = torch.from_numpy(so3.about_axis("y", np.radians(40.0))).float()
    R[:, :, 5] = R[:, :, 4] @ torch.from_numpy(so3.about_axis("x", 0.3)).float()
    axes = R[..., [0, 2]].permute(0, 3, 1, 4, 2)
    out = turns(axes, replace(STILL, mobility=(0.5, 0.5)), draws(B_RIGS)) @ R
    bend = log(out[:, :, :5])[0, 0]
    np.testing.assert_allclose(bend[:, 1].rad2deg(), [0, 10, 20, 30, 40], atol=1e-3)
    clavicle = log(out[:, :, 4].transpose(-1, -2) @ out[:, :, 5])
    np.testing.assert_allclose(clavicle[0, 0], [0.15, 0, 0], atol=1e-5)


def test_turns_are_constant_over_a_still_window_and_have_their_sizes(bank: MotionBank) -> None:
    axes = torch.eye(3)[:, [0, 2]].reshape(1, 3, 1, 2, 1).expand(20_000, 3, 3, 2, 8)
    out = log(turns(axes, replace(STILL, pelvis=(0.02, 0.08, 0.03), clavicle=(0.12, 0.0, 0.1)), draws(20_000)))
    assert (out - out[:, :1]).abs().max() < 1e-6
    np.testing.assert_allclose(out[:, 0, 0].std(dim=0), [0.02, 0.08, 0.03], rtol=0.05)
    torch.testing.assert_close(out[:, 0, 5] * torch.tensor([-1.0, 1, -1]), out[:, 0, 6], atol=1e-5, rtol=0)


def test_rotation_vectors_agree_with_a_peer(bank: MotionBank) -> None:
    rotvec = np.random.default_rng(0).normal(size=(40, 5, 3)) * 0.7
    rotvec[0] = 0.0
    R = exp(torch.from_numpy(rotvec))
    np.testing.assert_allclose(R, so3.exp(rotvec), atol=1e-6)
    np.testing.assert_allclose(log(R), so3.log(R.numpy()), atol=1e-6)


@pytest.mark.parametrize("amplitude", [0.2, 2.0])
def test_heading_is_about_the_vertical_of_the_world_whatever_the_amplitude(truth: np.ndarray, amplitude: float) -> None:
    config = replace(NO_ERROR, heading=0.05, amplitude=(amplitude, amplitude))
    error = so3.log(measured_by_sensors(config, truth, BONES) @ np.swapaxes(truth, -1, -2))
    assert np.abs(error[..., :2]).max() < 1e-5
    np.testing.assert_allclose(error[:, 0, :, 2].std(axis=0), 0.05, rtol=0.06)
    correlation = np.corrcoef(error[:, 0, :, 2].T) - np.eye(3)
    assert np.abs(correlation).max() < 0.1, "every sensor has its own"
