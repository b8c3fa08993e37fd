"""The offset between the clocks of video and sensors, from how the limbs turn in both.

Directions of bones in the image and by the sensors are compared at every offset within a wide range. Only
changes of direction count: what a calibration is wrong by for the whole recording moves no minimum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import STEP, BoneImages, bone_images, exchanged_sides
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
NAME = "offset between the clocks of video and sensors"
LIMIT = 0.2
"""[s] Offsets up to this are looked for by the self-calibration, or do little harm."""
REACH = 6.0
"""[s] Largest offset that is looked for."""
LEAST_COMMON = 2.0
"""[s] that both share at every offset, and `_COMMON_SHARE` of what they can share at most."""
_COMMON_SHARE = 0.4
_MEMORY = 1.0
"""[s] for which such a difference lasts."""
SURE, AS_GOOD = 12.0, 4.0
"""Nats by which another offset explains the video better to be named, and worse to be excluded; of
recordings with right clocks, of some steps of walking, another offset was up to 11 nats better."""
_APART = 0.35
"""[s] An offset so far from the best one is another one."""
_AGREE = 2.0
"""Nats a frame and sensor by which image and sensors differ where both are right: 0.3-1.7."""


@dataclass(frozen=True)
class ClockScan:
    """How well each offset of the clocks explains the video."""

    offsets: Array
    """(K,) [s] by which the video's stamps are ahead of the sensors'."""
    gains: Array
    """(K,) nats by which an offset explains the video better than the best one within `LIMIT`."""

    @property
    def best(self) -> float:
        """[s] the offset that explains the video best, by a parabola through it and its neighbours."""
        k = int(np.argmax(self.gains))
        if not 0 < k < len(self.gains) - 1:
            return float(self.offsets[k])
        before, most, after = self.gains[k - 1 : k + 2]
        curvature = before - 2 * most + after
        return float(self.offsets[k] + STEP * (before - after) / (2 * min(curvature, -1e-9)))

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
        if some.any():
            yield steps, np.where(some, np.nansum(cost, axis=1), np.nan)


def check_clocks(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, poses: PoseSequence, skeleton: SkeletonModel
) -> Check:
    """Whether the clocks of video and sensors agree within `LIMIT`; what says otherwise is named.
    Arguments are those of `calibration.bone_images`.
    """
    what = "video and sensors"
    images = bone_images(keypoints, bone_imus, poses, skeleton)
    scan = None if images is None else scan_clocks(images)
    if images is None or scan is None:
        why = f"they have less than {LEAST_COMMON:g} s in common of bones that both show"
        return Check.unknown(NAME, what, "s", why)
    if abs(scan.best) > LIMIT:
        apart = np.nanmean(images.by_sensor(round(scan.best / STEP)))
        mirrored = bone_images(keypoints, exchanged_sides(bone_imus), poses, skeleton)
        # Of a movement that both sides make in turn, half a period later looks as if they were exchanged.
        if apart > _AGREE or (mirrored is not None and apart > np.nanmean(mirrored.by_sensor())):
            why = "image and sensors show different motion at every offset"
            return Check.unknown(NAME, what, "s", why)
    second, gain = scan.second
    rival = f" {-second:+.2f} s would do nearly as well."
    rival = rival if gain > scan.gain - AS_GOOD else ""
    if abs(scan.best) <= LIMIT and rival and abs(second) > LIMIT:
        text = f"the motion repeats itself: {-second:+.2f} s added to the video's times would do as well"
        return Check.unknown(NAME, what, "s", text)
    if abs(scan.best) > LIMIT and scan.gain < SURE:
        text = (
            f"the motion repeats itself, is short or slow: {-scan.best:+.2f} s added to the video's "
            f"times explain it better than any within {LIMIT:g} s, but not surely ({scan.gain:.0f} nats)"
        )
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
