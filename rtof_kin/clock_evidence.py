"""The offset between the clocks of video and sensors, from how the limbs turn in both.

A sensor's orientation, read with its calibration, is a direction of its bone at every instant; the image
shows the same direction, foreshortened. The two are compared at every offset within a wide range, frame by
frame and without any solve. Only changes of direction count: what a calibration is wrong by for the whole
recording does not move the minimum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin.plausibility import Check
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence

Array = NDArray[np.float64]
NAME = "offset between the clocks of video and sensors"
LIMIT = 0.2
"""[s] Offsets up to this are looked for by the self-calibration, or do little harm."""
STEP = 0.1
"""[s] between offsets."""
REACH = 10.0
"""[s] Largest offset that is looked for."""
LEAST_COMMON = 2.0
"""[s] that video and sensors share at every offset, and `_COMMON_SHARE` of what they can share at most."""
_COMMON_SHARE = 0.4
_MOST_FRAMES = 300
_SIGMA, _SIGMA_M = 0.12, 0.04
"""Size of the difference of a bone's image and its sensor's, as a share of the bone, and [m]."""
_MEMORY = 1.0
"""[s] for which such a difference lasts."""
SURE, AS_GOOD = 10.0, 4.0
"""Nats by which another offset explains the video better to be named, and worse to be excluded; of
recordings with right clocks and periodic motion, another offset was up to 7 nats better."""
_APART = 0.35
"""[s] An offset so far from the best one is another one."""


@dataclass(frozen=True)
class BoneImages:
    """Bones that carry sensors, as the image shows them and as the sensors say."""

    frames: NDArray[np.intp]
    """(F,) index of each frame in the grid of `directions`."""
    vectors: Array
    """(F, B, 2) from one end of the bone to the other in the image, in lengths of the bone."""
    rays: Array
    """(F, B, 2) image-plane coordinates of the bone's middle."""
    directions: Array
    """(G, B, 3) of the bones in camera axes, every `STEP`, by the sensors; NaN where not known."""
    sigma: Array
    """(B,) size of the differences."""
    weight: Array
    """(B,) 1 / bones of the same sensor."""
    sensors: NDArray[np.intp]
    """(B,) index of the sensor on each bone."""

    def cost(self, steps: int, constant: bool = True) -> Array:
        """(F, B) nats by which the two differ, where the sensors' clock is shifted.

        Args:
            steps: offset of the video's stamps against the sensors', in `STEP`.
            constant: whether each bone may differ by a constant.
        """
        index = self.frames - steps
        inside = (index >= 0) & (index < len(self.directions))
        d = self.directions[np.where(inside, index, 0)]
        off = self.vectors - d[..., :2] + self.rays * d[..., 2:]
        known = inside[:, None] & np.isfinite(off[..., 0])
        off = np.where(known[..., None], off, 0.0)
        if constant:
            off = off - off.sum(axis=0) / np.maximum(known.sum(axis=0), 1)[:, None]
        square = np.einsum("fbi,fbi->fb", off, off) / self.sigma**2
        return np.where(known, 1.5 * np.log1p(square / 3), np.nan)


