"""``motion.npz``: a reconstructed motion with everything needed to use it, arrays of a known schema."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.observability import observed_dofs
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import FileFormatError, RtofError, ShapeError
from rtof_kin.core.files.arrays import read_npz_as_saved, write_npz
from rtof_kin.core.files.text import LARGEST_NUMBER, measurable
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence

SCHEMA_VERSION = 1
_LARGEST_BYTES = 8 * 2**30
_COVARIANCES = ("position_covariance", "relative_covariance", "turn_covariance")
"""Fields of `Confidence` that the file has."""


@dataclass(frozen=True)
class MotionFile:
    """What a ``motion.npz`` holds."""

    q: NDArray[np.float64]
    """(T, nq) configurations of the personalised URDF, Pinocchio's order."""
    poses: PoseSequence
    """Joint positions and segment orientations in world, validity and provenance."""
    dof_names: tuple[str, ...]
    """Names of q[:, 7:]; q[:, :7] are the root's position and quaternion x y z w."""
    joint_offsets: NDArray[np.float64]
    """(J, 3) m, of the skeleton."""
    singular: NDArray[np.bool_]
    """(T, J) within 5 degrees of a singular posture of the joint's three angles."""
    first_frame: int
    """Number of the first frame in the video the recording was cut from."""
    mode: str
    """How it was made: 'lift', 'sf2', 'rto' or 'rtof'."""
    skeleton: str
    """Name of the skeleton, see `SkeletonModel.named`."""
    confidence: Confidence | None = None
    """How well the motion is known; None in files that do not say."""

    def motion(self) -> MotionSequence:
        """The motion of the subject's skeleton that the file describes."""
        skeleton = SkeletonModel.named(self.skeleton).with_offsets(self.joint_offsets)
        return MotionSequence(skeleton, self.q, self.poses, skeleton.check(self.q), self.confidence)


def write_motion_npz(
    path: str | Path, motion: MotionSequence, *, first_frame: int = 0, mode: str = ""
) -> None:
    """Write a motion over an earlier one; every array is named after its field in `MotionFile` and
    `PoseSequence`, and ``dof_observed`` (T, D) after `observation.observed_dofs`, which makes it.

    Raises:
        RtofError: it cannot be written.
    """
    poses = motion.poses
    arrays = {
        "schema_version": np.array(SCHEMA_VERSION),
        "times": poses.times,
        "q": motion.q,
        "p_world_joint": poses.p_world_joint,
        "R_world_bone": poses.R_world_bone,
        "valid": poses.valid,
        "provenance": poses.provenance,
        "orientation_observed": poses.orientation_observed,
        "direction_observed": poses.direction_observed,
        "dof_observed": observed_dofs(motion),
        "singular": motion.report.singular,
        "names": np.array(poses.names),
        "dof_names": np.array(motion.skeleton.dof_names),
        "joint_offsets": motion.skeleton.joint_offsets,
        "first_frame": np.array(first_frame),
        "mode": np.array(mode),
        "skeleton": np.array(motion.skeleton.name),
    }
    write_npz(Path(path), arrays | _confidence_arrays(motion.confidence), overwrite=True)


def read_motion_npz(path: str | Path) -> MotionFile:
    """Read a motion; nothing in the file is executed.

    Raises:
        FileFormatError: missing, damaged, of a newer schema, or an array is missing or of wrong shape.
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
        poses = PoseSequence(
            times=data["times"],
            p_world_joint=data["p_world_joint"],
            R_world_bone=data["R_world_bone"],
            names=_names("names", data["names"]),
            provenance=data["provenance"],
            valid=data["valid"],
            orientation_observed=data["orientation_observed"],
            direction_observed=data.get("direction_observed"),  # type: ignore[arg-type]
        )
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


def _confidence_arrays(confidence: Confidence | None) -> dict[str, Any]:
    """What the file holds of a confidence, in single precision; nothing where there is none."""
    if confidence is None:
        return {}
    arrays = {name: getattr(confidence, name).astype(np.float32) for name in _COVARIANCES}
    return {"confidence_pairs": np.array(confidence.pairs)} | arrays


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
