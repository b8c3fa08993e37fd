"""Windows of time around the middle of a video, in which something is wrong with a recording."""

from __future__ import annotations

import numpy as np

from rtof_kin.core.array_types import Array, Mask

Window = tuple[float, float]
"""Beginning and end, s after the middle of the video."""
MIDDLE_SECOND: Window = (-0.5, 0.5)
MIDDLE_HALF_SECOND: Window = (-0.25, 0.25)
SECOND_AFTER_HALF: Window = (0.0, 1.0)


def bounds(times: Array, window: Window) -> tuple[float, float]:
    """Beginning and end of a window in a video with these times, s."""
    middle = float(times[0] + times[-1]) / 2
    return middle + window[0], middle + window[1]


def inside(times: Array, video_times: Array, window: Window) -> Mask:
    """(T,) which of some times lie in a window of a video."""
    start, stop = bounds(video_times, window)
    return np.asarray((times >= start) & (times < stop))
