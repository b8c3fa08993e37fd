"""Gross faults of files and conventions, each of one size, and a part of the cause that is to name it.

A fault that a recording cannot have returns the recording itself, or raises `ValueError`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.faults import with_changed_camera
from benchmarks.planted.faults import Fault, with_imus
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.checks.camera import UNVERIFIED
from rtof_kin.reconstruction.checks.image import exchanged_axes, exchanged_sides, mirrored, upside_down
from rtof_kin.recording.recording import Recording

Plant = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Gross:
    """A gross fault."""

    plant: Plant
    named: str
    """Part of the cause that names it."""


def seen(change: Callable[[KeypointSequence], KeypointSequence]) -> Plant:
    """A mistake in the keypoints."""
    return lambda r: replace(r, keypoints=change(r.video))


def camera(**changes: Callable[[Any], Any]) -> Plant:
    """A mistake in fields of the camera."""

    def plant(recording: Recording) -> Recording:
        given = recording.video.camera
        fields = {name: change(getattr(given, name)) for name, change in changes.items()}
        return with_changed_camera(recording, **fields)

    return plant


def focal(factor: float) -> Plant:
    """A wrong focal length."""
    return camera(K=lambda K: K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def floor(higher: float) -> Plant:
    """A floor that is not where the person stands."""
    return lambda r: replace(r, floor_height=(r.floor_height or 0.0) + higher)


def turned(clockwise: bool) -> Plant:
    """A video that was turned by 90 degrees."""

    def change(k: KeypointSequence) -> KeypointSequence:
        u, v = k.uv_px[..., 0], k.uv_px[..., 1]
        width, height = k.camera.width_px, k.camera.height_px
        uv = np.stack([height - v, u] if clockwise else [v, width - u], axis=-1)
        return replace(k, uv_px=uv)

    return seen(change)


def frozen(k: KeypointSequence) -> KeypointSequence:
    """A detector that repeats one frame for a second, or two thirds of a shorter recording."""
    first = len(k) // 3
    held = (k.times >= k.times[first]) & (k.times <= k.times[first] + 1.0)
    uv, confidence = k.uv_px.copy(), k.confidence.copy()
    uv[held], confidence[held] = uv[first], confidence[first]
    return replace(k, uv_px=uv, confidence=confidence)


OF_CAMERA: Final[dict[str, Gross]] = {
    "camera's translation in mm": Gross(camera(t_camera_world=lambda t: 1000 * t), "millimetres"),
    "focal length x 0.5": Gross(focal(0.5), "focal length"),
    "focal length x 1.2": Gross(focal(1.2), "focal length"),
    "bones x 1.2": Gross(lambda r: replace(r, joint_offsets=1.2 * r.joint_offsets), "bones"),
    "floor 1 m too high": Gross(floor(1.0), "floor"),
    "floor 1 m too low": Gross(floor(-1.0), "floor"),
    "keypoints of a half-size picture": Gross(seen(lambda k: replace(k, uv_px=k.uv_px / 2)), "picture 2 times smaller"),
    "names of left and right exchanged": Gross(seen(exchanged_sides), "left and right"),
    "mirrored picture": Gross(seen(mirrored), "picture is mirrored"),
    "u and v exchanged": Gross(seen(exchanged_axes), "u and v"),
    "world y up": Gross(camera(R_camera_world=lambda R: R @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]), "+y points up"),
    "upside down": Gross(seen(upside_down), "upside down"),
    "turned by 90 degrees": Gross(turned(True), "90 degrees clockwise"),
    "turned by -90 degrees": Gross(turned(False), "90 degrees anticlockwise"),
    "frozen keypoints": Gross(seen(frozen), "frozen"),
    "assumed pose of the camera": Gross(camera(assumed=lambda _: ("pose",)), UNVERIFIED),
}


def _flipped(imus: ImuSequence) -> dict[str, Any]:
    return {"f_sensor": -imus.f_sensor}


def _without_gravity(imus: ImuSequence) -> dict[str, Any]:
    return {"f_sensor": imus.f_sensor - 9.81 * imus.R_inertial_sensor[..., 2, :]}


def _as_xyzw(imus: ImuSequence) -> dict[str, Any]:
    R = imus.R_inertial_sensor.copy()
    known = np.isfinite(R).all(axis=(-2, -1))
    R[known] = so3.from_quat_wxyz(np.roll(so3.to_quat_wxyz(R[known]), -1, axis=-1))
    return {"R_inertial_sensor": R}


def _inverted(imus: ImuSequence) -> dict[str, Any]:
    return {"R_inertial_sensor": np.swapaxes(imus.R_inertial_sensor, -1, -2)}


def _frozen(share: float, sensors: slice) -> Callable[[ImuSequence], dict[str, Any]]:
    """The last share of the samples repeats one."""

    def changed(imus: ImuSequence) -> dict[str, Any]:
        R, f = imus.R_inertial_sensor.copy(), imus.f_sensor.copy()
        known = np.isfinite(f).all(axis=(1, 2))
        first = max(round((1 - share) * len(f)), int(np.argmax(known)))
        R[first:, sensors], f[first:, sensors] = R[first, sensors], f[first, sensors]
        return {"R_inertial_sensor": R, "f_sensor": f}

    return changed


def _samples(change: Callable[[ImuSequence], dict[str, Any]]) -> Plant:
    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        return with_imus(recording, **change(recording.imus))

    return plant


def _late(seconds: float) -> Plant:
    """The sensors' stamps are late by so much."""

    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        return with_imus(recording, times=recording.imus.times + seconds)

    return plant


