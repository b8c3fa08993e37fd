"""Mistakes of a setup that are measured, not guessed: the rotation of all sensors against gravity and the
image, the video's frame rate, a sensor that stands still, and one that is twisted about its bone.

Each quantity is estimated with its standard deviation, and compared with what right recordings of other
people reach (benchmarks/results/planted.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import STEP, BoneImages, projected
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import STANDARD_GRAVITY, BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

TILT, VIEW, HEADING = "tilt of the sensors' world", "tilt of the camera", "heading of all sensors"
RATE, STILL, TWIST = "frame rate of the video", "motion beside a still sensor", "twist of a sensor"
_TILT_DEG, _TILT_DEG_S = 1.7, 7.0
"""[deg] and [deg s]: largest tilt of the mean acceleration over a duration, less the change of velocity."""
_APART = 1.0  # [m/s^2] Median distance of the sensors' mean accelerations from a shared one
_ROLL_DEG, _PITCH_DEG, _HEADING_DEG, _SIGMAS, _VAGUE_DEG = 7.0, 12.0, 10.0, 2.5, 15.0
"""[deg] Largest rotation of all sensors against the image about the line of sight, up or down (a lifted body
leans more than it rolls) and about the vertical; standard deviations that it must exceed too; and the
standard deviation of one that is not observed."""
_FEWEST, _SCALE = 5, 0.3  # Sensors whose errors average out, and standard deviation of the logarithm of the body's size
_AGREEING: Final = 1.4
"""[nats] a frame and sensor: largest difference that a rotation may leave; 0.2 to 1.3 in right recordings."""
_MEMORY = 1.0  # [s] Correlation time of differences between image and sensors
_ENDS = 0.3  # [s] over which the velocity at both ends is averaged
_LEAST_SECONDS: Final = 2.0
_SPEEDS: Final = (0.25, 0.42, 0.5, 0.6, 0.67, 0.8, 0.83, 1.2, 1.25, 1.5, 1.67, 2.0, 2.4, 4.0)
"""Ratios of two of the usual frame rates, 24 to 240 Hz."""
_SURE_RATE, _SAME_MOTION, _EXPLAINED = 1.8, 1.2, 0.8
"""[nats] Gain of another frame rate that is reported; largest difference of image and sensors under it,
nats a frame and sensor, and that relative to the one as declared."""
_STILL_DEG, _STILL_WINDOW, _STILL_CUTOFF_HZ = 1.5, 2.0, 3.0
_STILL_LIMIT: Final = 2.0
"""[m/s^2] RMS acceleration of a joint by the neighbouring sensor, or of the sensor itself, while the sensor
does not turn."""
_TWIST_DEG, _TWIST_ARM_DEG = 30.0, 40.0
"""[deg] Largest median rotation of a sensor about its bone against the motion; of arms more, as forearms
turn in themselves."""


# --- all sensors ---------------------------------------------------------------------------------


def check_tilt(native: BoneImuSequence, poses: PoseSequence) -> Check:
    """Check that the specific force of all sensors averages to the vertical of the world.

    The mean acceleration over a time T is the change of velocity over T; the rest is gravity in a tilted reference.
    """
    inside = (native.times >= poses.times[0]) & (native.times <= poses.times[-1])
    seconds, n = float(np.ptp(poses.times)), max(3, round(_ENDS * poses.rate_hz))
    known = np.isfinite(native.a_world[inside]).all(axis=-1).mean(axis=0) > 0.9 if inside.any() else []
    if seconds < _LEAST_SECONDS or np.sum(known) < 2:
        return Check.unknown(TILT, "sensors", "deg", "less than two sensors over 2 s of the video")
    mean = np.nanmean(native.a_world[inside][:, known], axis=0)
    ends = []  # mean velocities (J, 3), m/s, by regression
    for part in (slice(None, n), slice(-n, None)):
        t = poses.times[part] - poses.times[part].mean()
        ends.append(np.einsum("t,tji->ji", t, poses.p_world_joint[part]) / np.sum(t**2))
    j = [poses.names.index(joint) for joint, own in zip(native.joints, known, strict=True) if own]
    every = mean - (ends[1] - ends[0])[j] / seconds
    x, y, _ = shared = np.median(every, axis=0)
    if np.median(np.linalg.norm(every - shared, axis=1)) > _APART:
        return Check.unknown(TILT, "sensors", "deg", "the sensors do not share one vertical")
    tilt = float(np.degrees(np.arctan2(np.hypot(x, y), STANDARD_GRAVITY)))
    advice = (
        f"On average the accelerometers' vertical leans by {tilt:.0f} deg; correct R_world_inertial, "
        "or calibrate the sensors again"
    )
    cause = f"the references of all sensors are tilted by about {tilt:.0f} deg against gravity"
    return Check(TILT, "sensors", tilt, _TILT_DEG + _TILT_DEG_S / seconds, "deg", advice, cause=cause)


def check_turned(images: BoneImages, camera: Camera, upright: bool) -> tuple[Check, ...]:
    """Check the rotation between the sensors' world and the camera's by the directions of bones.

    Args:
        upright: gravity says that the sensors' world is upright; then a tilt is the camera's.

    Returns:
        One check of horizontal axes and one of the vertical.
    """
    found = _rotation(images, camera)

    def unknown(why: str) -> tuple[Check, Check]:
        return Check.unknown(VIEW, "camera", "deg", why), Check.unknown(HEADING, "sensors", "deg", why)

    if found is None:
        return unknown(f"less than {_FEWEST} bones with sensors are visible")
    if found[2] > _AGREEING:
        return unknown("image and sensors show different motion")
    w = np.degrees(found[0])
    tilt, turn = float(np.hypot(*w[:2])), float(w[2])
    level = np.array([*w[:2], 0.0]) / max(tilt, 1e-9)
    across, about = np.degrees(np.sqrt([level @ found[1] @ level, found[1][2, 2]])).tolist()
    rolled = abs(float(w @ camera.R_camera_world[2])) > tilt / 2
    whose = "the camera" if upright else "the camera, or all sensors' references,"
    cause = (
        f"{whose} is probably turned by about {tilt:.0f} deg {'about its line of sight' if rolled else 'up or down'}"
    )
    advice = (
        "Bones with sensors, whose vertical gravity gives, have other directions in the picture; "
        "calibrate the camera again, or hold it level"
    )
    limit = max(_ROLL_DEG if rolled else _PITCH_DEG, _SIGMAS * across)
    view = Check(VIEW, "camera", tilt, limit, "deg", advice, cause=cause)
    cause = f"all sensors' headings are off by about {abs(turn):.0f} deg against the camera"
    advice = (
        f"Turn R_world_inertial of all sensors by {turn:+.0f} deg about the vertical, or the camera; "
        "or set the headings anew in a known pose"
    )
    heading = Check(HEADING, "sensors", abs(turn), max(_HEADING_DEG, _SIGMAS * about), "deg", advice, cause=cause)
    vague = unknown("the movement does not show it")
    return vague[0] if across > _VAGUE_DEG else view, vague[1] if about > _VAGUE_DEG else heading


def _rotation(images: BoneImages, camera: Camera) -> tuple[Array, Array, float] | None:
    """Rotation vector (3,), rad in world, that brings the sensors' bones to the image, its covariance, and the mean
    difference left, nats a frame and sensor; by robust Gauss-Newton from no rotation and from the best heading.
    """
    R, n = camera.R_camera_world, len(images.directions)
    index = np.clip(images.frames, 0, n - 1)
    directions = images.directions[index] @ R  # world axes
    known = np.isfinite(directions).all(axis=-1) & np.isfinite(images.vectors).all(axis=-1)
    known &= (images.frames >= 0)[:, None] & (images.frames < n)[:, None]
    if len(set(images.sensors[known.any(axis=0)])) < _FEWEST:
        return None
    a_frame = float(np.median(np.diff(images.frames))) * STEP / _MEMORY
    weight = a_frame * images.weight * known
    prior = np.diag([*(np.radians(90.0) ** -2,) * 3, _SCALE**-2])

    def off(W: Array, scale: float) -> Array:
        d = np.exp(scale) * directions @ (R @ W).T
        difference = images.vectors - projected(d, images.rays)
        return np.where(known[..., None], difference, 0.0) / images.sigma[:, None]

    def cost(W: Array, scale: float = 0.0) -> float:
        return float(np.sum(weight * 1.5 * np.log1p(np.sum(off(W, scale) ** 2, axis=-1) / 3)))

    headings = so3.about_axis("z", np.radians(np.arange(-180.0, 180.0, 15.0)))
    results = []
    for W in (np.eye(3), min(headings, key=cost)):
        scale = 0.0
        for _ in range(12):
            r = off(W, scale)
            moved = [off(so3.exp(1e-4 * e) @ W, scale) for e in np.eye(3)] + [off(W, scale + 1e-4)]
            J = np.stack([one - r for one in moved], axis=-1) / 1e-4
            robust = weight / (1 + np.sum(r**2, axis=-1) / 3)
            H = np.einsum("fb,fbik,fbil->kl", robust, J, J) + prior
            step = -np.linalg.solve(H, np.einsum("fb,fbik,fbi->k", robust, J, r) + prior[3] * scale)
            step *= min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-9))
            W, scale = so3.exp(step[:3]) @ W, scale + float(step[3])
        results.append((cost(W, scale), W, H))
    least, W, H = min(results, key=lambda result: result[0])
    return so3.log(W), np.linalg.inv(H)[:3, :3], least / float(weight.sum())


# --- the frame rate ------------------------------------------------------------------------------


def check_frame_rate(images: BoneImages, keypoints: KeypointSequence) -> Check:
    """Check the video's speed: that of its limbs against the sensors', at any offset of the clocks."""
    subject, step = "keypoints", np.diff(keypoints.times)
    declared_hz = 1 / float(np.median(step)) if len(step) else np.nan
    as_given = _at_speed(images, 1.0)
    if as_given is None:
        return Check.unknown(RATE, subject, "nats", "too little of the bones with sensors is visible")
    best, gain, ratio = as_given, 0.0, 1.0
    for other in _SPEEDS:
        found = _at_speed(images, other)
        if found is None:
            continue
        a_frame = float(np.median(np.diff(images.frames))) * STEP * min(other, 1 / other) / _MEMORY
        own = a_frame * float(np.nansum(as_given[0] - found[0]))
        if own > gain:
            best, gain, ratio = found, own, other
    alike = best[1] < min(_SAME_MOTION, _EXPLAINED * as_given[1])
    rate_hz = declared_hz / ratio
    advice = (
        f"At {rate_hz:.3g} frames a second the limbs turn as fast as the sensors measure; give the times "
        "of the frames as they were recorded, or look at the sensors' rate"
    )
    cause = (
        f"the video runs {max(ratio, 1 / ratio):.2g} times too {'fast' if ratio > 1 else 'slow'}: "
        f"it has probably {rate_hz:.3g} frames a second, not {declared_hz:.3g}"
    )
    return Check(RATE, subject, gain if alike else 0.0, _SURE_RATE, "nats", advice, cause=cause)


def _at_speed(images: BoneImages, ratio: float) -> tuple[Array, float] | None:
    """Differences (F,), nats, at the best offset of a video that is slower by a ratio; and their mean per
    sensor without constant differences removed.
    """
    known = np.flatnonzero(np.isfinite(images.directions).all(axis=-1).any(axis=-1))
    seen = np.isfinite(images.vectors).all(axis=-1).any(axis=-1)
    if len(known) == 0 or seen.sum() < 5:
        return None
    at = np.round((images.frames - images.frames[0]) * ratio).astype(np.int64)
    span, first = int(np.ptp(at[seen])), images.frames[0]
    least = max(_LEAST_SECONDS / STEP, 0.6 * min(span, known[-1] - known[0]))
    shifts = np.arange(max(known[0] - span, first - 60), min(known[-1], first + 60) + 1)
    moved, index = replace(images, frames=at), at[seen] + shifts[:, None]
    inside = (index >= known[0]) & (index <= known[-1])
    common = np.where(inside, index, -np.inf).max(axis=1) - np.where(inside, index, np.inf).min(axis=1)
    steps = -shifts[common >= least]
    differences = moved.differences(steps)
    some = np.isfinite(differences).any(axis=1)
    if not some.any():
        return None
    steps, differences = steps[some], differences[some]
    best = int(np.argmin(np.nanmean(differences, axis=1)))
    return differences[best], float(np.nanmean(moved.by_sensor(steps[best])))


# --- one sensor ----------------------------------------------------------------------------------


def check_still(native: BoneImuSequence, skeleton: SkeletonModel) -> Check:
    """Check that a resting sensor is on a resting segment: both it and the next one give their joint's acceleration."""
    times, worst = native.times, (0.0, 0, 0.0, 0.0)
    if len(times) < 3 or np.ptp(times) < _STILL_WINDOW:
        return Check.unknown(STILL, "sensors", "m/s2", f"there are less than {_STILL_WINDOW:g} s")
    rate_hz = (len(times) - 1) / float(np.ptp(times))
    smooth = np.stack([_smooth(R, times) for R in native.R_world_bone.swapaxes(0, 1)], axis=1)
    width, hop = round(_STILL_WINDOW * rate_hz), max(1, round(_STILL_WINDOW * rate_hz / 4))
    resting, every = list[tuple[int, slice]](), range(0, len(times) - width + 1, hop)
    for window in (slice(start, start + width) for start in every):
        own = smooth[window]
        turned = np.sqrt(np.mean(np.sum((own - own.mean(axis=0)) ** 2, axis=(2, 3)), axis=0) / 2)
        resting += [(int(s), window) for s in np.flatnonzero(turned < np.radians(_STILL_DEG))]
    for s in dict.fromkeys(s for s, _ in resting):
        for difference in _at_joints(native, skeleton, s, rate_hz):
            off = _smooth(difference, times)
            for window in (window for own, window in resting if own == s):
                part = off[window]
                part = part[np.isfinite(part).all(axis=-1)]
                if len(part) < width / 2:
                    continue
                value = float(np.sqrt(np.mean(np.sum((part - part.mean(axis=0)) ** 2, axis=-1))))
                if value > worst[0]:
                    worst = value, s, times[window.start], times[window.stop - 1]
    value, s, start, stop = worst
    name = native.joints[s]
    advice = (
        f"Its orientation rests from {start:.1f} to {stop:.1f} s, while the joint that it shares with the "
        "next sensor moves; leave it out, or record again"
    )
    cause = f"the sensor on {name} is frozen, but for noise"
    return Check(STILL, f"sensor on {name}", value, _STILL_LIMIT, "m/s2", advice, cause=cause)


