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

from benchmarks.keypoint_noise import KeypointNoise
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import BONE_GROUPS, bone_groups
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording

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
    """The unknown that it belongs to."""
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


def _proportioned(priors: CalibrationPriors, sigma: float) -> CalibrationPriors:
    """Proportions need the size itself open, if only little."""
    return replace(priors, sigma_size=priors.sigma_size or 0.01, sigma_proportion=sigma)


_BOTH = (-1.0, 1.0)
ERRORS = {
    "delay": Error(0.033, "delay", _one("video", (1.0,)), _opening(sigma_delay=1)),
    "heading": Error(np.radians(10.0), "heading", _items(_sensors, 1), _opening(sigma_heading=1)),
    "mounting": Error(np.radians(6.0), "mounting", _items(_sensors, 3), _opening(sigma_swing=1, sigma_twist=1)),
    "size": Error(0.03, "bones", _one("all", _BOTH), _opening(sigma_size=1)),
    "proportions": Error(0.03, "bones", _items(lambda recording: tuple(BONE_GROUPS), 1), _proportioned),
    "image bias": Error(6.0, "image bias", _biases, _opening(sigma_image_bias=1)),
}
"""Errors by name."""
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
        "delay": (("video",), 1),
        "heading": (sensors, 1),
        "mounting": (sensors, 3),
        "bones": (("all", *BONE_GROUPS), 1),
        "image bias": (landmarks, 2),
    }
    found = {(kind, item): np.zeros(w) for kind, (names, w) in items.items() for item in names}
    for name, values in wrong.items():
        for item, value in values.items():
            found[ERRORS[name].kind, item] += value
    whole = found["bones", "all"]
    for group in BONE_GROUPS:
        found["bones", group] = (1 + whole) * (1 + found["bones", group]) - 1
    return found


def planted(recording: Recording, wrong: Wrong) -> Recording:
    """A recording that is wrong by these errors; its truth stays.

    Args:
        recording: without lag.
    """
    y = unknowns(recording, wrong)
    seen = recording.video
    bias = np.array([y["image bias", name] for name in seen.names])
    recording = replace(recording, keypoints=replace(seen, uv_px=seen.uv_px + bias))
    recording = with_late_video(recording, y["delay", "video"])
    recording = with_turned_sensors(recording, y)
    factor = np.ones((len(recording.joint_offsets), 1))
    for name, joints in bone_groups(recording.skeleton, tuple(BONE_GROUPS)):
        factor[list(joints)] += y["bones", name]
    return replace(recording, joint_offsets=recording.joint_offsets / factor)


def _truth(recording: Recording) -> PoseSequence:
    assert recording.truth is not None
    return recording.truth


def with_late_video(recording: Recording, y: Array) -> Recording:
    """Time stamps that are late."""
    seen = recording.video
    return replace(recording, keypoints=replace(seen, times=seen.times + y[0]))


def with_turned_sensors(recording: Recording, y: Mapping[tuple[str, str], Array]) -> Recording:
    """References turned; mounted otherwise."""
    own = recording.calibration
    assert own is not None
    heading, mounting = (np.array([y[kind, joint] for joint in own.joints]) for kind in ("heading", "mounting"))
    calibration = replace(
        own,
        R_world_inertial=so3.about_axis("z", -heading[:, 0]) @ own.R_world_inertial,
        R_sensor_bone=own.R_sensor_bone @ so3.exp(-mounting),
    )
    return replace(recording, calibration=calibration)


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
