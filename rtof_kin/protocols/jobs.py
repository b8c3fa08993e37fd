"""The unit of work of a protocol: one take seen by one camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Job:
    """One take of a protocol seen by one camera, or without a camera."""

    protocol: Any
    subject: str
    take: str
    camera: int | None

    def motion_file(self, mode: str) -> Path | None:
        """Return the path of a saved motion, or None if motions are not saved."""
        save: Path | None = self.protocol.save
        if save is None or self.camera is None:
            return None
        return save / self.subject / self.take / f"cam{self.camera}" / mode / "motion.h5"
