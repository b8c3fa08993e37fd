"""``motion.npz``: a reconstructed motion with everything needed to use it, arrays of a known schema.

Positions and orientations are the forward kinematics of `q` and are computed when read, except in frames
where the motion has others. Arrays of a file of version 2, with T frames, J joints and P pairs of segments:

======================  ===============  ================================================================
times                   (T,)             s
q                       (T, nq)          configurations, multiples of 2^-24 m and rad
valid                   (T, J)           these four as in `PoseSequence`
provenance              (T, J)
orientation_observed    (T, J)
direction_observed      (T, J)
poses_stored            (T,)             True where the next two are not those of `q`; absent if nowhere
p_world_joint           (T, J, 3)        m, in these frames; NaN in others
rotvec_world_bone       (T, J, 3)        rad, rotation vectors of the segments, the same
covariance_frames       (K,)             frames of the covariances, see `covariance_nodes`
position_covariance     (K, J, 6)        these three as in `Confidence`, entries xx, yy, zz, xy, xz, yz
relative_covariance     (K, J, 6)
turn_covariance         (K, P, 6)
confidence_pairs        (P, 2)           names
schema_version, names, dof_names, joint_offsets, first_frame, mode, skeleton: as in `MotionFile`
mass_kg, sex: the same, '' for unknown; may be absent
======================  ===============  ================================================================

Version 1 has `p_world_joint`, `R_world_bone` and whole covariances of every frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion, known_body
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, RtofError, ShapeError
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats import covariance_nodes
from rtof_kin.formats.frame_reader import FrameReader

MOTION: Final = "motion.npz"
SCHEMA_VERSION: Final = 2
_OF_RUN: Final = "motion"
"""Folder of the motion in the output of `run`."""
MASKS: Final = ("valid", "provenance", "orientation_observed", "direction_observed")
"""Fields of `PoseSequence` in the file."""
STORED: Final = ("p_world_joint", "rotvec_world_bone")
_WHOLE: Final = ("p_world_joint", "R_world_bone")
"""Poses in a file of version 1."""
COVARIANCES: Final = ("position_covariance", "relative_covariance", "turn_covariance")
_HEADER: Final = (
    "schema_version",
    "names",
    "dof_names",
    "joint_offsets",
    "first_frame",
    "mode",
    "skeleton",
    "confidence_pairs",
    "covariance_frames",
    "mass_kg",
    "sex",
)
_HEADER_BYTES: Final = 64 * 2**20
_AHEAD: Final = 1024
"""[frames] of all arrays that become readable together."""


@dataclass(frozen=True)
class MotionFile:
    """Content of a ``motion.npz``, or of some of its frames."""

    q: Array
    """(T, nq) configurations of the personalised URDF, Pinocchio's order."""
    poses: PoseSequence
    """Joint positions and segment orientations in world, validity and provenance."""
    dof_names: tuple[str, ...]
    """Names of q[:, 7:]; q[:, :7] are the root's position and quaternion x y z w."""
    joint_offsets: Array
    """(J, 3) m, of the skeleton."""
    first_frame: int
    """Number of the file's first frame in the video the recording was cut from."""
    mode: str
    """Mode of the reconstruction: 'lift', 'sf2', 'rto' or 'rtof'."""
    skeleton: str
    """Name of the skeleton, see `SkeletonModel.named`."""
    confidence: Confidence | None = None
    """Covariances of the poses; None where absent."""
    mass_kg: float | None = None
    """Body mass, kg; None for that of the skeleton's table."""
    sex: str | None = None
    """'male', 'female' or None where unknown."""

    def motion(self) -> Motion:
        """Return the motion on the subject's skeleton."""
        skeleton = known_body(self.skeleton, self.joint_offsets.tobytes(), self.mass_kg, self.sex)
        return Motion(skeleton, self.q, self.poses, skeleton.check(self.q), self.confidence)