def _smooth(values: Array, times: Array) -> Array:
    flat = values.reshape(len(times), -1)
    return signals.low_pass_known(times, flat, _STILL_CUTOFF_HZ).reshape(values.shape)


def _at_joints(native: BoneImuSequence, skeleton: SkeletonModel, s: int, rate_hz: float) -> list[Array]:
    """Difference (T, 3), m/s^2, of the acceleration of each joint by sensor s and by the next one."""
    index = skeleton.names.index
    out = []
    for n in range(len(native.joints)):
        for parent, child in ((s, n), (n, s)):
            if skeleton.parents[index(native.joints[child])] != index(native.joints[parent]):
                continue
            bone = skeleton.joint_offsets[index(native.joints[child])]
            arms = (bone - native.p_bone_sensor[parent], -native.p_bone_sensor[child])
            a = np.full((2, len(native.times), 3), np.nan)
            for k, (i, arm) in enumerate(zip((parent, child), arms, strict=True)):
                levered = _smooth(native.R_world_bone[:, i] @ arm, native.times)
                a[k, 1:-1] = native.a_world[1:-1, i] + signals.derivative(levered, rate_hz, 2)
            out.append(a[0] - a[1])
    return out


def check_twist(poses: PoseSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> Check:
    """Check that no sensor is turned about its bone against the motion on the whole."""
    worst = (0.0, "sensors", _TWIST_DEG)
    for s, joint in enumerate(bone_imus.joints):
        bone = skeleton.bone_axis(joint)
        known = np.isfinite(bone_imus.R_world_bone[:, s]).all(axis=(1, 2)) & poses.valid.any(axis=1)
        if not bone.any() or not known.any():
            continue
        R = poses.R_world_bone[known, skeleton.names.index(joint)]
        off = so3.log(np.swapaxes(R, -1, -2) @ bone_imus.R_world_bone[known, s])
        twist = float(np.degrees(np.median(off @ bone)))
        limit = _TWIST_ARM_DEG if "Arm" in joint else _TWIST_DEG
        worst = max(worst, (twist, joint, limit), key=lambda own: abs(own[0]) / own[2])
    twist, joint, limit = worst
    advice = "Put it back as it was, or calibrate the sensors again as they sit now"
    cause = f"the sensor on {joint} is turned by about {abs(twist):.0f} deg about its bone against its calibration"
    return Check(TWIST, f"sensor on {joint}", abs(twist), limit, "deg", advice, cause=cause)
