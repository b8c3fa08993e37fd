"""``motion.h5``: a reconstructed motion with everything needed to use it, arrays of a known schema in HDF5.

Positions and orientations are the forward kinematics of `q` and are computed when read, except in frames
where the motion has others. Arrays, with T frames, J joints and P pairs of segments:

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
covariance_frames       (K,)             frames of the covariances, see `NodeFinder`
position_covariance     (K, J, 6)        these three as in `Confidence`, entries xx, yy, zz, xy, xz, yz
relative_covariance     (K, J, 6)
turn_covariance         (K, P, 6)
======================  ===============  ================================================================

Attributes of the file: schema_version, names (J,), dof_names of q[:, 7:] (q[:, :7] are the root's position and
quaternion x y z w), joint_offsets (J, 3) m, first_frame in the video the recording was cut from, mode of the
reconstruction, skeleton (see `SkeletonModel.named`), mass_kg, sex ('' for unknown), confidence_pairs (P, 2) of names.
Each array has the attributes unit, frame and shape.

Releases before HDF5 wrote ``motion.npz``, with arrays in place of the attributes: the same arrays, or in version 1
`p_world_joint`, `R_world_bone` and whole covariances of every frame. Both are read.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion, SkeletonModel, known_body
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Index, Mask
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, ShapeError, reading
from rtof_kin.core.files.hdf5 import ArrayFile, BlockWriter, Hdf5Writer, multiples, rotation_vectors, short_floats
from rtof_kin.data.confidence import Confidence, valid_covariances
from rtof_kin.data.corrections import Correction
from rtof_kin.data.poses import PoseSequence, Provenance

# Covariances at some frames, the nodes, between which they are interpolated linearly.
#
# A mean of two covariances is one, so every interpolated matrix is valid. The nodes are at most `NODE_SPACING`
# frames apart and so close that the standard deviation per axis is within `NODE_TOLERANCE` of its value in every
# frame; where a matrix begins or ends to be known, both frames are nodes. They depend on the covariances alone,
# not on the blocks that these come in. Of each matrix six entries are kept, those at `ROWS`, `COLUMNS`.

NODE_SPACING: Final = 16  #: [frames] Largest distance of nodes
NODE_TOLERANCE: Final = 0.05  #: Largest relative error of a standard deviation between nodes
ROWS: Final = (0, 1, 2, 0, 0, 1)
COLUMNS: Final = (0, 1, 2, 1, 2, 2)  #: xx, yy, zz, xy, xz, yz
_COVARIANCE_BITS: Final = 8  #: Of the mantissa of an entry: a relative error of 0.2 %
_WIDER: Final = 1 + 2.0**-7
"""Factor of variances with which a matrix that rounding made indefinite becomes definite again."""


class NodeFinder:
    """Chooses nodes of covariances that arrive by blocks."""

    def __init__(self) -> None:
        self._first = 0
        self._rest: Array | None = None

    def add(self, entries: Array) -> tuple[Index, Array]:
        """Return the nodes that are certain by now, and the entries at them. entries: (n, M, 6) of the next frames."""
        known = entries if self._rest is None else np.concatenate([self._rest, entries])
        whole = (len(known) - 1) // NODE_SPACING * NODE_SPACING
        found = nodes_of(known[: whole + 1])[:-1]  # the last one begins the rest
        self._rest, first = known[whole:].copy(), self._first
        self._first += whole
        return first + found, known[found]

    def end(self) -> tuple[Index, Array]:
        """Return the remaining nodes; the last frame is one."""
        if self._rest is None:
            raise InvalidInputError("covariances: none were given")
        found = nodes_of(self._rest)
        return self._first + found, self._rest[found]


def nodes_of(entries: Array) -> Index:
    """Return the frames (K,) of the nodes, of which the first and the last frame are two. entries: (T, M, 6)."""
    frames = np.arange(len(entries))
    found = np.union1d(frames[::NODE_SPACING], frames[-1:])
    variance: Array = np.maximum(entries[..., :3].sum(axis=-1, keepdims=True), 0.0)
    while len(frames):
        exact, near = np.sqrt(variance[frames]), np.sqrt(interpolated(found, variance[found], frames))
        off = ~((np.abs(near - exact) <= NODE_TOLERANCE * exact) | (np.isnan(near) & np.isnan(exact)))
        between = np.searchsorted(found, frames, side="right") - 1
        wrong = np.unique(between[off.any(axis=(1, 2))])
        frames = frames[np.isin(between, wrong)]
        found = np.union1d(found, (found[wrong] + found[wrong + 1]) // 2)
    return found


def interpolated(found: Index, entries: NDArray[np.floating[Any]], frames: Index) -> Array:
    """Return entries (n, M, k) in `frames` (n,), from the first to the last node; `found` (K,): the nodes' frames."""
    before = np.searchsorted(found, frames, side="right") - 1
    after = np.minimum(before + 1, len(found) - 1)
    share = (frames - found[before]) / np.maximum(found[after] - found[before], 1)
    out: Array = np.array(entries[before], dtype=float)
    inside = share > 0
    weight = share[inside, None, None]
    out[inside] = (1 - weight) * out[inside] + weight * entries[after[inside]]
    return out


