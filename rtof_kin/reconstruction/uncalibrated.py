"""The camera of a recording whose camera is not calibrated: found, and propagated into the covariances."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_estimate import CameraEstimate, Evidence, estimate_camera
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.camera_evidence import Scene, evidence, standing_feet
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.uncertainty import disagreement

_MOST_SECONDS: Final = 40.0
"""[s] of a longer recording that are used: those in which the person comes and goes most."""
_ENOUGH_HZ: Final = 25.0
"""Frames per second that are enough; of faster videos, every second, third ... frame is used."""
_STEP: Final = 5.0
"""[s] between the beginnings of excerpts that are compared."""

Solve = Callable[[Recording], tuple[Prepared, PoseSequence]]
"""Prepare a recording and solve its poses."""


def with_camera(recording: Recording, camera: Camera) -> Recording:
    """Return a recording with another first camera, those of further views carried along."""
    before, views = recording.video.camera, recording.views
    views = tuple(replace(view, camera=view.camera.carried(before, camera)) for view in views)
    return replace(recording, keypoints=replace(recording.video, camera=camera), views=views)


def find_camera(
    recording: Recording,
    skeleton: SkeletonModel,
    solve: Solve,
    lifter: LifterLike | None,
    progress: Callable[[int, int], None] | None = None,
) -> CameraEstimate:
    """Estimate the unknowns of the first camera from its recording, without further views.

    Args:
        skeleton: the subject's. lifter: default: the shipped one. progress: called with (steps done, steps in all).

    Raises:
        Errors of the stages, with the camera as declared.
    """
    assumed = recording.video.camera
    recording = replace(recording, keypoints=excerpt(recording.video), views=(), truth=None)
    prepared, poses = solve(recording)
    clean, imus = prepared.recording, prepared.bone_imus
    contacts = standing_feet(clean.video, poses, skeleton)
    sensed = imus is not None and np.isfinite(imus.R_world_bone).any()
    fresh = assumed.uncertainty is None or not assumed.uncertainty.of_motion
    scene = Scene(skeleton, recording.floor_height, contacts, imus if sensed else None, fresh)

    def seen_by(camera: Camera) -> Evidence:
        own = with_camera(clean, camera)
        prepared, poses = solve(own)
        by_image = prepared.lifted.poses
        if scene.bone_imus is not None:
            by_image = lift(own.video, skeleton, lifter, None, recording.floor_height).poses
        return evidence(scene, own.video, by_image, poses)

    return estimate_camera(assumed, seen_by, progress)


def excerpt(keypoints: KeypointSequence) -> KeypointSequence:
    """Return the part of a long video in which the person's size in the image changes most.

    Args:
        keypoints: evenly spaced; of a fast video, some frames are left out.
    """
    rate_hz = 1 / float(np.median(np.diff(keypoints.times))) if len(keypoints) > 1 else 0.0
    keypoints = keypoints[:: max(1, int(rate_hz / _ENOUGH_HZ))]
    times = keypoints.times
    if times[-1] - times[0] <= _MOST_SECONDS:
        return keypoints
    enough = keypoints.seen.sum(axis=1) > len(keypoints.names) / 2
    v = np.where(enough[:, None], keypoints.uv_px[..., 1], np.nan)
    tall = np.full(len(times), np.nan)
    tall[enough] = np.log(np.nanmax(v[enough], axis=1) - np.nanmin(v[enough], axis=1) + 1.0)
    starts = np.arange(times[0], times[-1] - _MOST_SECONDS + _STEP, _STEP)
    parts = [slice(*np.searchsorted(times, [t, t + _MOST_SECONDS])) for t in starts]
    return keypoints[max(parts, key=lambda part: _spread(tall[part]))]


def _spread(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.subtract(*np.percentile(known, [90, 10]))) if len(known) else -1.0


def with_camera_uncertainty(confidence: Confidence, poses: PoseSequence, others: Iterable[PoseSequence]) -> Confidence:
    """Return covariances with those of a camera's, or the clocks', unknowns added.

    Args:
        others: with cameras (`CameraEstimate.deviations`) or clocks one standard deviation off.
    """
    for other in others:
        apart = disagreement(poses, other, confidence.pairs)
        confidence = replace(
            confidence,
            position_covariance=confidence.position_covariance + apart.position,
            relative_covariance=confidence.relative_covariance + apart.relative,
            turn_covariance=confidence.turn_covariance + apart.turn,
        )
    return confidence
