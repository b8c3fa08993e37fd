"""Poses of a window's frames, with what observed them."""

from __future__ import annotations

import numpy as np

from rtof_kin.body.observability import WHOLE, levels_by_points
from rtof_kin.core.array_types import Mask
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import LONGEST_BRIDGE, PoseSequence, Provenance
from rtof_kin.live.estimation.window import Window


class WindowPoses:
    """Poses of the frames of a window."""

    def __init__(self, window: Window) -> None:
        """Take the window."""
        self._window, self._skeleton = window, window.skeleton
        self._whole_of: dict[bytes, Mask] = {}

    def of(self, i: int, time: float) -> PoseSequence:
        """Return the pose of a frame: provenance, validity and observed orientations as after SF2.

        Args:
            time: of the frame, s.
        """
        window, skeleton = self._window, self._skeleton
        p, R = window.data.space.poses(window.smoother.x[i : i + 1])
        seen, sensed = window.seen[i], self._sensed(i)
        by_imu = np.zeros(len(seen), dtype=bool)
        by_imu[1:] = sensed[list(skeleton.parents[1:])]  # the segments that end in the joints
        person = window.camera is None or seen.any()
        unseen = Provenance.PRIOR if person else Provenance.BRIDGED
        provenance = np.where(
            by_imu, np.where(seen, Provenance.CAMERA_AND_IMU, Provenance.IMU), np.where(seen, Provenance.CAMERA, unseen)
        )
        first = max(i - round(LONGEST_BRIDGE * window.smoother.rate_hz), 0)
        valid: Mask = np.asarray(window.seen[first : i + 1].any(axis=0))
        if window.camera is None:
            valid = np.concatenate([[sensed.any()], by_imu[1:]])
        for j, parent in enumerate(skeleton.parents):
            valid[j] |= parent >= 0 and by_imu[j] and valid[parent]
        return PoseSequence(
            np.array([time]),
            p,
            R,
            skeleton.names,
            provenance[None].astype(np.uint8),
            valid[None],
            (sensed | (self._whole(seen) & valid))[None],
        )

    def _sensed(self, i: int) -> Mask:
        """(J,) segments whose sensor has data in frame i."""
        out = np.zeros(len(self._skeleton.names), dtype=bool)
        has = self._window.smoother.rows["w_sensor"][i] > 0
        out[list(self._window.data.problem.energy["orientation"].sensors)] = has
        return out

    def _whole(self, seen: Mask) -> Mask:
        """(J,) segments whose orientation the joints seen determine."""
        camera, key = self._window.camera, seen.tobytes()
        if key not in self._whole_of:
            levels = np.zeros(len(seen), dtype=int)
            if camera is not None and seen.any():
                uv = np.where(seen[None, :, None], 0.0, np.nan) * np.ones(2)
                sure = seen[None].astype(float)
                points = KeypointSequence(camera, np.zeros(1), uv, sure, self._skeleton.names)
                levels = levels_by_points(self._skeleton, points)[0]
            self._whole_of[key] = levels == WHOLE
        return self._whole_of[key]
