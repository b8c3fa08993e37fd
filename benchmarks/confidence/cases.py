"""Reconstructions with their truth, errors, and the standard deviations from the Hessian."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from benchmarks import harness
from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angles import all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.uncertainty import CovarianceInflation, ResidualStatistics, disagreement, residual_statistics

EVERY = 4
"""Step between the frames evaluated one by one; neighbours are correlated."""
SENSORS = ("0", "4", "8", "10")
"""Numbers of sensors that the inflation is fitted on, with realistic 2D."""
KINDS = (*(("realistic", count) for count in SENSORS), ("white", "8"), ("perfect", "8"))
"""2D and numbers of sensors that it is looked at with."""


@dataclass(frozen=True)
class Case:
    """One reconstructed recording."""

    name: str
    """Name of the motion, and number of the camera."""
    keypoints: str
    sensors: str
    circumstances: ResidualStatistics
    """Residual statistics of the recording, with the segments of its sensors."""
    motion: Motion
    """Confidence from the Hessian alone."""
    truth: PoseSequence
    """At the motion's times."""
    apart: Confidence
    """The solution from its start."""
    p_camera_joint: Array
    """(T, J, 3) m, joints as seen from the camera, world axes."""
    rig: str

    def stated(self, inflation: CovarianceInflation) -> Confidence:
        """Return the confidence that an inflation makes."""
        assert self.motion.confidence is not None
        return inflation.apply(self.motion.confidence, self.circumstances, self.apart, self.p_camera_joint)

    def __getitem__(self, frames: slice) -> Self:
        own = ("motion", "truth", "p_camera_joint", "apart")
        return replace(self, **{name: getattr(self, name)[frames] for name in own})

    @property
    def motion_name(self) -> str:
        """Without the camera."""
        return self.name.split("/")[0]


@dataclass(frozen=True)
class Errors:
    """Errors of one quantity, and their covariance."""

    error: Array
    """(n, 3) by axis."""
    covariance: Array
    """(n, 3, 3)."""
    apart: Array
    """(n, 3, 3) mean squares of the solution's difference from its start."""
    depth: Array | None = None
    """(n, 3, 3) squares of the vectors from the camera, of positions in world."""


def reconstructed(
    clip: MocapClip, camera: int, keypoints: str, sensors: str, seed: int, calibrate: bool, lifter: str | None = None
) -> Case:
    """One motion seen by one camera."""
    own = harness.SENSOR_SETS.get(sensors, ())
    recording = harness.recorded(clip, camera, keypoints, own, seed)
    result = reconstruct(
        recording, mode="rtof" if own else "rto", lifter=_lifter(lifter), calibrate=calibrate and bool(own)
    )
    return case_of(result, clip, camera, keypoints, sensors)


def case_of(result: Reconstruction, clip: MocapClip, camera: int, keypoints: str, sensors: str) -> Case:
    """A reconstruction of a motion as a case."""
    solution, truth, lifted = result.solution, result.recording.truth, result.stages["lift"]
    assert truth is not None
    assert result.keypoints is not None
    assert solution is not None
    assert solution.confidence is not None
    motion = replace(result.motion, confidence=solution.confidence)
    carriers = () if result.bone_imus is None else result.bone_imus.joints
    stated = residual_statistics(result.keypoints, result.motion, lifted, carriers)
    start = result.stages.get("sf2", lifted)
    apart = disagreement(result.motion.poses, start, solution.confidence)
    p_camera_joint = motion.poses.p_world_joint - result.keypoints.camera.center_world
    true = at_times(truth, motion.times)
    return Case(f"{clip.name}/{camera}", keypoints, sensors, stated, motion, true, apart, p_camera_joint, clip.rig)


@cache
def _lifter(path: str | None) -> Any:
    from lifting.predict import Lifter

    return Lifter.load(Path(path) if path else None)


def errors(case: Case, confidence: Confidence | None = None) -> Iterator[tuple[str, str, Errors]]:
    """(kind, name, errors) of every entry of a confidence, where both are known.

    Args:
        confidence: in place of the motion's own.
    """
    stated = confidence or case.motion.confidence
    assert stated is not None
    p, p_true = case.motion.poses.p_world_joint, case.truth.p_world_joint
    seen = [p - p_true, (p - p[:, :1]) - (p_true - p_true[:, :1])]
    for kind, error in zip(("position", "relative"), seen, strict=True):
        covariance, off = (getattr(of, f"{kind}_covariance") for of in (stated, case.apart))
        for j, name in enumerate(stated.names):
            if kind == "position":
                away = case.p_camera_joint[:, j]
                depth = away[:, :, None] * away[:, None, :]
                yield kind, name, _known(error[:, j], covariance[:, j], off[:, j], depth)
            elif j > 0:
                yield kind, name, _known(error[:, j], covariance[:, j], off[:, j])
    R, R_true = case.motion.poses.R_world_bone, case.truth.R_world_bone
    for k, (parent, child) in enumerate(stated.pairs):
        error = turn_error(R, R_true, stated.names, parent, child)
        yield "turn", f"{parent} {child}", _known(error, stated.turn_covariance[:, k], case.apart.turn_covariance[:, k])


def angle_errors(case: Case, confidence: Confidence, regular: bool = False) -> Iterator[tuple[str, Array, Array]]:
    """Name, errors (n,) and standard deviations (n,) of every clinical angle, rad, where known.

    Args:
        regular: leave out frames near a singular posture.
    """
    found = clinical_angles(replace(case.motion, confidence=confidence))
    true = clinical_angles(all_observed(case.truth), case.motion.skeleton)
    assert found.sigma is not None
    off = (found.values - true.values + np.pi) % (2 * np.pi) - np.pi
    for a, name in enumerate(found.names):
        known = np.isfinite(off[:, a] + found.sigma[:, a]) & ~(regular & found.singular[:, a])
        if known.any():
            yield name, off[known, a], found.sigma[known, a]


def turn_error(R: Array, R_true: Array, names: Sequence[str], parent: str, child: str) -> Array:
    """Errors (T, 3), rad, of a segment's orientation in its parent, child axes; NaN where one is unknown."""
    turned = [_seen_from(r, names, parent, child) for r in (R, R_true)]
    return so3.known_log(np.swapaxes(turned[1], -1, -2) @ turned[0])


def _seen_from(R: Array, names: Sequence[str], parent: str, child: str) -> Array:
    own = R[:, names.index(child)]
    return own if parent == WORLD else np.swapaxes(R[:, names.index(parent)], -1, -2) @ own


def _known(error: Array, covariance: Array, apart: Array, depth: Array | None = None) -> Errors:
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    return Errors(error[known], covariance[known], apart[known], None if depth is None else depth[known])