def packed(entries: Array) -> NDArray[np.float32]:
    """Return entries with 8 bits of mantissa, of matrices that are still valid. entries: (K, M, 6)."""
    rounded = short_floats(entries, _COVARIANCE_BITS)
    wrong: Mask = ~valid_covariances(matrices(rounded))
    wider = entries[wrong]
    wider[:, :3] *= _WIDER
    rounded[wrong] = short_floats(wider, _COVARIANCE_BITS)
    return rounded


def matrices(entries: Array | NDArray[np.float32]) -> Array:
    """Return matrices (..., 3, 3), read-only. entries: (..., 6)."""
    out = np.empty((*entries.shape[:-1], 3, 3))
    out[..., ROWS, COLUMNS] = out[..., COLUMNS, ROWS] = entries
    out.setflags(write=False)
    return out


MOTION: Final = "motion.h5"
EARLIER: Final = "motion.npz"  #: File of versions before HDF5
SCHEMA_VERSION: Final = 2
_OF_RUN: Final = "motion"  #: Folder of the motion in the output of `run`
MASKS: Final = ("valid", "provenance", "orientation_observed", "direction_observed")
"""Fields of `PoseSequence` in the file."""
STORED: Final = ("p_world_joint", "rotvec_world_bone")
_WHOLE: Final = ("p_world_joint", "R_world_bone")  #: Poses in a file of version 1
COVARIANCES: Final = ("position_covariance", "relative_covariance", "turn_covariance")
_COVARIANCE: Final = "one row for each of covariance_frames; xx, yy, zz, xy, xz, yz"
ABOUT: Final = {
    "times": {"unit": "s", "shape": "(T,) frames"},
    "q": {"unit": "m, 1, rad", "frame": "world", "shape": "(T, nq): root x y z, quaternion x y z w, dof_names"},
    "valid": {"unit": "1", "shape": "(T, J)"},
    "provenance": {"unit": "1", "shape": f"(T, J): {', '.join(f'{p.value} {p.name.lower()}' for p in Provenance)}"},
    "orientation_observed": {"unit": "1", "shape": "(T, J)"},
    "direction_observed": {"unit": "1", "shape": "(T, J)"},
    "poses_stored": {"unit": "1", "shape": "(T,): whether the poses of a frame are not those of q"},
    "p_world_joint": {"unit": "m", "frame": "world", "shape": "(T, J, 3)"},
    "rotvec_world_bone": {"unit": "rad", "frame": "segment to world", "shape": "(T, J, 3)"},
    "covariance_frames": {"unit": "1", "shape": "(K,) frames, linear in between"},
    "position_covariance": {"unit": "m^2", "frame": "world", "shape": f"(K, J, 6): {_COVARIANCE}"},
    "relative_covariance": {
        "unit": "m^2",
        "frame": "world, relative to the root",
        "shape": f"(K, J, 6): {_COVARIANCE}",
    },
    "turn_covariance": {"unit": "rad^2", "frame": "of confidence_pairs", "shape": f"(K, P, 6): {_COVARIANCE}"},
}
"""Attributes of the arrays."""
_Q_BITS: Final = 24  #: [bits] after the point: errors of up to 0.03 um and 2e-6 deg
_SAME: Final = 1e-5
"""Largest difference of positions, m, and entries of rotations that are the forward kinematics of q."""


