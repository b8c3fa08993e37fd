"""One window in NumPy gives what it gives in torch."""

from __future__ import annotations

from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lifting.graph import LifterGraph
from lifting.single_window import SinglePose, SingleWindowLifter

W = 27


def window(seed: int, joints: int, sensors: int) -> list[NDArray[Any]]:
    """Of somebody a few metres ahead, of whom a part is seen and sensed; what is not is arbitrary."""
    rng = np.random.default_rng(seed)
    place = rng.normal(size=(3, 1, 1)) * [[[1.0]], [[1.0]], [[0.3]]]
    rays = place + rng.normal(size=(3, W, joints)) * 0.1
    R = np.linalg.qr(rng.normal(size=(W, sensors, 3, 3)))[0]
    axes = R[..., [0, 2]].transpose(2, 0, 3, 1)
    seen, sensed = (rng.uniform(size=(W, n)) < 0.7 for n in (joints, sensors))
    return [rays.astype(np.float32), seen, axes.astype(np.float32), sensed]


def in_torch(lifter: Any, values: list[NDArray[Any]], bones: Any, height: float, flip: bool) -> Any:
    """The same by `LifterGraph`, as arrays."""
    rays, seen, axes, sensed = values
    R = np.zeros((*sensed.shape, 3, 3), np.float32)
    R[..., [0, 2]] = axes.transpose(1, 3, 0, 2)
    graph = LifterGraph(lifter.description.body, lifter.network, flip)
    arrays = [rays.transpose(1, 2, 0), seen, bones.astype(np.float32), np.float32(height), R, sensed]
    with torch.inference_mode():
        return [x[0].numpy() for x in graph(*(torch.from_numpy(np.array(a)[None]) for a in arrays))]


def assert_same(found: SinglePose, wanted: Any) -> None:
    pose, root, sigma, R, turn = wanted
    np.testing.assert_allclose(found.p_camera_joint, pose + root, rtol=2e-6, atol=1e-5)
    np.testing.assert_allclose(found.sigma_m, sigma, rtol=1e-4, atol=1e-5)
    if found.R_world_bone is None or found.sigma_rad is None:
        assert R.size == turn.size == 0
        return
    np.testing.assert_allclose(found.R_world_bone, R, atol=1e-4)
    np.testing.assert_allclose(found.sigma_rad, turn, rtol=1e-4, atol=1e-5)


def checked(lifter: Any, values: list[NDArray[Any]], told: bool = True, flip: bool = True) -> None:
    body = lifter.description.body
    bones = np.array(body.nominal_bones) * 1.1 if told else np.full(len(body.nominal_bones), np.nan)
    height = 1.6 if told else np.nan
    found = SingleWindowLifter(body, lifter.network, bones, height, flip)(*values)
    assert_same(found, in_torch(lifter, values, bones, height, flip))


@pytest.mark.parametrize("table", [support.TABLE, support.TABLE_17])
@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("told", [True, False])
def test_numpy_and_torch_agree_on_random_windows(table: Any, causal: bool, told: bool) -> None:
    lifter = support.untrained_lifter(table=table, causal=causal)
    body = lifter.description.body
    for seed in range(20):
        values = window(seed, len(body.names), len(body.sensors))
        checked(lifter, values, told, flip=seed % 2 == 0)


def test_they_agree_where_little_is_seen_and_straight_overhead() -> None:
    lifter = support.untrained_lifter(causal=True)
    rays, seen, axes, sensed = window(0, 21, 13)
    hips_alone, late, nobody = np.zeros_like(seen), seen.copy(), np.zeros_like(seen)
    hips_alone[20, lifter.description.body.hips] = True
    late[5:] = False
    above = rays - rays[:, -1:, :1] + np.array([0.0, 0.0, 1.0], np.float32)[:, None, None]
    seen[-1, 0] = True
    for values in (
        [rays, hips_alone, axes, sensed], [rays, late, axes, sensed], [rays, nobody, axes, sensed],
        [above, seen, axes, sensed], [rays, seen, axes, np.zeros_like(sensed)],
    ):  # fmt: skip
        checked(lifter, values)
    point = np.broadcast_to(rays[:, :1, :1], rays.shape).copy()
    bones = np.array(lifter.description.body.nominal_bones)
    lift = SingleWindowLifter(lifter.description.body, lifter.network, bones, 1.6)
    for part in lift(point, seen, axes, sensed):
        assert np.isfinite(part).all()


def test_a_camera_hardly_over_the_floor_tells_no_footing() -> None:
    lifter = support.untrained_lifter()
    body, values = lifter.description.body, window(1, 21, 13)
    bones = np.array(body.nominal_bones)
    for height in (0.1, 0.14, 3.0):
        found = SingleWindowLifter(body, lifter.network, bones, height)(*values)
        assert_same(found, in_torch(lifter, values, bones, height, True))
