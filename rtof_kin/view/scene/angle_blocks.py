"""`AngleBlocks`: clinical angles of a motion of any length, around a time."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.view.scene.block_cache import BlockCache
from rtof_kin.view.scene.motion_blocks import MotionBlocks

WHOLE_S: Final = 300.0
"""[s] Longest motion whose angles are computed at once, as by `analyse`."""
_PART_S: Final = 60.0
_MOVES: Final = np.radians(1.0)
"""[rad] Range of a hinge beyond which constant other angles are seen to be fixed."""
_MARGIN_S: Final = 8.0
"""[s] before and after a part, so that a window of it is whole."""


class AngleBlocks:
    """Angles by name, computed for the whole motion or for parts of it.

    Of a hinge of the model the other two angles are constant, which shows only while it moves: of a motion in
    parts they are left out until a part has shown that they vary.

    Attributes:
        names: of the angles. labels: the same with spaces. in_parts: whether the motion is too long to be
            computed at once.
    """

    def __init__(self, motion: MotionBlocks):
        """Compute nothing yet."""
        self._motion = motion
        table = angle_table(motion.skeleton.table)
        self.names = tuple(row.name for row in table.rows)
        self.labels = tuple(row.label for row in table.rows)
        self._hinges = [3 * number for number, joint in enumerate(table.joints) if joint.hinge]
        self._doubtful = {first + k for first in self._hinges for k in (1, 2)}
        self.in_parts = motion.times[-1] - motion.times[0] > WHOLE_S
        size = int(_PART_S * motion.rate_hz) if self.in_parts else len(motion)
        self._blocks = BlockCache(len(motion), self._available, self._compute, max(size, 1))

    def part(self, frame: int, seconds: float = 0.0) -> ClinicalAngles | None:
        """Return the angles of the part of the motion around a frame; None while they are computed.

        Raises:
            RtofError: the motion cannot be read.
        """
        found = self._blocks.at(frame, seconds)
        if found is None or not self.in_parts:
            return None if found is None else found[0]
        values = found[0].values.copy()
        values[:, sorted(self._doubtful)] = np.nan
        return replace(found[0], values=values)

    def close(self) -> None:
        """Stop computing."""
        self._blocks.close()

    def _available(self) -> int:
        if self._motion.available == len(self._motion):
            return len(self._motion)
        margin = int(_MARGIN_S * self._motion.rate_hz) if self.in_parts else 0
        return max(self._motion.available - margin, 0)

    def _compute(self, start: int, stop: int) -> ClinicalAngles:
        margin = int(_MARGIN_S * self._motion.rate_hz) if self.in_parts else 0
        found = clinical_angles(self._motion.frames(max(start - margin, 0), min(stop + margin, len(self._motion))))
        for first in self._hinges:
            values = found.values[:, first : first + 3]
            known = np.isfinite(values[:, 0])
            if known.any() and np.ptp(values[known, 0]) > _MOVES:
                self._doubtful -= {first + k for k in (1, 2) if np.isfinite(values[:, k]).any()}
        return found