def motion_path(path: str | Path) -> Path:
    """Return the motion's file in the output folder of `reconstruct` or `run`, or the file itself; `FileFormatError`
    for a folder without a motion.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    for folder in (path, path / _OF_RUN):
        if (found := file_in(folder)) is not None:
            return found
    raise FileFormatError(path / MOTION, "no such file; name the output folder of reconstruct or run")


def file_in(folder: Path) -> Path | None:
    """Return the motion's file in a folder itself; None without one."""
    return next((folder / name for name in (MOTION, EARLIER) if (folder / name).is_file()), None)


def motion_folder(path: str | Path) -> Path:
    """Return the folder of the motion's file; `FileFormatError` where there is no such folder or file, or no motion in
    it.
    """
    found = motion_path(path)
    if not found.is_file():
        raise FileFormatError(found, "there is no such file; name the output folder of reconstruct or run")
    if found.suffix not in (".h5", ".npz"):
        raise FileFormatError(found, "is no motion; name the output folder of reconstruct or run")
    return found.parent


class MotionReader(MotionSource, AbstractContextManager["MotionReader"]):
    """A motion in a file, however long it is, of which any frames are read; a context that closes the file.

    Attributes:
        path: the file. mode: of the reconstruction: 'lift', 'sf2', 'rto', 'rtof', 'imu', or '' where unknown.
        first_frame: number of the first frame in the video the recording was cut from. The others as in
            `MotionSource`.
    """

    def __init__(self, path: str | Path):
        """Read the header and the times. `FileFormatError`: missing, damaged, of a newer schema, or not a motion."""
        self.path = motion_path(path)
        with ExitStack() as failed:
            self._file = failed.enter_context(ArrayFile(self.path))
            with (
                reading(self.path, "{}", RtofError, ValueError, TypeError),
                reading(self.path, "the array {} is missing; reconstruct again", KeyError),
            ):
                skeleton = self._read_header()
                times = checked_times("motion times", self._file.whole("times"))
                self._check_arrays(len(times))
            failed.pop_all()
        super().__init__(skeleton, times, corrections=self._corrections)

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def __reduce__(self) -> tuple[type[Self], tuple[Path]]:
        """Another process opens the file itself."""
        return type(self), (self.path,)

    def _header(self, name: str) -> NDArray[Any]:
        """Return an attribute, which an .npz file has as an array."""
        attributes = self._file.attributes
        return attributes[name] if name in attributes else self._file.whole(name)

    def _read_header(self) -> SkeletonModel:
        self._version = int(self._header("schema_version"))
        if self._version > SCHEMA_VERSION:
            raise FileFormatError(
                self.path, f"schema version {self._version} is newer than {SCHEMA_VERSION}; update rtof_kin"
            )
        attributes = self._file.attributes
        names = _names("names", self._header("names"))
        dof_names = _names("dof_names", self._header("dof_names"))
        offsets = readonly("joint_offsets", self._header("joint_offsets"), (len(names), 3))
        mass = float(attributes["mass_kg"]) if "mass_kg" in attributes else None
        sex = str(attributes.get("sex", "")) or None
        skeleton = known_body(str(self._header("skeleton")), offsets.tobytes(), mass, sex)
        skeleton.check_joints(names)
        if dof_names != skeleton.dof_names:
            raise ShapeError(f"dof_names: are not those of the skeleton {skeleton.name}")
        self.first_frame, self.mode = int(self._header("first_frame")), str(self._header("mode"))
        pairs = attributes.get("confidence_pairs", np.empty((0, 2), dtype="U1"))
        if pairs.ndim != 2 or pairs.shape[1] != 2:
            raise ShapeError(f"confidence_pairs: expected pairs of names, got shape {pairs.shape}")
        known = json.loads(str(attributes.get("corrections", "[]")))
        self._corrections = tuple(Correction(**one) for one in known)
        self._pairs = tuple((str(parent), str(child)) for parent, child in pairs)
        return skeleton

    def _check_arrays(self, frames: int) -> None:
        """Check that no array is missing and that they are of one length."""
        first, shapes = self._version == 1, self._file.shapes
        needed = {"q", *MASKS} - ({"direction_observed"} if first else set())
        needed |= set(_WHOLE) if first else set()
        needed |= {*STORED, "poses_stored"} if not first and "poses_stored" in shapes else set()
        covariances = set(COVARIANCES) if self._pairs else set()
        for name in sorted(needed | covariances):
            if name not in shapes:
                raise KeyError(name)
        nodes = frames
        self._nodes: Index | None = None
        if covariances and not first:
            found = readonly("covariance_frames", self._file.whole("covariance_frames"), ("K",), np.intp)
            if not len(found) or found[0] != 0 or found[-1] != frames - 1 or np.any(np.diff(found) <= 0):
                raise InvalidInputError(f"covariance_frames: do not increase from 0 to {frames - 1}, the last frame")
            self._nodes, nodes = found, len(found)
        for name, length in (*((n, frames) for n in needed), *((n, nodes) for n in covariances)):
            if shapes[name][0] != length:
                raise ShapeError(f"{name}: arrays of different lengths, {shapes[name][0]} and {length}")

    def _read(self, start: int, stop: int, confidence: bool) -> Motion:
        rows = self._file.rows
        with reading(self.path, f"frames {start} to {stop}: {{}}", RtofError, ValueError, TypeError):
            q = readonly("q", rows("q", start, stop), (stop - start, self.skeleton.nq))
            masks: dict[str, Any] = {name: rows(name, start, stop) for name in MASKS if name in self._file}
            p, R = self._poses(q, start, stop)
            poses = PoseSequence(self.times[start:stop], p, R, self.skeleton.names, **masks)
            known = self._confidence(start, stop) if self._pairs and confidence else None
            return Motion(self.skeleton, q, poses, self.skeleton.check(q), known, self.corrections)

    def root(self, start: int, stop: int) -> tuple[Array, NDArray[np.uint8]]:
        """Return positions (n, 3) of the root, m, NaN where missing, and their provenance (n,), fast.
        `FileFormatError`: the file is damaged.
        """
        rows = self._file.rows
        p = np.array(rows("q", start, stop)[:, :3], dtype=float)
        if "p_world_joint" in self._file:
            given = rows("p_world_joint", start, stop)[:, 0].astype(float)
            stored = self._version == 1 or (rows("poses_stored", start, stop) > 0)[:, None]
            p = np.where(stored, given, p)
        provenance = rows("provenance", start, stop)[:, 0]
        return p, np.clip(provenance, 0, max(Provenance)).astype(np.uint8)

    def _poses(self, q: Array, start: int, stop: int) -> tuple[Array, Array]:
        """Return positions (n, J, 3) and orientations (n, J, 3, 3)."""
        rows = self._file.rows
        if self._version == 1:
            return rows("p_world_joint", start, stop), rows("R_world_bone", start, stop)
        p, R = self.skeleton.forward_kinematics(q)
        if "poses_stored" in self._file:
            stored: Mask = readonly("poses_stored", rows("poses_stored", start, stop), (len(q),), np.bool_)
            given, turns = (rows(name, start, stop)[stored].astype(float) for name in STORED)
            p[stored], R[stored] = given, so3.known_exp(turns)
        return p, R

    def _confidence(self, start: int, stop: int) -> Confidence:
        rows, nodes = self._file.rows, self._nodes
        if nodes is None:
            known = {name: rows(name, start, stop).astype(float) for name in COVARIANCES}
        else:
            first = int(np.searchsorted(nodes, start, side="right")) - 1
            last = int(np.searchsorted(nodes, stop - 1)) + 1
            at, frames = nodes[first:last], np.arange(start, stop)
            between = (interpolated(at, rows(name, first, last), frames) for name in COVARIANCES)
            known = dict(zip(COVARIANCES, map(matrices, between), strict=True))
        return Confidence(self.times[start:stop], self.skeleton.names, pairs=self._pairs, **known)


