"""What a recording shows at any time, before it is encoded."""

from __future__ import annotations

from dataclasses import replace

import lifting_support as support
import numpy as np
import pytest
from numpy.typing import NDArray

from lifting.body import Body
from lifting.source import Source
from lifting.windows import Windows
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
T, W = 60, 27
ARMS = ("LeftForeArm", "RightForeArm", "Hips")


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


@pytest.fixture(scope="module")
def keypoints() -> KeypointSequence:
    return support.seen_by(support.side_camera(), support.positions(0, T))


@pytest.fixture(scope="module")
def imus() -> BoneImuSequence:
    return support.worn_by(0, T, ARMS)


def windows(source: Source, times: Array, estimated: int = W // 2, rate_hz: float = 60.0) -> Windows:
    return source.windows(times, W, estimated, rate_hz, np.full(39, 0.1), 1.5)


def axes_of(body: Body, shown: Windows, joint: str) -> Array:
    """(B, W, 3, 2) of one sensor."""
    axes = shown.axes_world[..., body.sensors.index(joint)]
    return axes.permute(0, 2, 1, 3).double().numpy()


def test_each_sensor_has_the_index_of_its_segment(
    body: Body, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    source = Source.of(body, keypoints, imus)
    sensed = [name for s, name in enumerate(body.sensors) if source.sensed[:, s].all()]
    assert set(sensed) == set(ARMS)
    assert source.sensed.sum() == T * 3
    shown = windows(source, keypoints.times[20:30])
    for s, joint in enumerate(ARMS):
        R = np.array(imus.R_world_bone[:, s])[..., [0, 2]]
        np.testing.assert_allclose(axes_of(body, shown, joint)[:, W // 2], R[20:30], atol=1e-6)
        np.testing.assert_allclose(axes_of(body, shown, joint)[0, 3], R[10], atol=1e-6)


@pytest.mark.parametrize("estimated", [W // 2, W - 1])
def test_windows_surround_the_estimated_frame(
    body: Body, keypoints: KeypointSequence, imus: BoneImuSequence, estimated: int
) -> None:
    source = Source.of(body, keypoints, imus)
    shown = windows(source, keypoints.times[30:34], estimated)
    assert shown.estimated == estimated
    for b in range(4):
        first = 30 + b - estimated
        rays = source.rays[first : first + W]
        np.testing.assert_array_equal(shown.rays_world[b].permute(1, 2, 0).numpy(), rays)
        axes = source.axes[first : first + W]
        np.testing.assert_array_equal(shown.axes_world[b].permute(1, 2, 3, 0).numpy(), axes)
    np.testing.assert_allclose(shown.bones.numpy(), 0.1)
    np.testing.assert_allclose(shown.camera_height.numpy(), 1.5)


def test_the_first_and_last_frames_are_repeated(
    body: Body, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    source = Source.of(body, keypoints, imus)
    shown = windows(source, keypoints.times[[0, -1]])
    axes = axes_of(body, shown, "Hips")
    for b, inside in ((0, slice(0, 14)), (1, slice(13, 27))):
        np.testing.assert_array_equal(axes[b, inside], np.repeat(axes[b, 13:14], 14, axis=0))
        assert shown.sensed[b, :, body.sensors.index("Hips")].all()


def test_missing_samples_are_zero_and_not_sensed(
    body: Body, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    R = np.array(imus.R_world_bone)
    R[10:20, 1] = np.nan
    source = Source.of(body, keypoints, replace(imus, R_world_bone=R))
    s = body.sensors.index("RightForeArm")
    assert np.flatnonzero(~source.sensed[:, s]).tolist() == list(range(10, 20))
    assert np.isfinite(source.axes).all()
    assert np.abs(source.axes[10:20, :, s]).max() == 0
    assert source.sensed[:, body.sensors.index("LeftForeArm")].all()
    shown = windows(source, keypoints.times[15:16])
    assert (~shown.sensed[0, :, s]).nonzero().flatten().tolist() == list(range(8, 18))


def test_between_frames_a_sensor_needs_both(
    body: Body, keypoints: KeypointSequence, imus: BoneImuSequence
) -> None:
    R = np.array(imus.R_world_bone)
    R[20, 0] = np.nan
    source = Source.of(body, keypoints, replace(imus, R_world_bone=R))
    s = body.sensors.index("LeftForeArm")
    shown = windows(source, keypoints.times[20:21] + 0.5 / 60)
    assert (~shown.sensed[0, :, s]).nonzero().flatten().tolist() == [12, 13]
    h = body.sensors.index("Hips")
    between = (source.axes[20, :, h] + source.axes[21, :, h]) / 2
    np.testing.assert_allclose(shown.axes_world[0, :, 13, :, h].numpy().T, between, atol=1e-5)
