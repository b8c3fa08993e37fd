"""Offset between the clocks of video and sensors, from the rotation of the limbs.

Directions of bones in the image and by the sensors are compared at every offset within a wide range, without solving
for poses: a calibrated orientation gives the direction of a bone at every instant, the image its projection.
Constant differences are removed, so constant errors of the calibration have no effect.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.offset_scan import OffsetScan
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.checks import Check
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.segment_names import other_side

STEP: Final = 0.1  # [s] between samples of the sensors' directions
_MOST_FRAMES: Final = 240
_SIGMA: Final = 0.12
_SIGMA_M = 0.04  # Standard deviation of the difference: per length of the bone, and [m]


def projected(bones: Array, rays: Array) -> Array:
    """Return the images (..., 2) of bones (..., 3), camera axes, at unit depth of their middles' rays (..., 2)."""
    return np.asarray(bones[..., :2] - rays * bones[..., 2:])


@dataclass(frozen=True)
class BoneImages:
    """B bones with sensors, in the image and by the sensors."""

    frames: Index  # (F,) index of each frame in the grid of `directions`
    vectors: Array  # (F, B, 2) the bone in the image, in lengths of the bone
    rays: Array  # (F, B, 2) normalised image coordinates of the bone's middle
    directions: Array  # (G, B, 3) unit vectors in camera axes by the sensors, every `STEP`; NaN where missing
    sigma: Array  # (B,) standard deviations of the differences
    weight: Array  # (B,) 1 / number of bones of the same sensor
    sensors: Index  # (B,) index of the sensor on each bone
    sensor_count: int  # S

    def cost(self, steps: ArrayLike, constant: bool = True) -> Array:
        """Return the robust differences (..., F, B), nats; `steps`: (...) offsets of the video's stamps relative to the
        sensors', in `STEP`; `constant`: whether each bone may have a constant difference.
        """
        index = self.frames - np.asarray(steps)[..., None]
        inside = (index >= 0) & (index < len(self.directions))
        d = self.directions[np.where(inside, index, 0)]
        off = self.vectors - projected(d, self.rays)
        known = inside[..., None] & np.isfinite(off[..., 0])
        off = np.where(known[..., None], off, 0.0)
        if constant:
            off -= off.sum(axis=-3, keepdims=True) / np.maximum(known.sum(axis=-2, keepdims=True), 1)[..., None]
        square = np.einsum("...i,...i->...", off, off) / self.sigma**2
        return np.where(known, 1.5 * np.log1p(square / 3), np.nan)

    def differences(self, steps: Index) -> Array:
        """Return the cost (n, F) of all sensors together at offsets (n,); NaN without a bone."""
        cost = self.cost(steps) * self.weight
        return np.where(np.isfinite(cost).any(axis=-1), np.nansum(cost, axis=-1), np.nan)

    def by_sensor(self, steps: int = 0) -> Array:
        """Return the mean difference (S,) of sensors, nats per frame, at an offset in `STEP`; NaN without a bone."""
        cost = self.cost(steps, constant=False)
        known = np.isfinite(cost)
        some = known.any(axis=0)
        mean = np.where(known, cost, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        total, bones = (np.bincount(self.sensors, v, self.sensor_count) for v in (mean, some))
        return np.where(bones > 0, total / np.maximum(bones, 1), np.nan)


def bone_images(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, poses: PoseSequence, skeleton: SkeletonModel
) -> BoneImages | None:
    """Return the bones with sensors between joints of the detector, with poses at its times for depth; or None."""
    times = keypoints.times
    every = max(1, -(-int(np.ptp(times) / STEP) // _MOST_FRAMES))
    frames = np.arange(0, int(np.ptp(times) / STEP) + 1, every)
    chosen = _nearest(times, times[0] + STEP * frames)
    before = int(np.ceil((times[0] - bone_imus.times[0]) / STEP))  # so that frames lie on the grid
    grid = times[0] + STEP * np.arange(-before, (bone_imus.times[-1] - times[0]) / STEP)
    seen, camera = keypoints.select(skeleton.names), keypoints.camera
    xy = camera.normalise(seen.uv_px[chosen])
    depth = camera.to_camera(poses.p_world_joint[chosen, 0])[:, 2]
    seen_ends = {j for j, name in enumerate(skeleton.names) if name in keypoints.names}
    ends = [end for end in sensed_bones(bone_imus, skeleton) if set(end[1:]) <= seen_ends]
    if not ends:
        return None
    s, j, c = (np.array(column) for column in zip(*ends, strict=True))
    rest = skeleton.joint_offsets[c]
    length = np.linalg.norm(rest, axis=-1)
    R_world_bone = bone_imus.R_world_bone[_nearest(bone_imus.times, grid)][:, s]
    R = np.einsum("ij,gbjk->gbik", camera.R_camera_world, R_world_bone)
    return BoneImages(
        frames=frames + before,
        vectors=(xy[:, c] - xy[:, j]) * depth[:, None, None] / length[:, None],
        rays=(xy[:, c] + xy[:, j]) / 2,
        directions=np.einsum("gbik,bk->gbi", R, rest / length[:, None]),
        sigma=np.hypot(_SIGMA, _SIGMA_M / length),
        weight=1 / np.bincount(s)[s],
        sensors=s,
        sensor_count=len(bone_imus.joints),
    )


def _nearest(times: Array, at: Array) -> Index:
    """Indices of the samples nearest to instants."""
    middles = (times[1:] + times[:-1]) / 2
    return np.searchsorted(middles, at)


def exchanged_sides(bone_imus: BoneImuSequence) -> BoneImuSequence:
    """Return the sensors with left and right exchanged, where both sides have one."""
    own = bone_imus.joints
    return replace(bone_imus, joints=tuple(other_side(joint) if other_side(joint) in own else joint for joint in own))


def best_exchange(
    keypoints: KeypointSequence, readings: Iterable[BoneImuSequence], poses: PoseSequence, skeleton: SkeletonModel
) -> float:
    """Return the largest decrease of the difference by exchanging two sensors, nats per frame.

    Args:
        keypoints, poses, skeleton: as for `bone_images`.
        readings: the S sensors as declared, then with their segments rotated by 1 to S - 1 places.
    """
    rows = []
    for shift, moved in enumerate(readings):
        images = bone_images(keypoints, moved, poses, skeleton)
        off = np.full(len(moved.joints), np.nan) if images is None else images.by_sensor()
        rows.append(np.roll(off, shift))  # in the order of the segments
    S = len(rows)
    off = np.array([[rows[(b - a) % S][b] for b in range(S)] for a in range(S)])
    own = np.diag(off)
    return float(np.nanmax(own[:, None] + own - off - off.T, initial=0.0))


NAME: Final = "offset between the clocks of video and sensors"
LIMIT: Final = 0.2  # [s] Largest offset that the self-calibration estimates
REACH: Final = 6.0  # [s] Largest offset of the scan
LEAST_COMMON: Final = 2.0  # [s] Least overlap at every offset, with `_COMMON_SHARE` of the largest overlap
_COMMON_SHARE: Final = 0.4
_MEMORY = 1.0  # [s] Correlation time of the differences
SURE: Final = 12.0  # [nats] Least gain of an offset beyond `LIMIT` that is reported; with correct clocks up to 11
AS_GOOD: Final = 4.0  # [nats] Difference below which another offset is as good
_AGREE = 2.0  # [nats] per frame and sensor; image and sensors of the same motion differ by 0.3-1.7


def scan_clocks(images: BoneImages) -> OffsetScan | None:
    """Return the gains of all offsets with enough overlap; None where none within `LIMIT` has it."""
    costs = dict(_costs(images))
    near = [k for k in costs if abs(k) <= round(LIMIT / STEP)]
    if not near:
        return None
    usual = costs[min(near, key=lambda k: float(np.nanmean(costs[k])))]
    a_frame = float(np.median(np.diff(images.frames))) * STEP / _MEMORY
    gains = [a_frame * float(np.nansum(usual - cost)) for cost in costs.values()]
    return OffsetScan(STEP * np.array(list(costs)), np.array(gains))


def _costs(images: BoneImages) -> Iterator[tuple[int, Array]]:
    """Offset in steps and its cost (F,) of all sensors."""
    known = np.isfinite(images.directions).all(axis=-1).any(axis=-1)
    seen = np.isfinite(images.vectors).all(axis=-1).any(axis=-1)
    sensed, video = np.flatnonzero(known), images.frames[seen]
    if len(sensed) == 0 or len(video) < 2:
        return
    a_frame = float(np.median(np.diff(images.frames))) * STEP
    common = min((sensed[-1] - sensed[0]) * STEP, len(video) * a_frame)
    least = max(LEAST_COMMON, _COMMON_SHARE * common)
    reach = round(REACH / STEP)
    steps = np.arange(-reach, reach + 1)
    index = video - steps[:, None]
    steps = steps[a_frame * np.sum((index >= sensed[0]) & (index <= sensed[-1]), axis=1) >= least]
    for step, cost in zip(steps.tolist(), images.differences(steps), strict=True):
        if np.isfinite(cost).any():
            yield step, cost


def check_clocks(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, poses: PoseSequence, skeleton: SkeletonModel
) -> Check:
    """Check that the clocks of video and sensors agree within `LIMIT`; arguments as for `bone_images`."""
    what, images = "video and sensors", bone_images(keypoints, bone_imus, poses, skeleton)
    scan = None if images is None else scan_clocks(images)
    if images is None or scan is None:
        why = f"they have less than {LEAST_COMMON:g} s in common of bones that both show"
        return Check.unknown(NAME, what, "s", why)
    (second, gain), far, why = scan.rival, abs(scan.best) > LIMIT, ""
    rival = f" {-second:+.2f} s would do nearly as well." if gain > scan.gain - AS_GOOD else ""
    if far:
        apart = np.nanmean(images.by_sensor(round(scan.best / STEP)))
        mirrored = bone_images(keypoints, exchanged_sides(bone_imus), poses, skeleton)
        # With alternating sides, half a period later looks like exchanged sides.
        if apart > _AGREE or (mirrored is not None and apart > np.nanmean(mirrored.by_sensor()) - 1e-9):
            why = "image and sensors show different motion at every offset"
        elif scan.gain < SURE:
            why = (
                f"the motion repeats itself, is short or slow: {-scan.best:+.2f} s added to the video's "
                f"times explain it better than any within {LIMIT:g} s, but not surely ({scan.gain:.0f} nats)"
            )
    elif rival and abs(second) > LIMIT:
        why = f"the motion repeats itself: {-second:+.2f} s added to the video's times would do as well"
    if why:
        return Check.unknown(NAME, what, "s", why)
    advice = (
        f"The limbs turn alike when {-scan.best:+.2f} s are added to the video's times (start_s of "
        f"[keypoints]); no offset within {LIMIT:g} s explains the video nearly as well "
        f"({scan.gain:.0f} nats, ± {scan.sigma:.2g} s).{rival}"
    )
    cause = f"video and sensors are more than {LIMIT:g} s apart: the clocks are off by about {abs(scan.best):.1f} s"
    return Check(NAME, what, abs(scan.best), LIMIT, "s", advice, cause=cause)


def sensed_bones(bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> list[tuple[int, int, int]]:
    """Return (sensor, joint, child) of every bone whose segment carries a sensor."""
    index = skeleton.names.index
    return [
        (s, index(joint), child)
        for s, joint in enumerate(bone_imus.joints)
        for child in kinematics.children_of(skeleton.parents, index(joint))
    ]


@dataclass(frozen=True)
class Limbs:
    """Bones from each sensor's joint to its children, in the image plane."""

    seen: Array  # (T, n, 2) of the keypoints at unit depth; zero where missing
    middle: Array  # (T, n, 2) their centres
    bones: Array  # (T, n, 3) of the sensors in camera axes, m; zero where missing

    @classmethod
    def of(cls, keypoints: KeypointSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel) -> Limbs:
        """Collect the bones."""
        sensor, joint, child = np.array(sensed_bones(bone_imus, skeleton)).T
        xy = keypoints.camera.normalise(keypoints.select(skeleton.names).uv_px)
        R_camera_bone = keypoints.camera.R_camera_world @ bone_imus.R_world_bone[:, sensor]
        seen, middle = xy[:, child] - xy[:, joint], (xy[:, child] + xy[:, joint]) / 2
        bones = np.einsum("tnij,nj->tni", R_camera_bone, skeleton.joint_offsets[child])
        known = np.isfinite(np.concatenate([seen, bones], axis=-1)).all(axis=-1, keepdims=True)
        kept = (np.where(known, values, 0.0) for values in (seen, middle, bones))
        return cls(*kept)

    def drawn(self, bones: Array, perspective: ArrayLike = 1.0) -> Array:
        """Return the images (..., T, n, 2) of bones, up to a scale; `bones`: (..., T, n, 3) m, camera axes;
        `perspective`: (...) 1 for the focal length given, 0.5 for one twice as long.
        """
        return projected(bones, np.asarray(perspective)[..., None, None, None] * self.middle)

    def misfit(self, headings: Array, camera: Camera) -> float:
        """Return the misfit of image and sensors: 0 for agreement, 1 for none.

        It is the mean over frames of the squared fraction that no single scale explains, minimised over a
        common heading of all sensors.

        Args:
            headings: (H,) rad.
        """
        R = camera.R_camera_world
        turns = R @ so3.about_axis("z", headings) @ R.T
        drawn = self.drawn(np.einsum("hij,tnj->htni", turns, self.bones))
        both = np.einsum("tni,htni->ht", self.seen, drawn)
        squares = np.sum(self.seen**2, axis=(1, 2)) * np.sum(drawn**2, axis=(2, 3))
        known = squares > 0
        explained = np.maximum(both, 0) ** 2 / np.where(known, squares, 1.0)
        frames = known.sum(axis=1)
        return float(np.min(1 - explained.sum(axis=1) / np.maximum(frames, 1)))
