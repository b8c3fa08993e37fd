"""Offset between the clocks of video and sensors, from the rotation of the limbs.

Directions of bones in the image and by the sensors are compared at every offset within a wide range.
Constant differences are removed, so constant errors of the calibration have no effect.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import STEP, BoneImages, bone_images, exchanged_sides
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence

NAME: Final = "offset between the clocks of video and sensors"
LIMIT: Final = 0.2
"""[s] Largest offset that the self-calibration estimates."""
REACH: Final = 6.0
"""[s] Largest offset of the scan."""
LEAST_COMMON: Final = 2.0
"""[s] Least overlap at every offset, with `_COMMON_SHARE` of the largest overlap."""
_COMMON_SHARE: Final = 0.4
_MEMORY: Final = 1.0
"""[s] Correlation time of the differences."""
SURE: Final = 12.0
"""[nats] Least gain of an offset beyond `LIMIT` that is reported; with correct clocks up to 11."""
AS_GOOD: Final = 4.0
"""[nats] Difference below which another offset is as good."""
_APART: Final = 0.35
"""[s] Least distance of another offset."""
_AGREE: Final = 2.0
"""[nats] per frame and sensor; image and sensors of the same motion differ by 0.3-1.7."""


@dataclass(frozen=True)
class ClockScan:
    """Gain of each offset of the clocks."""

    offsets: Array
    """(K,) [s] of the video's stamps relative to the sensors'."""
    gains: Array
    """(K,) [nats] relative to the best offset within `LIMIT`."""

    @property
    def best(self) -> float:
        """[s] Best offset, by a parabola through it and its neighbours."""
        k = int(np.argmax(self.gains))
        if not 0 < k < len(self.gains) - 1:
            return float(self.offsets[k])
        return float(self.offsets[k] + STEP * signals.vertex(*self.gains[k - 1 : k + 2]))

    @property
    def gain(self) -> float:
        """[nats] Gain of the best offset."""
        return float(self.gains.max())

    @property
    def second(self) -> tuple[float, float]:
        """Best offset at least `_APART` from the best one, [s], and its gain [nats]."""
        other = np.where(np.abs(self.offsets - self.best) > _APART, self.gains, -np.inf)
        return float(self.offsets[np.argmax(other)]), float(other.max())

    @property
    def width(self) -> float:
        """[s] Width of the range around the best offset within half a nat."""
        low = high = int(np.argmax(self.gains))
        while low > 0 and self.gains[low - 1] > self.gain - 0.5:
            low -= 1
        while high + 1 < len(self.gains) and self.gains[high + 1] > self.gain - 0.5:
            high += 1
        return STEP * (high - low + 1)


def scan_clocks(images: BoneImages) -> ClockScan | None:
    """Return the gains of all offsets with enough overlap; None where none within `LIMIT` has it."""
    costs = dict(_costs(images))
    near = [k for k in costs if abs(k) <= round(LIMIT / STEP)]
    if not near:
        return None
    usual = costs[min(near, key=lambda k: float(np.nanmean(costs[k])))]
    a_frame = float(np.median(np.diff(images.frames))) * STEP / _MEMORY
    gains = [a_frame * float(np.nansum(usual - cost)) for cost in costs.values()]
    return ClockScan(STEP * np.array(list(costs)), np.array(gains))


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
    """Check that the clocks of video and sensors agree within `LIMIT`.

    Args:
        keypoints, bone_imus, poses, skeleton: as for `bone_images`.
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
        # With alternating sides, half a period later looks like exchanged sides.
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
        NAME,
        what,
        abs(scan.best),
        LIMIT,
        "s",
        f"The limbs turn alike when {-scan.best:+.2f} s are added to the video's times (start_s of "
        f"[keypoints]); no offset within {LIMIT:g} s explains the video nearly as well "
        f"({scan.gain:.0f} nats, to within {scan.width:.2g} s).{rival}",
        cause=(
            f"video and sensors are more than {LIMIT:g} s apart: the clocks are off by about {abs(scan.best):.1f} s"
        ),
    )