def _pairs(recording: Recording, left: str, right: str) -> list[tuple[int, int]]:
    """Indices of sensors in the calibration; of sides, all pairs."""
    assert recording.calibration is not None
    joints = recording.calibration.joints
    pairs = [(a, a.replace(left, right)) for a in joints if a.startswith(left)] if left == "Left" else [(left, right)]
    return [(joints.index(a), joints.index(b)) for a, b in pairs]


def _samples_swapped(left: str, right: str) -> Plant:
    """Each other's samples under two sensors' names."""

    def plant(recording: Recording) -> Recording:
        assert recording.imus is not None
        assert recording.calibration is not None
        order = list(range(len(recording.imus.names)))
        for a, b in _pairs(recording, left, right):
            a, b = (recording.imus.names.index(recording.calibration.sensors[s]) for s in (a, b))
            order[a], order[b] = b, a
        R, f = recording.imus.R_inertial_sensor[:, order], recording.imus.f_sensor[:, order]
        return with_imus(recording, R_inertial_sensor=R, f_sensor=f)

    return plant


def _segments_swapped(left: str, right: str) -> Plant:
    """Two sensors, each with its own calibration, declared on each other's segments."""

    def plant(recording: Recording) -> Recording:
        assert recording.calibration is not None
        order = list(range(len(recording.calibration.joints)))
        for a, b in _pairs(recording, left, right):
            order[a], order[b] = b, a
        joints = tuple(recording.calibration.joints[s] for s in order)
        levers = recording.calibration.p_bone_sensor[order]
        return replace(recording, calibration=replace(recording.calibration, joints=joints, p_bone_sensor=levers))

    return plant


_FOREARMS, _SIDES = ("LeftForeArm", "RightForeArm"), ("Left", "Right")
_ARM_THIGH, _ARM = ("LeftArm", "RightUpLeg"), ("LeftArm", "LeftForeArm")
OF_SENSORS: Final[dict[str, Gross]] = {
    "accelerations negated": Gross(_samples(_flipped), "sign flipped"),
    "gravity removed": Gross(_samples(_without_gravity), "gravity was removed"),
    "quaternions x, y, z, w": Gross(_samples(_as_xyzw), "order x, y, z, w"),
    "quaternions conjugated": Gross(_samples(_inverted), "orientations are inverted"),
    "one sensor repeats a sample": Gross(_samples(_frozen(0.6, slice(1))), "is frozen"),
    "all sensors frozen": Gross(_samples(_frozen(1.0, slice(None))), "all sensors are frozen"),
    "sensors 0.5 s late": Gross(_late(0.5), "the clocks are off"),
    "sensors 1 s early": Gross(_late(-1.0), "the clocks are off"),
    "sensors 2 s late": Gross(_late(2.0), "the clocks are off"),
    "samples of the forearms swapped": Gross(
        _samples_swapped(*_FOREARMS), "samples of LeftForeArm and RightForeArm are swapped"
    ),
    "samples of left and right swapped": Gross(_samples_swapped(*_SIDES), "samples of all left and right sensors"),
    "samples of an arm and a thigh swapped": Gross(
        _samples_swapped(*_ARM_THIGH), "samples of LeftArm and RightUpLeg are swapped"
    ),
    "forearms swapped": Gross(_segments_swapped(*_FOREARMS), "sensors of LeftForeArm and RightForeArm are swapped"),
    "left and right swapped": Gross(_segments_swapped(*_SIDES), "all left and right sensors"),
    "an arm and a thigh swapped": Gross(
        _segments_swapped(*_ARM_THIGH), "sensors of LeftArm and RightUpLeg are swapped"
    ),
    "upper arm and forearm swapped": Gross(_segments_swapped(*_ARM), "sensors of LeftArm and LeftForeArm are swapped"),
}


def _gross(found: dict[str, Gross], sensors: bool | None) -> dict[str, Fault]:
    def plant(own: Gross) -> Callable[[Recording, Any, Any], Recording]:
        return lambda recording, size, draws: own.plant(recording)

    return {
        name: Fault(plant(own), ("",), "", re.escape(own.named), sensors=sensors, floor=True)
        for name, own in found.items()
    }


GROSS: Final[dict[str, Fault]] = _gross(OF_CAMERA, None) | _gross(OF_SENSORS, True)
"""Gross faults, which are counted apart."""