def bone_images(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, poses: PoseSequence, skeleton: SkeletonModel
) -> BoneImages | None:
    """What image and sensors say of the bones between joints that were both looked for.

    Args:
        keypoints: evenly spaced. bone_imus: at the sensors' own times.
        poses: any poses at the keypoints' times: only the root's distance from the camera is used.

    Returns:
        None where no sensor is on a bone whose ends the detector knows.
    """
    step_frames = max(1, round(STEP * poses.rate_hz))
    chosen = np.arange(0, len(keypoints), max(step_frames, -(-len(keypoints) // _MOST_FRAMES)))
    seen, camera = keypoints.select(skeleton.names), keypoints.camera
    xy = camera.normalise(seen.uv_px[chosen])
    depth = camera.to_camera(poses.p_world_joint[chosen, 0])[:, 2]
    ends = [
        (s, j, child)
        for s, j in enumerate(skeleton.index(*bone_imus.joints))
        for child in kinematics.children_of(skeleton.parents, j)
        if {skeleton.names[j], skeleton.names[child]} <= set(keypoints.names)
    ]
    if not ends:
        return None
    s, j, c = (np.array(column) for column in zip(*ends, strict=True))
    rest = skeleton.joint_offsets[c]
    length = np.linalg.norm(rest, axis=-1)
    start, G = bone_imus.times[0], int(np.ptp(bone_imus.times) / STEP) + 1
    at = np.searchsorted(bone_imus.times, start + STEP * np.arange(G)).clip(0, len(bone_imus) - 1)
    R = np.einsum("ij,gbjk->gbik", camera.R_camera_world, bone_imus.R_world_bone[at][:, s])
    return BoneImages(
        frames=np.round((keypoints.times[chosen] - start) / STEP).astype(np.intp),
        vectors=(xy[:, c] - xy[:, j]) * depth[:, None, None] / length[:, None],
        rays=(xy[:, c] + xy[:, j]) / 2,
        directions=np.einsum("gbik,bk->gbi", R, rest / length[:, None]),
        sigma=np.hypot(_SIGMA, _SIGMA_M / length),
        weight=1 / np.bincount(s)[s],
        sensors=s,
    )


@dataclass(frozen=True)
class ClockScan:
    """How well each offset of the clocks explains the video."""

    offsets: Array
    """(K,) [s] by which the video's stamps are ahead of the sensors'."""
    gains: Array
    """(K,) nats by which an offset explains the video better than the best one within `LIMIT`."""

    @property
    def best(self) -> float:
        """[s] the offset that explains the video best."""
        return float(self.offsets[np.argmax(self.gains)])

    @property
    def gain(self) -> float:
        """Nats of the best offset."""
        return float(self.gains.max())

    @property
    def second(self) -> tuple[float, float]:
        """The best offset that is another one [s], and its nats."""
        other = np.where(np.abs(self.offsets - self.best) > _APART, self.gains, -np.inf)
        return float(self.offsets[np.argmax(other)]), float(other.max())

    @property
    def width(self) -> float:
        """[s] of the range around the best offset in which all are within half a nat of it."""
        low = high = int(np.argmax(self.gains))
        while low > 0 and self.gains[low - 1] > self.gain - 0.5:
            low -= 1
        while high + 1 < len(self.gains) and self.gains[high + 1] > self.gain - 0.5:
            high += 1
        return STEP * (high - low + 1)


def scan_clocks(images: BoneImages) -> ClockScan | None:
    """Every offset that leaves enough in common; None where that is not so of none within `LIMIT`."""
    costs = dict(_costs(images))
    near = [k for k in costs if abs(k) <= round(LIMIT / STEP)]
    if not near:
        return None
    usual = costs[min(near, key=lambda k: float(np.nanmean(costs[k])))]
    a_frame = float(np.median(np.diff(images.frames))) * STEP / _MEMORY
    gains = [a_frame * float(np.nansum(usual - cost)) for cost in costs.values()]
    return ClockScan(STEP * np.array(list(costs)), np.array(gains))


def _costs(images: BoneImages) -> Iterator[tuple[int, Array]]:
    """Offset in steps and its cost (F,), of all sensors together."""
    known = np.isfinite(images.directions).all(axis=-1).any(axis=-1)
    seen = np.isfinite(images.vectors).all(axis=-1).any(axis=-1)
    sensed, video = np.flatnonzero(known), images.frames[seen]
    if len(sensed) == 0 or len(video) < 2:
        return
    a_frame = float(np.median(np.diff(images.frames))) * STEP
    common = min((sensed[-1] - sensed[0]) * STEP, len(video) * a_frame)
    least = max(LEAST_COMMON, _COMMON_SHARE * common)
    reach = round(REACH / STEP)
    for steps in range(-reach, reach + 1):
        index = video - steps
        if a_frame * np.sum((index >= sensed[0]) & (index <= sensed[-1])) < least:
            continue
        cost = images.cost(steps) * images.weight
        some = np.isfinite(cost).any(axis=1)
        yield steps, np.where(some, np.nansum(cost, axis=1), np.nan)


def check_clocks(images: BoneImages | None) -> Check:
    """Whether the clocks of video and sensors agree within `LIMIT`; what says otherwise is named."""
    what = "video and sensors"
    scan = None if images is None else scan_clocks(images)
    if scan is None:
        why = f"they have less than {LEAST_COMMON:g} s in common of bones that both show"
        return Check.unknown(NAME, what, "s", why)
    second, gain = scan.second
    rival = f" An offset of {second:+.2f} s explains the video nearly as well."
    rival = rival if gain > scan.gain - AS_GOOD else ""
    if abs(scan.best) <= LIMIT and rival and abs(second) > LIMIT:
        return Check.unknown(NAME, what, "s", f"the motion repeats itself.{rival}")
    if abs(scan.best) > LIMIT and scan.gain < SURE:
        text = f"the motion repeats itself, or is slow: {scan.best:+.2f} s explains the video as well"
        return Check.unknown(NAME, what, "s", text)
    return Check(
        NAME, what, abs(scan.best), LIMIT, "s",
        f"The limbs turn alike when {-scan.best:+.2f} s are added to the video's times (start_s of "
        f"[keypoints]); no offset within {LIMIT:g} s explains the video nearly as well "
        f"({scan.gain:.0f} nats, to within {scan.width:.2g} s).{rival}",
        cause=(
            f"video and sensors are more than {LIMIT:g} s apart: the clocks are off by about "
            f"{abs(scan.best):.1f} s"
        ),
    )  # fmt: skip
