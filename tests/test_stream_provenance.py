"""Whatever befalls a stream, a pose says frame by frame who saw it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from benchmarks import harness
from benchmarks.accuracy.faults import FAULTS, NOMINAL
from benchmarks.accuracy.sensor_faults import magnet, with_turned_heading
from benchmarks.accuracy.windows import (
    MIDDLE_HALF_SECOND,
    MIDDLE_SECOND,
    Window,
    bounds,
)
from rtof_kin.mocap import MocapClip
from rtof_kin.pipeline import Reconstruction, ReconstructionSettings, reconstruct
from rtof_kin.recording import Recording
from rtof_kin.simulation import LIMB_SENSORS
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.stream_faults import FaultKind
from rtof_kin.types import Provenance

BODY = SkeletonModel.default()
MOTION = planted.human(BODY, 180)
RECORDING = harness.recorded(
    MocapClip("moving", MOTION.poses, BODY.joint_offsets), 0, "white", LIMB_SENSORS, 0
)
FOREVER: Window = (0.0, np.inf)
BOTH, IMU, CAMERA = Provenance.CAMERA_AND_IMU, Provenance.IMU, Provenance.CAMERA
PRIOR, BRIDGED = Provenance.PRIOR, Provenance.BRIDGED
BESIDE = {"LeftHand": BOTH, "RightHand": BOTH, "LeftFoot": BOTH, "Head": CAMERA, "Hips": CAMERA}
"""Who sees some joints where nothing is wrong."""


@cache
def reconstructed(name: str, mode: str = "sf2", guard: bool = True) -> Reconstruction:
    faulty = FAULTS[name].apply(RECORDING, np.random.default_rng(3))
    settings = ReconstructionSettings(guard_streams=guard)
    return reconstruct(
        faulty, mode=mode, lifter=planted.PlantedLifter(MOTION), settings=settings, calibrate=False
    )


def inside(result: Reconstruction, window: Window, spare: float = 0.0) -> NDArray[np.bool_]:
    """(T,) frames of a window, made wider by some seconds."""
    start, stop = bounds(RECORDING.video.times, window)
    times = result.motion.times
    return np.asarray((times >= start - spare - 1e-9) & (times < stop + spare - 1e-9))


NOBODY_SEEN = {"LeftHand": IMU, "RightHand": IMU, "LeftFoot": IMU, "Head": PRIOR, "Hips": PRIOR}
CASES: list[tuple[str, Window, dict[str, Provenance]]] = [
    ("left arm and leg unseen for 1 s", MIDDLE_SECOND, {"LeftHand": IMU, "LeftFoot": IMU}),
    ("person out of the picture for 1 s", MIDDLE_SECOND, NOBODY_SEEN),
    ("somebody else followed for 0.5 s", MIDDLE_HALF_SECOND, NOBODY_SEEN),
    ("0.5 s of frames lost, stamps jitter", MIDDLE_HALF_SECOND, NOBODY_SEEN),
    ("left and right exchanged for 0.5 s", MIDDLE_HALF_SECOND, {}),
    ("left and right leg exchanged for 0.5 s", MIDDLE_HALF_SECOND, {}),
    ("left forearm's sensor missing", (-np.inf, np.inf), {"LeftHand": CAMERA}),
    ("left forearm's sensor stops halfway", FOREVER, {"LeftHand": CAMERA}),
    ("left forearm's sensor sticks halfway", FOREVER, {"LeftHand": CAMERA}),
    (
        "all sensors stop halfway", FOREVER,
        {"LeftHand": CAMERA, "RightHand": CAMERA, "LeftFoot": CAMERA},
    ),
    ("accelerometers saturate at 2 g", FOREVER, {}),
    ("packets twice and late, counter wraps", FOREVER, {}),
    ("sensors of 40 and 100 Hz, clocks of their own", FOREVER, {}),
]  # fmt: skip


@pytest.mark.parametrize("name, window, expected", CASES, ids=[case[0] for case in CASES])
def test_who_saw_a_joint_in_a_fault_and_beside_it(
    name: str, window: Window, expected: dict[str, Provenance]
) -> None:
    result = reconstructed(name)
    poses = result.motion.poses
    # At both ends of the recording a sensor may not have begun; a frame at an edge may go either way.
    usual = slice(3, -3)
    during = inside(result, window, -0.04)[usual]
    beside = ~inside(result, window, 0.04)[usual]
    for joint, who in BESIDE.items():
        seen = poses.provenance[usual, BODY.names.index(joint)]
        assert np.all(seen[during] == expected.get(joint, who)), joint
        assert np.all(seen[beside] == who), joint


@pytest.mark.parametrize("name, window, expected", CASES, ids=[case[0] for case in CASES])
def test_what_turns_about_a_segment_is_told_as_seen_where_it_was(
    name: str, window: Window, expected: dict[str, Provenance]
) -> None:
    result = reconstructed(name)
    usual = slice(3, -3)
    during = inside(result, window, -0.04)[usual]
    observed = result.motion.poses.orientation_observed[usual]
    forearm = observed[:, BODY.names.index("LeftForeArm")]
    by_sensor = expected.get("LeftHand", BOTH) in (BOTH, IMU)
    assert np.all(forearm[during] == by_sensor)
    hips = observed[:, BODY.names.index("Hips")]
    assert np.all(hips[during] == (expected.get("Hips", CAMERA) == CAMERA))
    assert not observed[:, BODY.names.index("LeftHand")].any()
    beside = ~inside(result, window, 0.04)[usual]
    assert forearm[beside].all()
    assert hips[beside].all()


def test_packets_lost_for_longer_than_a_tenth_of_a_second_are_no_sensor() -> None:
    for name in ("10 % of packets lost, one by one", "10 % of packets lost, in bursts of 0.5 s"):
        faulty = FAULTS[name].apply(RECORDING, np.random.default_rng(3))
        assert faulty.imus is not None
        s = faulty.imus.names.index("L_LowArm")
        alive = faulty.imus.times[np.isfinite(faulty.imus.f_sensor[:, s, 0])]
        result = reconstructed(name)
        times = result.motion.times
        after = np.clip(np.searchsorted(alive, times), 1, len(alive) - 1)
        gap = alive[after] - alive[after - 1] > 0.1 + 1e-6
        gap &= np.abs(times[:, None] - alive).min(axis=1) > 1e-6
        seen = result.motion.poses.provenance[:, BODY.names.index("LeftHand")]
        usual = (times > alive[0]) & (times < alive[-1])
        np.testing.assert_array_equal(seen[usual] == CAMERA, gap[usual])
        assert gap.any() == ("bursts" in name)


def slipped() -> Recording:
    name = "left forearm's sensor slips by 30 deg halfway"
    return FAULTS[name].apply(RECORDING, np.random.default_rng(3))


def strongly_turned() -> Recording:
    """Half of what a strong magnet does is not told from a moving forearm that hangs down."""
    return with_turned_heading(RECORDING, np.random.default_rng(3), lambda after: 2 * magnet(after))


@pytest.mark.parametrize("make, window", [(slipped, FOREVER), (strongly_turned, MIDDLE_SECOND)])
def test_a_sensor_that_disagrees_is_left_out_from_when_to_when_it_does(
    make: Callable[[], Recording], window: Window
) -> None:
    result = reconstruct(make(), lifter=planted.PlantedLifter(MOTION))
    (fault,) = result.faults
    assert (fault.kind, fault.what) == (FaultKind.DISAGREES, "LeftForeArm")
    start, stop = bounds(RECORDING.video.times, window)
    assert fault.start == pytest.approx(start, abs=0.35)
    assert fault.stop == pytest.approx(min(stop, RECORDING.video.times[-1]), abs=0.35)
    poses = result.motion.poses
    out = (poses.times >= fault.start) & (poses.times <= fault.stop)
    seen = poses.provenance[3:-3, BODY.names.index("LeftHand")]
    np.testing.assert_array_equal(seen == CAMERA, out[3:-3])
    forearm = poses.orientation_observed[3:-3, BODY.names.index("LeftForeArm")]
    np.testing.assert_array_equal(forearm, ~out[3:-3])
    assert result.bone_imus is not None
    left = np.isfinite(result.bone_imus.select(["LeftForeArm"]).a_world).all(axis=(1, 2))
    np.testing.assert_array_equal(left[3:-3], ~out[3:-3])


FOUND = {
    "left and right exchanged for 0.5 s": {FaultKind.SIDES},
    "left and right leg exchanged for 0.5 s": {FaultKind.SIDES},
    "somebody else followed for 0.5 s": {FaultKind.SOMEBODY_ELSE},
    "left forearm's sensor sticks halfway": {FaultKind.STUCK},
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_told_and_nothing_else_is(name: str) -> None:
    assert {fault.kind for fault in reconstructed(name).faults} == FOUND.get(name, set())


def test_a_recording_that_nothing_is_wrong_with_is_reconstructed_to_the_same_bits() -> None:
    guarded, plain = (reconstructed(NOMINAL, "rtof", guard) for guard in (True, False))
    assert guarded.faults == ()
    np.testing.assert_array_equal(guarded.motion.q, plain.motion.q)


def test_faults_are_logged_and_exported(
    caplog: pytest.LogCaptureFixture
) -> None:
    from rtof_kin.export import summary

    faulty = FAULTS["left forearm's sensor sticks halfway"].apply(RECORDING, np.random.default_rng(3))
    result = reconstruct(faulty, mode="sf2", lifter=planted.PlantedLifter(MOTION))
    told = "L_LowArm, 1.52 to 2.97 s: the sensor repeated one sample; it was left out"
    assert f"moving: {told}" in caplog.messages
    assert summary(result)["stream_faults"] == [told]


def test_sensors_alone_are_looked_through_too_and_keypoints_are_not() -> None:
    name = "left forearm's sensor sticks halfway"
    faulty = FAULTS[name].apply(RECORDING, np.random.default_rng(3))
    faulty = FAULTS["somebody else followed for 0.5 s"].apply(faulty, np.random.default_rng(3))
    result = reconstruct(faulty, mode="imu")
    assert {fault.kind for fault in result.faults} == {FaultKind.STUCK}
    late = result.motion.times > 1.6
    seen = result.motion.poses.provenance[:, BODY.names.index("LeftHand")]
    assert not np.isin(seen[late], (IMU, BOTH)).any()


def test_times_that_go_back_are_refused_with_the_place() -> None:
    video = RECORDING.video
    times = video.times.copy()
    times[90:] -= 0.5
    with pytest.raises(ValueError, match=r"time does not increase from index 89"):
        replace(video, times=times)