class MotionWriter(BlockWriter):
    """Writes a motion by blocks; the file appears complete at the end of the context, or not at all."""

    def __init__(self, path: str | Path, skeleton: SkeletonModel, *, mode: str = "", first_frame: int = 0) -> None:
        """Write nothing yet. path: the file, which is replaced. first_frame: number of the first frame in the video."""
        self._path, self._skeleton = Path(path), skeleton
        self._header: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "names": np.array(skeleton.names),
            "dof_names": np.array(skeleton.dof_names),
            "joint_offsets": skeleton.joint_offsets,
            "first_frame": first_frame,
            "mode": mode,
            "skeleton": skeleton.name,
            "mass_kg": skeleton.table.mass_kg,
            "sex": skeleton.table.sex or "",
        }
        self._arrays = Hdf5Writer(self._path, ABOUT)
        self._frames, self._last = 0, -np.inf
        self._pairs: tuple[tuple[str, str], ...] | None = None
        self._nodes = NodeFinder()

    def append(self, motion: Motion) -> None:
        """Append the next frames. `InvalidInputError`: another body, earlier times, or a confidence of other pairs.

        Args:
            motion: of the same body, with times after those before, and with or without a confidence as all.
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
        self._header["corrections"] = json.dumps([one.plain() for one in motion.corrections])
        q = multiples(motion.q, _Q_BITS)
        self._arrays.append({"times": poses.times, "q": q} | {name: getattr(poses, name) for name in MASKS})
        p, R = self._skeleton.forward_kinematics(q)
        stored = ~(_same(p, poses.p_world_joint, _SAME) & _same(R, poses.R_world_bone, _SAME))
        if stored.any():
            kept = stored[:, None, None]
            values = (poses.p_world_joint, rotation_vectors(poses.R_world_bone, _Q_BITS))
            short = [np.where(kept, part, np.nan).astype(np.float32) for part in values]
            self._arrays.append({"poses_stored": stored} | dict(zip(STORED, short, strict=True)), self._frames)
        if motion.confidence is not None:
            entries = [getattr(motion.confidence, name)[..., ROWS, COLUMNS] for name in COVARIANCES]
            self._append_nodes(*self._nodes.add(np.concatenate(entries, axis=1)))
        self._frames += len(poses)
        self._last = float(poses.times[-1])

    def _append_nodes(self, frames: Index, entries: Array) -> None:
        J = len(self._skeleton.names)
        parts = np.split(packed(entries), [J, 2 * J], axis=1)
        self._arrays.append({"covariance_frames": frames.astype(np.int64)} | dict(zip(COVARIANCES, parts, strict=True)))

    def _finish(self) -> None:
        """Write what is known at the end."""
        if not self._frames:
            raise InvalidInputError(f"{self._path}: a motion needs at least one frame")
        if "poses_stored" in self._arrays:  # as long as the others
            none = np.empty((0, len(self._skeleton.names), 3), dtype=np.float32)
            self._arrays.append({"poses_stored": np.empty(0, dtype=bool)} | dict.fromkeys(STORED, none), self._frames)
        if self._pairs is not None:
            self._append_nodes(*self._nodes.end())
            self._header["confidence_pairs"] = np.array(self._pairs).reshape(-1, 2)
        self._arrays.describe(**self._header)


def write_motion(path: str | Path, motion: Motion, *, first_frame: int = 0, mode: str = "") -> None:
    """Write a motion over an existing file; `first_frame`: number of the first frame in the video."""
    with MotionWriter(path, motion.skeleton, mode=mode, first_frame=first_frame) as writer:
        writer.append(motion)


def _same(a: Array, b: Array, largest: float) -> Mask:
    """Return a mask (T,) of frames in which all numbers (T, ...) are near, or NaN in both."""
    near = (np.abs(a - b) <= largest) | (np.isnan(a) & np.isnan(b))
    return np.asarray(near.reshape(len(a), -1).all(axis=1))


def _names(field: str, value: NDArray[Any]) -> tuple[str, ...]:
    if value.ndim != 1:
        raise ShapeError(f"{field}: expected a list of names, got shape {value.shape}")
    return tuple(map(str, value))
