"""Which sensors are worn, and errors of their orientations with the sizes that are configured."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.body import Body
from lifting.training.joint_errors import Draw, cross, rotation
from lifting.training.noise import SensorConfig, with_errors, worn
from rtof_kin.core import rotations as so3

B, W = 2000, 4
DEFAULT = SensorConfig()
NO_ERROR = replace(DEFAULT, amplitude=(1.0, 1.0), misalignment=0.0, roll=0.0, heading=0.0)
LIMBS = {side + part for side in ("Left", "Right") for part in ("Arm", "ForeArm", "UpLeg", "Leg")}
ENDS = {side + part for side in ("Left", "Right") for part in ("ForeArm", "Leg")}


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


def draws(batch: int, seed: int = 0) -> Draw:
    return Draw(batch, torch.Generator().manual_seed(seed), torch.device("cpu"))


def measured_by_sensors(config: SensorConfig, R: np.ndarray, bones: Tensor, seed: int = 0) -> np.ndarray:
    """Rotations (B, W, S, 3, 3) as sensors report them whose true ones are R (B, W, S, 3, 3)."""
    axes = torch.from_numpy(R[..., [0, 2]]).permute(0, 3, 1, 4, 2).float()
    measured = with_errors(bones, axes, config, draws(len(R), seed))
    assert measured.shape == axes.shape
    x, z = np.moveaxis(measured.double().numpy(), (1, 3), (4, 0))
    return np.stack([x, np.cross(z, x), z], axis=-1)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Any rotations (B, W, 3, 3, 3) of three sensors."""
    return so3.exp(np.random.default_rng(0).normal(size=(B, W, 3, 3)))


BONES = torch.tensor([[0.0, 0.0, -1.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.0]])
"""Along z, askew, and a segment that is not one bone."""


# --- errors --------------------------------------------------------------------------------------


def test_without_errors_the_true_axes_are_measured(truth: np.ndarray) -> None:
    np.testing.assert_allclose(measured_by_sensors(NO_ERROR, truth, BONES), truth, atol=1e-6)


def in_segment(config: SensorConfig, truth: np.ndarray) -> np.ndarray:
    """Errors (B, W, S, 3) as rotation vectors in the segments' own frames."""
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


@pytest.mark.parametrize("amplitude", [0.2, 2.0])
def test_heading_is_about_the_vertical_of_the_world_whatever_the_amplitude(truth: np.ndarray, amplitude: float) -> None:
    config = replace(NO_ERROR, heading=0.05, amplitude=(amplitude, amplitude))
    error = so3.log(measured_by_sensors(config, truth, BONES) @ np.swapaxes(truth, -1, -2))
    assert np.abs(error[..., :2]).max() < 1e-5
    np.testing.assert_allclose(error[:, 0, :, 2].std(axis=0), 0.05, rtol=0.06)
    correlation = np.corrcoef(error[:, 0, :, 2].T) - np.eye(3)
    assert np.abs(correlation).max() < 0.1, "every sensor has its own"


def test_rotation_and_cross_product_agree_with_peers() -> None:
    rotvec = np.random.default_rng(1).normal(size=(50, 3))
    rotvec[0], rotvec[1] = 0.0, 1e-9
    out = rotation(torch.from_numpy(rotvec)).numpy()
    np.testing.assert_allclose(out, so3.exp(rotvec), atol=1e-7)
    a, b = torch.randn(2, 4, 3, 5, 6)
    torch.testing.assert_close(cross(a, b), torch.linalg.cross(a, b, dim=1))


# --- which are worn ------------------------------------------------------------------------------


def sets(body: Body, config: SensorConfig, batch: int = 20_000) -> list[frozenset[str]]:
    mask = worn(body, config, draws(batch, 4))
    assert mask.shape == (batch, len(body.sensors))
    names = np.array(body.sensors)
    return [frozenset(names[row]) for row in mask.numpy()]


ONLY: dict[str, set[str]] = {"none": set(), "limbs": LIMBS, "limbs_and_trunk": LIMBS | {"Hips", "Spine3"}, "ends": ENDS}


@pytest.mark.parametrize("name", [*ONLY, "every"])
def test_sets_have_the_sensors_of_their_name(body: Body, name: str) -> None:
    shares = dict.fromkeys(("none", "limbs", "limbs_and_trunk", "ends", "every"), 0.0)
    config = replace(DEFAULT, **(shares | {name: 1.0}))
    assert set(sets(body, config, 300)) == {frozenset(ONLY.get(name, set(body.sensors)))}


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
