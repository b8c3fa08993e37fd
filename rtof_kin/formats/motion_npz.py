"""``motion.npz``: a reconstructed motion with everything needed to use it, arrays of a known schema."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import observed_dofs
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, RtofError, ShapeError
from rtof_kin.core.files.arrays import read_npz_as_saved, write_npz
from rtof_kin.core.files.text import LARGEST_NUMBER, measurable
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence

MOTION: Final = "motion.npz"
SCHEMA_VERSION: Final = 1
_OF_RUN: Final = "motion"
"""Folder of the motion in the output of `run`."""
_LARGEST_BYTES: Final = 8 * 2**30
_POSES: Final = ("times", "p_world_joint", "R_world_bone", "valid", "provenance", "orientation_observed")
"""Required fields of `PoseSequence` in the file."""
_COVARIANCES: Final = ("position_covariance", "relative_covariance", "turn_covariance")
"""Fields of `Confidence` in the file."""


@dataclass(frozen=True)
class MotionFile:
    """Content of a ``motion.npz``."""

    q: Array
    """(T, nq) configurations of the personalised URDF, Pinocchio's order."""
    poses: PoseSequence
    """Joint positions and segment orientations in world, validity and provenance."""
    dof_names: tuple[str, ...]
    """Names of q[:, 7:]; q[:, :7] are the root's position and quaternion x y z w."""
    joint_offsets: Array
    """(J, 3) m, of the skeleton."""
    singular: Mask
    """(T, J) within 5 degrees of a singular posture of the joint's three angles."""
    first_frame: int
    """Number of the first frame in the video the recording was cut from."""
    mode: str
    """Mode of the reconstruction: 'lift', 'sf2', 'rto' or 'rtof'."""
    skeleton: str
    """Name of the skeleton, see `SkeletonModel.named`."""
    confidence: Confidence | None = None
    """Covariances of the poses; None where absent."""

    def motion(self) -> MotionSequence:
        """Return the motion on the subject's skeleton."""
        skeleton = SkeletonModel.named(self.skeleton).with_offsets(self.joint_offsets)
        return MotionSequence(skeleton, self.q, self.poses, skeleton.check(self.q), self.confidence)


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


def write_motion_npz(
    path: str | Path, motion: MotionSequence, *, first_frame: int = 0, mode: str = ""
) -> None:
    """Write a motion over an existing file. Arrays have the names of their fields in `MotionFile` and
    `PoseSequence`; ``dof_observed`` (T, D) is that of `observability.observed_dofs`.

    Args:
        path: the file. motion: what is written. first_frame: number of the first frame in the video.
        mode: mode of the reconstruction.

    Raises:
        RtofError: it cannot be written.
    """
    poses, confidence = motion.poses, motion.confidence
    arrays = {name: getattr(poses, name) for name in (*_POSES, "direction_observed")} | {
        "schema_version": np.array(SCHEMA_VERSION),
        "q": motion.q,
        "dof_observed": observed_dofs(motion),
        "singular": motion.report.singular,
        "names": np.array(poses.names),
        "dof_names": np.array(motion.skeleton.dof_names),
        "joint_offsets": motion.skeleton.joint_offsets,
        "first_frame": np.array(first_frame),
        "mode": np.array(mode),
        "skeleton": np.array(motion.skeleton.name),
    }
    if confidence is not None:
        arrays["confidence_pairs"] = np.array(confidence.pairs)
        arrays |= {name: getattr(confidence, name).astype(np.float32) for name in _COVARIANCES}
    write_npz(Path(path), arrays, overwrite=True)


def read_motion_npz(path: str | Path) -> MotionFile:
    """Read a motion; nothing in the file is executed.

    Args:
        path: the file.

    Raises:
        FileFormatError: missing, damaged, of a newer schema, or an array is missing or has a wrong shape.
    """
    data = read_npz_as_saved(Path(path), _LARGEST_BYTES, kinds="fiubU")
    for name, array in data.items():
        if array.dtype.kind == "f" and not measurable(array):
            raise FileFormatError(path, f"{name}: holds a number beyond {LARGEST_NUMBER:g}")
    try:
        version = int(data["schema_version"])
        if version > SCHEMA_VERSION:
            raise FileFormatError(
                path, f"schema version {version} is newer than {SCHEMA_VERSION}; update rtof_kin"
            )
        fields: dict[str, Any] = {name: data[name] for name in _POSES}
        if "direction_observed" in data:
            fields["direction_observed"] = data["direction_observed"]
        poses = PoseSequence(names=_names("names", data["names"]), **fields)
        dof_names = _names("dof_names", data["dof_names"])
        T, J = len(poses), len(poses.names)
        return MotionFile(
            q=readonly("q", data["q"], (T, 7 + len(dof_names))),
            poses=poses,
            dof_names=dof_names,
            joint_offsets=readonly("joint_offsets", data["joint_offsets"], (J, 3)),
            singular=readonly("singular", data["singular"], (T, J), np.bool_),
            first_frame=int(data["first_frame"]),
            mode=str(data["mode"]),
            skeleton=str(data["skeleton"]),
            confidence=_confidence(data, poses),
        )
    except KeyError as error:
        raise FileFormatError(path, f"the array {error} is missing") from error
    except (RtofError, ValueError, TypeError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(path, str(error)) from error


def _confidence(data: dict[str, NDArray[Any]], poses: PoseSequence) -> Confidence | None:
    if "confidence_pairs" not in data:
        return None
    pairs = data["confidence_pairs"]
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ShapeError(f"confidence_pairs: expected pairs of names, got shape {pairs.shape}")
    covariances = {name: data[name] for name in _COVARIANCES}
    return Confidence(times=poses.times, names=poses.names, pairs=tuple(map(tuple, pairs)), **covariances)


def _names(field: str, value: NDArray[Any]) -> tuple[str, ...]:
    if value.ndim != 1:
        raise ShapeError(f"{field}: expected a list of names, got shape {value.shape}")
    return tuple(map(str, value))


def motion_source(path: str | Path) -> MotionSource:
    """Return a motion that is read in blocks.

    Args:
        path: the file.
    """
    return MotionSource.of(read_motion_npz(path).motion())
