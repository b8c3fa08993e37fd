"""`MotionBlocks`: a motion on the disk, by frames, however long it is."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_times
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.core.files.scanned_file import ScannedFile
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.motion_npz import SCHEMA_VERSION

_POSES: Final = ("p_world_joint", "R_world_bone", "valid", "provenance", "orientation_observed")
_COVARIANCES: Final = ("position_covariance", "relative_covariance", "turn_covariance")
_ROWS: Final = ("times", "q", *_POSES, "direction_observed", *_COVARIANCES)
"""Arrays with one row per frame."""
_HEADER: Final = ("schema_version", "names", "joint_offsets", "skeleton", "mode", "confidence_pairs")
_HEADER_BYTES: Final = 2**20


class MotionBlocks(ScannedFile):
    """Frames of a ``motion.npz``, which become readable from the first on while a thread passes over it.

    Attributes:
        path: the file. times: (T,) s. skeleton: of the person. mode: of the reconstruction.
    """

    def __init__(self, path: Path):
        """Read the header and the times, and start the thread; end it with `close`.

        Args:
            path: ``motion.npz``.

        Raises:
            FileFormatError: missing, damaged, of a newer schema, or not a motion.
        """
        with ExitStack() as failed:
            rows = self._open(path, failed)
            failed.pop_all()
        super().__init__(path, rows)

    def _open(self, path: Path, failed: ExitStack) -> NpzBlocks:
        header = read_npz_as_saved(path, _HEADER_BYTES, kinds="iubfU", names=_HEADER)
        try:
            if (version := int(header["schema_version"])) > SCHEMA_VERSION:
                raise FileFormatError(
                    path, f"schema version {version} is newer than {SCHEMA_VERSION}; update rtof_kin"
                )
            skeleton = SkeletonModel.named(str(header["skeleton"]))
            self.skeleton = skeleton.with_offsets(header["joint_offsets"])
            self.skeleton.check_joints(tuple(map(str, header["names"])))
            self.mode = str(header["mode"])
            pairs = header.get("confidence_pairs", np.empty((0, 2), dtype="U1"))
            self._pairs = tuple((str(parent), str(child)) for parent, child in pairs)
            rows = NpzBlocks(path, _ROWS)
            failed.callback(rows.close)
            self.times: Array = checked_times("motion times", rows.whole("times"))
        except FileFormatError:
            raise
        except KeyError as error:
            raise FileFormatError(path, f"the array {error} is missing; reconstruct again") from error
        except (RtofError, ValueError, TypeError) as error:
            raise FileFormatError(path, str(error)) from error
        if missing := [name for name in ("q", *_POSES) if name not in rows]:
            raise FileFormatError(path, f"the array {missing[0]!r} is missing; reconstruct again")
        return rows

    def __len__(self) -> int:
        return len(self.times)

    @property
    def rate_hz(self) -> float:
        """Frame rate, Hz, from the median step; 60 for a single frame."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0

    def frame_at(self, time: float) -> int:
        """Return the frame nearest to a time.

        Args:
            time: s.
        """
        after = int(np.searchsorted(self.times, time))
        if after == 0 or after == len(self):
            return min(after, len(self) - 1)
        return after - int(time - self.times[after - 1] < self.times[after] - time)

    def frames(self, start: int, stop: int) -> MotionSequence:
        """Return frames as a motion.

        Args:
            start, stop: within `available`.

        Raises:
            FileFormatError: a value in them is invalid.
        """
        arrays: dict[str, NDArray[Any]] = {
            name: self._rows.rows(name, start, stop) for name in _ROWS[1:] if name in self._rows
        }
        times, names = self.times[start:stop], self.skeleton.names
        try:
            fields: Any = {name: arrays[name] for name in (*_POSES, "direction_observed") if name in arrays}
            poses = PoseSequence(times=times, names=names, **fields)
            confidence = None
            if all(name in arrays for name in _COVARIANCES):
                known: Any = {name: arrays[name].astype(float) for name in _COVARIANCES}
                confidence = Confidence(times=times, names=names, pairs=self._pairs, **known)
            q = arrays["q"]
            return MotionSequence(self.skeleton, q, poses, self.skeleton.check(q), confidence)
        except (RtofError, ValueError, TypeError) as error:
            raise FileFormatError(self.path, f"frames {start} to {stop}: {error}") from error

    def root(self, start: int, stop: int, step: int = 1) -> tuple[Array, NDArray[np.uint8]]:
        """Return positions (n, 3) of the root, m, NaN where missing, and their provenance (n,).

        Args:
            start, stop: frames within `available`. step: only every so many.

        Raises:
            FileFormatError: the file is damaged.
        """
        p = self._rows.rows("p_world_joint", start, stop)[::step, 0]
        provenance = self._rows.rows("provenance", start, stop)[::step, 0]
        return np.array(p, dtype=float), np.clip(provenance, 0, max(Provenance)).astype(np.uint8)
