"""Errors of known size in a recording that has none: what a calibration from the recording must find.

An error is a number or some, in the terms of `rtof_kin.calibration.unknowns`: what a perfect calibration
would give. `planted` makes a recording wrong by them, so that `SelfCalibration.apply` with the same
numbers gives it back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import BONE_GROUPS, bone_groups
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.noise import KeypointNoise

Values = dict[str, Array]
"""Item -> (w,) in SI units or px."""
Wrong = Mapping[str, Values]
"""Error, one of `ERRORS` -> what is wrong with each of its items; errors that are absent are zero."""


@dataclass(frozen=True)
class Error:
    """One kind of error: its size, and what leaves it open."""

    size: float
    """Standard deviation at which it is planted, SI or px (see docs/calibration.md)."""
    kind: str
    """The unknown that it belongs to, and its number there."""
    part: slice
    draw: Callable[[Recording, Generator], Values]
    """Error of size one."""
    opened: Callable[[CalibrationPriors, float], CalibrationPriors]
    """Priors with it open, of a standard deviation."""


def _items(names: Callable[[Recording], tuple[str, ...]], width: int) -> Callable[..., Values]:
    """Normal numbers for each item."""

    def draw(recording: Recording, rng: Generator) -> Values:
        return {name: rng.standard_normal(width) for name in names(recording)}

    return draw


def _one(item: str, signs: tuple[float, ...]) -> Callable[..., Values]:
    """One number of exactly the size, of either sign."""
    return lambda recording, rng: {item: np.array([rng.choice(signs)])}


def _sensors(recording: Recording) -> tuple[str, ...]:
    assert recording.calibration is not None
    return recording.calibration.joints


def _landmarks(recording: Recording) -> tuple[str, ...]:
    return recording.video.names


def _biases(recording: Recording, rng: Generator) -> Values:
    """Larger at arms and smaller at legs, as `KeypointNoise` has them."""
    noise = KeypointNoise()
    return {name: noise.factor(name) * rng.standard_normal(2) for name in _landmarks(recording)}


def _opening(**factors: float | None) -> Callable[..., CalibrationPriors]:
    """Sets these priors to so many times the size; None closes one."""

    def opened(priors: CalibrationPriors, sigma: float) -> CalibrationPriors:
        values = {name: None if f is None else f * sigma for name, f in factors.items()}
        return replace(priors, **values)

    return opened


def _drifting(priors: CalibrationPriors, sigma: float) -> CalibrationPriors:
    """A drift needs the heading itself open, if only little."""
    heading = priors.sigma_heading or np.radians(2.0)
    return replace(priors, sigma_heading=heading, sigma_heading_drift=sigma)


def _proportioned(priors: CalibrationPriors, sigma: float) -> CalibrationPriors:
    """Proportions need the size itself open, if only little."""
    return replace(priors, sigma_size=priors.sigma_size or 0.01, sigma_proportion=sigma)


_FIRST, _SECOND, _ALL = slice(0, 1), slice(1, 2), slice(None)
_BOTH = (-1.0, 1.0)
ERRORS = {
    "delay": Error(0.033, "delay", _FIRST, _one("video", (1.0,)), _opening(sigma_delay=1)),
    "clock drift": Error(1e-3, "delay", _SECOND, _one("video", _BOTH), _opening(sigma_clock_drift=1)),
    "heading": Error(np.radians(10.0), "heading", _FIRST, _items(_sensors, 1), _opening(sigma_heading=1)),
    "heading drift": Error(np.radians(10.0) / 60, "heading", _SECOND, _items(_sensors, 1), _drifting),
    "mounting": Error(np.radians(6.0), "mounting", _ALL, _items(_sensors, 3), _opening(sigma_swing=1, sigma_twist=1)),
    "lever arm": Error(0.03, "lever arm", _ALL, _items(_sensors, 3), _opening(sigma_lever_arm=1)),
    "size": Error(0.03, "bones", _FIRST, _one("all", _BOTH), _opening(sigma_size=1)),
    "proportions": Error(0.03, "bones", _FIRST, _items(lambda recording: tuple(BONE_GROUPS), 1), _proportioned),
    "image bias": Error(6.0, "image bias", _ALL, _biases, _opening(sigma_image_bias=1)),
    "place": Error(0.025, "place", _ALL, _items(_landmarks, 3), _opening(sigma_place=1)),
    "focal length": Error(0.02, "focal length", _ALL, _one("camera", _BOTH), _opening(sigma_focal=1)),
    "camera tilt": Error(
        np.radians(1.0),
        "camera tilt",
        _ALL,
        lambda recording, rng: {"camera": rng.standard_normal(3)},
        _opening(sigma_tilt=1),
    ),
}
"""Errors by name; the clock drift is that of a 59.94 Hz video stamped with 60 Hz."""
USUAL = {"delay": 0.045, "mounting": np.radians(2.0), "image bias": 6.0}
"""Errors of every realistic recording, with their sizes."""


def drawn(recording: Recording, sizes: Mapping[str, float], seed: int) -> Wrong:
    """Errors of the sizes asked for: the same draw whatever the size."""
    return {
        name: {item: sizes[name] * value for item, value in ERRORS[name].draw(recording, _stream(name, seed)).items()}
        for name in sizes
    }


def _stream(name: str, seed: int) -> Generator:
    return np.random.default_rng([seed, list(ERRORS).index(name)])


def unknowns(recording: Recording, wrong: Wrong) -> dict[tuple[str, str], Array]:
    """Kind and item of every unknown that a calibration may have -> its truth, zeros included."""
    sensors, landmarks = _sensors(recording), _landmarks(recording)
    items = {
        "delay": (("video",), 2),
        "heading": (sensors, 2),
        "mounting": (sensors, 3),
        "lever arm": (sensors, 3),
        "bones": (("all", *BONE_GROUPS), 1),
        "image bias": (landmarks, 2),
        "place": (landmarks, 3),
        "focal length": (("camera",), 1),
        "camera tilt": (("camera",), 3),
    }
    found = {(kind, item): np.zeros(w) for kind, (names, w) in items.items() for item in names}
    for name, values in wrong.items():
        error = ERRORS[name]
        for item, value in values.items():
            found[error.kind, item][error.part] += value
    whole = found["bones", "all"]
    for group in BONE_GROUPS:
        found["bones", group] = (1 + whole) * (1 + found["bones", group]) - 1
    return found


def planted(recording: Recording, wrong: Wrong) -> Recording:
    """A recording that is wrong by these errors; its truth stays.

    Args:
        recording: without lag, with truth at the keypoints' times.
    """
    y = unknowns(recording, wrong)
    recording = _with_misled_detector(recording, y)
    recording = _with_other_camera(recording, y)
    recording = with_late_video(recording, y["delay", "video"])
    recording = with_turned_sensors(recording, y)
    factor = np.ones((len(recording.joint_offsets), 1))
    for name, joints in bone_groups(recording.skeleton, tuple(BONE_GROUPS)):
        factor[list(joints)] += y["bones", name]
    return replace(recording, joint_offsets=recording.joint_offsets / factor)


def _with_misled_detector(recording: Recording, y: Mapping[tuple[str, str], Array]) -> Recording:
    """Points seen beside where they are, in the image and in their segments."""
    seen, truth, skeleton = recording.video, _truth(recording), recording.skeleton
    uv = seen.uv_px.copy()
    for i, name in enumerate(seen.names):
        joint, place = skeleton.landmarks[name]
        (j,) = skeleton.index(joint)
        R, p = truth.R_world_bone[:, j], truth.p_world_joint[:, j]
        moved = place + y["place", name]
        uv[:, i] += seen.camera.project(p + R @ moved) - seen.camera.project(p + R @ place)
        uv[:, i] += y["image bias", name]
    return replace(recording, keypoints=replace(seen, uv_px=uv))


def _truth(recording: Recording) -> PoseSequence:
    assert recording.truth is not None
    return recording.truth


def _with_other_camera(recording: Recording, y: Mapping[tuple[str, str], Array]) -> Recording:
    """A camera believed shorter, and to look elsewhere from where it is."""
    seen, turn = recording.video, so3.exp(-y["camera tilt", "camera"])
    K = seen.camera.K.copy()
    K[:2, :2] /= 1 + y["focal length", "camera"][0]
    camera = replace(
        seen.camera,
        K=K,
        R_camera_world=turn @ seen.camera.R_camera_world,
        t_camera_world=turn @ seen.camera.t_camera_world,
    )
    return replace(recording, keypoints=replace(seen, camera=camera))


def with_late_video(recording: Recording, y: Array) -> Recording:
    """Time stamps that are late, and grow so from the middle on."""
    seen = recording.video
    since = seen.times - middle(seen.times)
    times = middle(seen.times) + y[0] + since / (1 - y[1])
    return replace(recording, keypoints=replace(seen, times=times))


def middle(times: Array) -> float:
    """The time at which what drifts has its value."""
    return float(times[0] + times[-1]) / 2


def with_turned_sensors(recording: Recording, y: Mapping[tuple[str, str], Array]) -> Recording:
    """References turned, and turning; mounted otherwise, and elsewhere."""
    own, imus = recording.calibration, recording.imus
    assert own is not None
    assert imus is not None
    since = imus.times - middle(recording.video.times)
    heading, R = np.array([y["heading", joint] for joint in own.joints]), imus.R_inertial_sensor.copy()
    for s, sensor in enumerate(own.sensors):
        i, R_world_inertial = imus.names.index(sensor), own.R_world_inertial[s]
        turn = so3.about_axis("z", -heading[s, 1] * since)
        R[:, i] = R_world_inertial.T @ turn @ R_world_inertial @ R[:, i]
    mounting = np.array([y["mounting", joint] for joint in own.joints])
    levers = np.array([y["lever arm", joint] for joint in own.joints])
    calibration = replace(
        own,
        R_world_inertial=so3.about_axis("z", -heading[:, 0]) @ own.R_world_inertial,
        R_sensor_bone=own.R_sensor_bone @ so3.exp(-mounting),
        p_bone_sensor=own.p_bone_sensor - levers,
    )
    return replace(recording, imus=replace(imus, R_inertial_sensor=R), calibration=calibration)


def slips(recording: Recording) -> Values:
    """Rotation of each sensor on its segment in the mean over a recording without other
    errors: its slip lasts for tens of seconds, and is what a mounting estimated from them is."""
    measured, truth = recording.bone_imus(), _truth(recording)
    assert measured is not None
    found = {}
    for s, joint in enumerate(measured.joints):
        R = np.swapaxes(measured.R_world_bone[:, s], -1, -2)
        turn = R @ truth.R_world_bone[:, truth.names.index(joint)]
        known = np.isfinite(turn).all(axis=(-2, -1))
        found[joint] = so3.log(so3.nearest_rotation(turn[known].mean(axis=0)))
    return found