def motion_path(path: str | Path) -> Path:
    """Return the motion's file in an output folder.

    Args:
        path: output of `reconstruct` or `run`, or the file itself.

    Raises:
        FileFormatError: a folder without a motion.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    for found in (path / MOTION, path / _OF_RUN / MOTION):
        if found.is_file():
            return found
    raise FileFormatError(path / MOTION, "no such file; name the output folder of reconstruct or run")


def motion_folder(path: str | Path) -> Path:
    """Return the folder of the motion's file.

    Args:
        path: as for `motion_path`.

    Raises:
        FileFormatError: there is no such folder or file, or no motion in it.
    """
    found = motion_path(path)
    if not found.is_file():
        raise FileFormatError(found, "there is no such file; name the output folder of reconstruct or run")
    if found.suffix != ".npz":
        raise FileFormatError(found, "is no motion; name the output folder of reconstruct or run")
    return found.parent


class MotionReader(FrameReader[MotionFile]):
    """Frames of a ``motion.npz``, however long it is; a context that closes the file.

    Attributes:
        path: the file. times: (T,) s. skeleton: of the person. names: J joints. dof_names, mode, first_frame:
            as in `MotionFile`.
    """

    def __init__(self, path: str | Path):
        """Read the header and the times.

        Raises:
            FileFormatError: missing, damaged, of a newer schema, or not a motion.
        """
        self.path = Path(path)
        header = read_npz_as_saved(self.path, _HEADER_BYTES, kinds="iubfU", names=_HEADER)
        with ExitStack() as failed:
            try:
                self._read_header(header)
                self._open(header, failed)
            except FileFormatError:
                raise
            except KeyError as error:
                raise FileFormatError(self.path, f"the array {error} is missing; reconstruct again") from error
            except (RtofError, ValueError, TypeError) as error:
                raise FileFormatError(self.path, str(error)) from error
            failed.pop_all()

    def _read_header(self, header: Mapping[str, NDArray[Any]]) -> None:
        self._version = int(header["schema_version"])
        if self._version > SCHEMA_VERSION:
            raise FileFormatError(
                self.path, f"schema version {self._version} is newer than {SCHEMA_VERSION}; update rtof_kin"
            )
        self.names = _names("names", header["names"])
        self.dof_names = _names("dof_names", header["dof_names"])
        offsets = readonly("joint_offsets", header["joint_offsets"], (len(self.names), 3))
        self._offsets: Array = offsets
        self._skeleton_name = str(header["skeleton"])
        self._mass = float(header["mass_kg"]) if "mass_kg" in header else None
        self._sex = str(header.get("sex", "")) or None
        self.skeleton = known_body(self._skeleton_name, offsets.tobytes(), self._mass, self._sex)
        self.skeleton.check_joints(self.names)
        self.first_frame, self.mode = int(header["first_frame"]), str(header["mode"])
        pairs = header.get("confidence_pairs", np.empty((0, 2), dtype="U1"))
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ShapeError(f"confidence_pairs: expected pairs of names, got shape {pairs.shape}")
        self._pairs = tuple((str(parent), str(child)) for parent, child in pairs)

    def _open(self, header: Mapping[str, NDArray[Any]], failed: ExitStack) -> None:
        """Open the arrays with rows and check that none is missing."""
        first = self._version == 1
        covariances = COVARIANCES if self._pairs else ()
        own = (*_WHOLE, *covariances) if first else (*STORED, "poses_stored")
        self._rows = NpzBlocks(self.path, ("times", "q", *MASKS, *own))
        failed.callback(self._rows.close)
        self.times: Array = checked_times("motion times", self._rows.whole("times"))
        optional = ("direction_observed",) if first else (*STORED, "poses_stored")
        _require(self._rows, {"q", *MASKS, *own} - set(optional))
        if "poses_stored" in self._rows:
            _require(self._rows, set(own))
        self._nodes: NpzBlocks | None = None
        if covariances and not first:
            self._node_frames = covariance_nodes.checked_nodes(
                "covariance_frames", header["covariance_frames"], len(self)
            )
            self._nodes = NpzBlocks(self.path, covariances)
            failed.callback(self._nodes.close)
            _require(self._nodes, set(covariances))
            if self._nodes.length != len(self._node_frames):
                raise ShapeError(f"covariance_frames: {len(self._node_frames)} for {self._nodes.length} rows")

    def close(self) -> None:
        """Close the file."""
        self._rows.close()
        if self._nodes is not None:
            self._nodes.close()

    @property
    def rate_hz(self) -> float:
        """Frame rate, Hz, from the median step; 60 for a single frame."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else 60.0

    @property
    def available(self) -> int:
        """Number of frames, from the first, that `scan` has passed."""
        if self._nodes is None or self._nodes.available == self._nodes.length:
            return self._rows.available
        passed = self._nodes.available
        return min(self._rows.available, int(self._node_frames[passed - 1]) + 1 if passed else 0)

    def scan(self, stop: Event | None = None, until: int | None = None) -> None:
        """Pass over the file; see `FrameReader.scan`."""
        wanted = len(self) if until is None else until
        while (done := self.available) < wanted and not (stop is not None and stop.is_set()):
            ahead = min(done + _AHEAD, wanted)
            self._rows.scan(stop, ahead)
            if self._nodes is not None:
                self._nodes.scan(stop, int(np.searchsorted(self._node_frames, ahead - 1)) + 1)

    def block(self, start: int, stop: int, confidence: bool = True) -> MotionFile:
        """Return frames; see `FrameReader.block`.

        Args:
            confidence: whether to read it if there is one, which takes longest.
        """
        self._find(start, stop)
        try:
            q = readonly("q", self._rows.rows("q", start, stop), (stop - start, 7 + len(self.dof_names)))
            masks: dict[str, Any] = {name: self._rows.rows(name, start, stop) for name in MASKS if name in self._rows}
            p, R = self._poses(q, start, stop)
            poses = PoseSequence(self.times[start:stop], p, R, self.names, **masks)
            known = self._confidence(start, stop) if self._pairs and confidence else None
        except (RtofError, ValueError, TypeError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(self.path, f"frames {start} to {stop}: {error}") from error
        about = (self.dof_names, self._offsets, self.first_frame, self.mode, self.skeleton.name)
        return MotionFile(q, poses, *about, known, self._mass, self._sex)

    def source(self) -> MotionSource:
        """Return the motion, to be read while the file is open."""
        return MotionSource(self.skeleton, self.times, lambda *frames: self.block(*frames).motion())

    def root(self, start: int, stop: int) -> tuple[Array, NDArray[np.uint8]]:
        """Return positions (n, 3) of the root, m, NaN where missing, and their provenance (n,), fast.

        Raises:
            FileFormatError: the file is damaged.
        """
        self.scan(until=stop)
        if "p_world_joint" in self._rows:
            p = self._rows.rows("p_world_joint", start, stop)[:, 0].astype(float)
        else:
            p = np.array(self._rows.rows("q", start, stop)[:, :3], dtype=float)
        if "poses_stored" in self._rows:
            stored = self._rows.rows("poses_stored", start, stop) > 0
            p = np.where(stored[:, None], p, self._rows.rows("q", start, stop)[:, :3])
        provenance = self._rows.rows("provenance", start, stop)[:, 0]
        return p, np.clip(provenance, 0, max(Provenance)).astype(np.uint8)

    def _poses(self, q: Array, start: int, stop: int) -> tuple[Array, Array]:
        """Return positions (n, J, 3) and orientations (n, J, 3, 3)."""
        if self._version == 1:
            return self._rows.rows("p_world_joint", start, stop), self._rows.rows("R_world_bone", start, stop)
        p, R = self.skeleton.forward_kinematics(q)
        if "poses_stored" in self._rows:
            stored: Mask = readonly("poses_stored", self._rows.rows("poses_stored", start, stop), (len(q),), np.bool_)
            given, turns = (self._rows.rows(name, start, stop)[stored].astype(float) for name in STORED)
            p[stored], R[stored] = given, so3.known_exp(turns)
        return p, R

    def _confidence(self, start: int, stop: int) -> Confidence:
        if self._nodes is None:
            known = {name: self._rows.rows(name, start, stop).astype(float) for name in COVARIANCES}
        else:
            first = int(np.searchsorted(self._node_frames, start, side="right")) - 1
            last = int(np.searchsorted(self._node_frames, stop - 1)) + 1
            at, frames = self._node_frames[first:last], np.arange(start, stop)
            known = {
                name: covariance_nodes.matrices(
                    covariance_nodes.interpolated(at, self._nodes.rows(name, first, last), frames)
                )
                for name in COVARIANCES
            }
        return Confidence(self.times[start:stop], self.names, pairs=self._pairs, **known)


def read_motion_npz(path: str | Path) -> MotionFile:
    """Read a motion; nothing in the file is executed.

    Raises:
        FileFormatError: missing, damaged, of a newer schema, or an array is missing or has a wrong shape.
    """
    with MotionReader(path) as reader:
        return reader.block(0, len(reader))


def _require(rows: NpzBlocks, names: set[str]) -> None:
    """Raise `KeyError` for the first array that is missing."""
    for name in sorted(names):
        if name not in rows:
            raise KeyError(name)


def _names(field: str, value: NDArray[Any]) -> tuple[str, ...]:
    if value.ndim != 1:
        raise ShapeError(f"{field}: expected a list of names, got shape {value.shape}")
    return tuple(map(str, value))
