"""Training windows' orientations: with sensors without errors they are the truth, whatever is drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting.training.corpus import Corpus
from lifting.training.data import AugmentConfig, Batch, MotionBank, plain
from lifting.training.noise import SensorConfig
from lifting.windows import rotations
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
B, W = 48, 27
T = 90
"""Frames in each clip."""
CPU = torch.device("cpu")
MIRROR = np.diag([1.0, -1.0, 1.0])
EXACT = SensorConfig(
    none=0.0,
    limbs=0.0,
    limbs_and_trunk=0.0,
    ends=0.0,
    every=1.0,
    amplitude=(1.0, 1.0),
    misalignment=0.0,
    roll=0.0,
    heading=0.0,
    lag=(0.0, 0.0),
    missing=0.0,
)
"""Everything is worn and nothing wrong."""
PLAIN = replace(plain(), sensors=EXACT)
EVERYTHING = replace(AugmentConfig(), sensors=EXACT, noise=plain().noise, warp=(1.0, 1.0), recombine=0.0)
HALF_A_FRAME = 0.05
"""Bound on the rotation within half a frame; sensors are taken from the nearest frame."""


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus(frames=T)


@pytest.fixture(scope="module")
def bank(corpus: Corpus) -> MotionBank:
    return MotionBank(corpus, [0, 1], CPU)


def draw(bank: MotionBank, config: AugmentConfig, frames: Tensor | None = None, causal: bool = False) -> Batch:
    return bank.draw(B, W, config, torch.Generator().manual_seed(1), frames, causal)


def matrices(axes: Tensor) -> Array:
    """Rotations (..., n, 3, 3), the batch first, of axes (B, 3, ..., 2, n)."""
    R = rotations(axes.movedim(1, -3) if axes.ndim == 5 else axes)
    return R.movedim(-1, -3).double().numpy()


def recorded(corpus: Corpus, at: Array) -> Array:
    """Rotations (..., J, 3, 3) of the first clip at frames, on the geodesic between them."""
    at = np.clip(at, 0, T - 1)
    low = np.minimum(np.floor(at).astype(int), T - 2)
    R = corpus.R_world_bone[:T].astype(float)
    turn = so3.log(np.swapaxes(R[low], -1, -2) @ R[low + 1])
    return np.asarray(R[low] @ so3.exp((at - low)[..., None, None] * turn))


def sensed_truth(
    corpus: Corpus, batch: Batch, frames: Tensor, speed: float = 1.0, lag: float = 0.0, mirrored: bool = False
) -> Array:
    """What sensors must say (B, W, S, 3, 3), from the recording and the heading of the estimated pose."""
    body, at = corpus.body(), frames.numpy().astype(float)

    def motion(at: Array) -> Array:
        R = recorded(corpus, at)
        return MIRROR @ R[..., body.mirrored, :, :] @ MIRROR if mirrored else R

    now = matrices(batch.axes)
    R_drawn_recorded = now[:, 0] @ np.swapaxes(motion(at)[:, 0], -1, -2)
    steps = np.arange(W) - batch.windows.estimated
    R = motion(at[:, None] + speed * steps + lag)[:, :, body.sensor_joints]
    return np.asarray(R_drawn_recorded[:, None, None] @ R)


FRAMES = torch.randint(20, T - 20, (B,), generator=torch.Generator().manual_seed(0))


def assert_sensed(corpus: Corpus, batch: Batch, atol: float = 2e-5, **how: Any) -> None:
    assert batch.windows.sensed.all()
    expected = sensed_truth(corpus, batch, FRAMES, **how)
    np.testing.assert_allclose(matrices(batch.windows.axes_world), expected, atol=atol)


# --- without errors ------------------------------------------------------------------------------


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize(
    "changes, how",
    [
        ({}, {}),
        ({"warp": (0.63, 0.63)}, {"speed": 0.63, "atol": HALF_A_FRAME}),
        ({"mirror": 1.0}, {"mirrored": True}),
        ({"tilt": 1.0}, {}),
        ({"own_skeleton": 0.0, "bone_scale": 0.1, "overall_scale": 0.1}, {}),
    ],
    ids=["plain", "re-timed", "mirrored", "tilted", "other proportions"],
)
def test_sensors_without_errors_measure_the_true_axes_at_every_frame(
    corpus: Corpus, causal: bool, changes: dict[str, Any], how: dict[str, Any]
) -> None:
    bank = MotionBank(corpus, [0], CPU, [support.TABLE.offsets.astype(np.float32) * 1.3])
    batch = draw(bank, replace(PLAIN, **changes), FRAMES, causal)
    assert_sensed(corpus, batch, **how)
    if "speed" in how:
        with pytest.raises(AssertionError):
            assert_sensed(corpus, batch, HALF_A_FRAME, speed=1.0)


ASKEW = support.TABLE.offsets + np.array([0.03, 0.0, 0.02]) * (np.arange(21) > 0)[:, None]
"""Offsets of bones with other directions, left and right alike."""
HOW = {
    "everything else": (EVERYTHING, support.TABLE.offsets, False),
    "causal": (EVERYTHING, support.TABLE.offsets, True),
    "another body": (replace(EVERYTHING, own_skeleton=0.0), ASKEW, False),
    "recombined": (replace(EVERYTHING, recombine=1.0, own_skeleton=0.0), ASKEW, False),
}


@pytest.mark.parametrize("how", HOW)
def test_every_frames_rays_and_sensors_are_of_one_body(corpus: Corpus, how: str) -> None:
    """A bone lies in the plane of the rays to its ends: at every frame, not at the estimated one."""
    config, offsets, causal = HOW[how]
    bank = MotionBank(corpus, [0, 1], CPU, [offsets.astype(np.float32)])
    batch = draw(bank, config, causal=causal)
    rays = so3.unit(batch.windows.rays_world.permute(0, 2, 3, 1).double().numpy())
    seen, R = batch.windows.seen.numpy(), matrices(batch.windows.axes_world)
    wrong, body = [], bank.body
    for s, j in enumerate(body.sensor_joints):
        children = [c for c, parent in enumerate(body.parents) if parent == j]
        if len(children) != 1:
            continue
        normal = np.cross(rays[:, :, j], rays[:, :, children[0]])
        read = seen[:, :, j] & seen[:, :, children[0]] & (np.linalg.norm(normal, axis=-1) > 0.03)
        bone = R[:, :, s] @ so3.unit(offsets[children[0]])
        out = np.abs(np.sum(so3.unit(normal + 1e-12) * bone, axis=-1))
        assert read.mean() > 0.3
        wrong.append(out[read])
    assert np.concatenate(wrong).max() < 3e-3


def test_recombined_motions_have_one_heading(corpus: Corpus, bank: MotionBank) -> None:
    """The other motion is turned until its own pelvis faces as this one does."""
    turned = replace(
        corpus,
        R_world_bone=np.concatenate(
            [corpus.R_world_bone[:T], so3.about_axis("z", 2.0) @ corpus.R_world_bone[T:]]
        ).astype(np.float32),
    )
    names, apart = bank.body.names, []
    for motion in (corpus, turned):
        R = matrices(draw(MotionBank(motion, [0, 1], CPU), replace(PLAIN, recombine=1.0)).axes)
        hips, chest = R[:, names.index("Hips")], R[:, names.index("Spine3")]
        apart.append(np.swapaxes(hips, -1, -2) @ chest)
    np.testing.assert_allclose(*apart, atol=1e-4)


# --- lag, losses, shares -------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [5.0, -3.0, 1.5])
def test_sensors_lead_the_camera_by_their_lag(corpus: Corpus, bank: MotionBank, lag: float) -> None:
    config = replace(PLAIN, sensors=replace(EXACT, lag=(lag, lag)))
    batch = draw(bank, config, FRAMES)
    assert_sensed(corpus, batch, HALF_A_FRAME if lag % 1 else 2e-5, lag=lag)
    with pytest.raises(AssertionError):
        assert_sensed(corpus, batch, HALF_A_FRAME, lag=-lag)
