"""Writing ``motion.npz``, whole or by blocks; `motion_npz` has the arrays of the file and reads them."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.compact import multiples, rotation_vectors
from rtof_kin.core.files.npz_writer import NpzWriter
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats import covariance_nodes
from rtof_kin.formats.covariance_nodes import COLUMNS, ROWS, NodeFinder
from rtof_kin.formats.motion_npz import COVARIANCES, MASKS, SCHEMA_VERSION, STORED

_Q_BITS: Final = 24
"""[bits] after the point: errors of up to 0.03 um and 2e-6 deg."""
_SAME: Final = 1e-5
"""Largest difference of positions, m, and entries of rotations that are the forward kinematics of q."""
_FILL: Final = 1024
"""[frames] of poses that are added at once."""


class MotionWriter:
    """Writes a motion by blocks; the file appears complete at the end of the context, or not at all."""

    def __init__(self, path: str | Path, skeleton: SkeletonModel, *, mode: str = "", first_frame: int = 0) -> None:
        """Write nothing yet.

        Args:
            path: the file, which is replaced. first_frame: number of the first frame in the video.
        """
        self._path, self._skeleton = Path(path), skeleton
        self._header: dict[str, NDArray[Any]] = {
            "schema_version": np.array(SCHEMA_VERSION),
            "names": np.array(skeleton.names),
            "dof_names": np.array(skeleton.dof_names),
            "joint_offsets": skeleton.joint_offsets,
            "first_frame": np.array(first_frame),
            "mode": np.array(mode),
            "skeleton": np.array(skeleton.name),
            "mass_kg": np.array(skeleton.table.mass_kg),
            "sex": np.array(skeleton.table.sex or ""),
        }
        self._arrays = NpzWriter(self._path)
        self._open = ExitStack()
        self._frames, self._last = 0, -np.inf
        self._pairs: tuple[tuple[str, str], ...] | None = None
        self._nodes = NodeFinder()

    def __enter__(self) -> Self:
        """Open the file.

        Raises:
            WritingError: it cannot be written.
        """
        with ExitStack() as failed:
            failed.enter_context(self._arrays)
            failed.push(self._finish)
            for name, array in self._header.items():
                self._arrays.add(name, array)
            self._open = failed.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        return self._open.__exit__(kind, error, trace)

    def append(self, motion: Motion) -> None:
        """Append the next frames.

        Args:
            motion: of the same body, with times after those before, and with or without a confidence as all.

        Raises:
            InvalidInputError: another body, earlier times, or a confidence of other pairs.
        """
        skeleton, poses = motion.skeleton, motion.poses
        if skeleton is not self._skeleton and not (
            skeleton.names == self._skeleton.names
            and np.allclose(skeleton.joint_offsets, self._skeleton.joint_offsets, rtol=0, atol=1e-12)
        ):
            raise InvalidInputError(f"{self._path}: the frames to be appended are of another body")
        if poses.times[0] <= self._last:
            raise InvalidInputError(
                f"{self._path}: frames from {poses.times[0]:g} s do not follow those until {self._last:g} s"
            )
        pairs = None if motion.confidence is None else motion.confidence.pairs
        if self._frames and pairs != self._pairs:
            raise InvalidInputError(f"{self._path}: the frames to be appended have another confidence")
        self._pairs = pairs
        q = multiples(motion.q, _Q_BITS)
        self._arrays.append({"times": poses.times, "q": q} | {name: getattr(poses, name) for name in MASKS})
        self._append_poses(q, poses)
        if motion.confidence is not None:
            entries = [getattr(motion.confidence, name)[..., ROWS, COLUMNS] for name in COVARIANCES]
            self._append_nodes(*self._nodes.add(np.concatenate(entries, axis=1)))
        self._frames += len(poses)
        self._last = float(poses.times[-1])

    def _append_poses(self, q: Array, poses: PoseSequence) -> None:
        """Append poses that are not the forward kinematics of `q`."""
        p, R = self._skeleton.forward_kinematics(q)
        stored = ~(_same(p, poses.p_world_joint, _SAME) & _same(R, poses.R_world_bone, _SAME))
        if stored.any() and "poses_stored" not in self._arrays:
            for start in range(0, self._frames, _FILL):
                self._append_none(min(_FILL, self._frames - start))
        if not stored.any() and "poses_stored" in self._arrays:
            self._append_none(len(q))
        elif stored.any():
            turns = rotation_vectors(poses.R_world_bone, _Q_BITS)
            kept = stored[:, None, None]
            self._append_stored(stored, [np.where(kept, part, np.nan) for part in (poses.p_world_joint, turns)])

    def _append_none(self, count: int) -> None:
        """Append frames whose poses are the forward kinematics of `q`."""
        J = len(self._skeleton.names)
        self._append_stored(np.zeros(count, dtype=bool), [np.full((count, J, 3), np.nan)] * 2)

    def _append_stored(self, stored: Mask, values: list[Array]) -> None:
        short = [part.astype(np.float32) for part in values]
        self._arrays.append({"poses_stored": stored} | dict(zip(STORED, short, strict=True)))

    def _append_nodes(self, frames: Index, entries: Array) -> None:
        J = len(self._skeleton.names)
        packed = np.split(covariance_nodes.packed(entries), [J, 2 * J], axis=1)
        self._arrays.append(
            {"covariance_frames": frames.astype(np.int64)} | dict(zip(COVARIANCES, packed, strict=True))
        )

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write what is known at the end."""
        if kind is not None:
            return
        if not self._frames:
            raise InvalidInputError(f"{self._path}: a motion needs at least one frame")
        if self._pairs is not None:
            self._append_nodes(*self._nodes.end())
            self._arrays.add("confidence_pairs", np.array(self._pairs).reshape(-1, 2))


def write_motion_npz(path: str | Path, motion: Motion, *, first_frame: int = 0, mode: str = "") -> None:
    """Write a motion over an existing file.

    Args:
        first_frame: number of the first frame in the video.

    Raises:
        RtofError: it cannot be written.
    """
    with MotionWriter(path, motion.skeleton, mode=mode, first_frame=first_frame) as writer:
        writer.append(motion)


def _same(a: Array, b: Array, largest: float) -> Mask:
    """Return a mask (T,) of frames in which all numbers (T, ...) are near, or NaN in both."""
    near = (np.abs(a - b) <= largest) | (np.isnan(a) & np.isnan(b))
    return np.asarray(near.reshape(len(a), -1).all(axis=1))
