"""Faults of a recording, one at a time, with unchanged truth.

Faults of streams are in `sensor_faults` and `video_faults`; here are those of what is believed of body,
camera and mounting, and the list of all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.accuracy import sensor_faults as streams
from benchmarks.accuracy import video_faults as video
from benchmarks.accuracy.video_faults import LEFT_LIMBS, LEGS, LIMBS
from benchmarks.accuracy.windows import MIDDLE_HALF_SECOND, MIDDLE_SECOND, SECOND_AFTER_HALF, Window
from rtof_kin.core import rotations as so3
from rtof_kin.recording.recording import Recording

NOMINAL = "nominal"
_FOREARM = ("LeftForeArm", "LeftHand")


def with_randomly_wrong_bones(recording: Recording, rng: Generator) -> Recording:
    """Each bone believed too long or too short by a random share, 3 % standard deviation."""
    factor = 1 + 0.03 * rng.standard_normal((len(recording.joint_offsets), 1))
    return replace(recording, joint_offsets=recording.joint_offsets * factor)


def with_long_bones(recording: Recording, rng: Generator) -> Recording:
    """All bones believed 3 % too long."""
    return replace(recording, joint_offsets=recording.joint_offsets * 1.03)


def with_changed_camera(recording: Recording, **changes: Any) -> Recording:
    """The first camera with other fields."""
    camera = replace(recording.video.camera, **changes)
    return replace(recording, keypoints=replace(recording.video, camera=camera))


def with_wrong_focal_length(recording: Recording, rng: Generator) -> Recording:
    """A focal length believed 2 % too long."""
    camera = recording.video.camera
    K = camera.K * np.array([[1.02], [1.02], [1.0]])
    K[:, 2] = camera.K[:, 2]
    return with_changed_camera(recording, K=K)


def with_tilted_camera(recording: Recording, rng: Generator) -> Recording:
    """A camera that is believed to look 1 deg lower or higher, from the place where it is."""
    camera = recording.video.camera
    R = so3.about_axis("x", np.radians(1.0)) @ camera.R_camera_world
    return with_changed_camera(recording, R_camera_world=R, t_camera_world=-R @ camera.center_world)


def with_wrong_heading(recording: Recording, rng: Generator) -> Recording:
    """All sensors' references believed turned by 10 deg about the vertical, all alike."""
    own = recording.calibration
    assert own is not None
    R = so3.about_axis("z", np.radians(10.0)) @ own.R_world_inertial
    return replace(recording, calibration=replace(own, R_world_inertial=R))


def with_wrong_mounting(recording: Recording, rng: Generator) -> Recording:
    """Each sensor believed mounted as it is not, by random 6 deg about each axis."""
    own = recording.calibration
    assert own is not None
    turn = so3.exp(np.radians(6.0) * rng.standard_normal((len(own.sensors), 3)))
    return replace(recording, calibration=replace(own, R_sensor_bone=own.R_sensor_bone @ turn))


@dataclass(frozen=True)
class Fault:
    """Something wrong, and where in time it is looked at."""

    apply: Callable[[Recording, Generator], Recording]
    """Another recording with the same truth; equal draws give equal faults."""
    window: Window | None = None
    """Interval, s after the middle of the video, before, in and after which errors are reported."""
    joints: tuple[str, ...] = ()
    """Joints whose error is reported there besides that of all joints."""


def _of_one_sensor(apply: Callable[[Recording, Generator], Recording], window: Window) -> Fault:
    return Fault(apply, window, _FOREARM)


FAULTS = {
    NOMINAL: Fault(lambda recording, rng: recording),
    "10 % outliers of 80 px": Fault(video.with_outliers),
    "left arm and leg unseen for 1 s": Fault(partial(video.with_unseen, names=LEFT_LIMBS), MIDDLE_SECOND, LEFT_LIMBS),
    "person out of the picture for 1 s": Fault(video.with_unseen, MIDDLE_SECOND, LIMBS),
    "left and right exchanged for 0.5 s": Fault(video.with_sides_exchanged, MIDDLE_HALF_SECOND, LIMBS),
    "left and right leg exchanged for 0.5 s": Fault(
        partial(video.with_sides_exchanged, left=LEGS), MIDDLE_HALF_SECOND, LEGS
    ),
    "somebody else followed for 0.5 s": Fault(video.with_somebody_else, MIDDLE_HALF_SECOND, LIMBS),
    "0.5 s of frames lost, stamps jitter": Fault(video.with_lost_frames, MIDDLE_HALF_SECOND, LIMBS),
    "video's clock jumps by 100 ms halfway": Fault(video.with_jumping_clock, SECOND_AFTER_HALF, LIMBS),
    "sensors of 40 and 100 Hz, clocks of their own": Fault(streams.with_clocks_of_their_own),
    "10 % of packets lost, one by one": Fault(streams.with_lost_packets),
    "10 % of packets lost, in bursts of 0.5 s": Fault(streams.with_lost_bursts),
    "packets twice and late, counter wraps": Fault(streams.with_repeated_packets),
    "accelerometers saturate at 2 g": Fault(streams.with_saturated_accelerometers),
    "left forearm's sensor missing": Fault(streams.without_sensor),
    "left forearm's sensor stops halfway": _of_one_sensor(
        partial(streams.with_stopped_sensors, names=(streams.ONE,)), SECOND_AFTER_HALF
    ),
    "left forearm's sensor sticks halfway": _of_one_sensor(streams.with_stuck_sensor, SECOND_AFTER_HALF),
    "left forearm's sensor slips by 30 deg halfway": _of_one_sensor(streams.with_slipped_sensor, SECOND_AFTER_HALF),
    "left forearm's heading off by 40 deg for 1 s": _of_one_sensor(
        partial(streams.with_turned_heading, degrees=streams.magnet), MIDDLE_SECOND
    ),
    "left forearm's heading drifts by 20 deg from halfway": _of_one_sensor(
        partial(streams.with_turned_heading, degrees=streams.drift), SECOND_AFTER_HALF
    ),
    "all sensors stop halfway": Fault(streams.with_stopped_sensors, SECOND_AFTER_HALF, LIMBS),
    "bones wrong by 3 % at random": Fault(with_randomly_wrong_bones),
    "all bones 3 % too long": Fault(with_long_bones),
    "focal length + 2 %": Fault(with_wrong_focal_length),
    "camera tilted by 1 deg": Fault(with_tilted_camera),
    "video late by 33 ms": Fault(partial(video.with_late_video, delay=1 / 30)),
    "video late by 100 ms": Fault(partial(video.with_late_video, delay=0.1)),
    "headings off by 10 deg": Fault(with_wrong_heading),
    "mounting off by 6 deg per axis": Fault(with_wrong_mounting),
}
