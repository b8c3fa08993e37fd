"""Reference of the example: joints triangulated from all cameras, with measures of their accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from multi_view import adjust_cameras, triangulate
from numpy.typing import NDArray
from pose2sim_trial import Trial

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import RtofError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.vision.landmark_regression import LandmarkRegression

Array = NDArray[np.float64]
CUTOFF_HZ = 6.0
"""Cutoff of the low-pass of the triangulated joints, as in Pose2Sim."""
ADJUST_EVERY = 4
"""Interval of the frames used by the bundle adjustment."""
_LIMBS = ("ForeArm", "Hand", "Leg", "Foot")


@dataclass(frozen=True)
class Truth:
    """Triangulated reference."""

    poses: PoseSequence
    """(T, J) joints from the landmark regression of each view, triangulated and smoothed; `valid` where two
    cameras observe them."""
    cameras: tuple[Camera, ...]
    """Cameras of the triangulation."""
    misfit_px: dict[str, tuple[float, float]]
    """By camera: median distance of the detector's points from the triangulation of the *other* cameras,
    before and after the bundle adjustment."""
    moved: dict[str, tuple[float, float]]
    """By camera: change of orientation, degrees, and position, mm."""
    without_one_mm: float
    """Mean change of the joints without one of the cameras."""
    bone_spread_mm: float
    """Mean standard deviation over time of the bone lengths of the limbs."""


def triangulated(trial: Trial, skeleton: SkeletonModel, adjust: bool) -> Truth:
    """Triangulate the joints of a trial from all cameras.

    Args:
        trial: of `read_trial`. skeleton: names the joints.
        adjust: adjust the camera poses first (`multi_view.adjust_cameras`); otherwise use those of the file.

    Raises:
        RtofError: a joint is never observed by two cameras.
    """
    before = [view.camera for view in trial.views]
    uv, weight = (np.stack([getattr(v, field) for v in trial.views]) for field in ("uv_px", "weight"))
    after = before
    if adjust:
        after = adjust_cameras(before, uv[:, ::ADJUST_EVERY], weight[:, ::ADJUST_EVERY])
    joints_uv, joints_weight = _joints(trial, skeleton)
    times = trial.views[0].found.keypoints.times
    p, valid = _smooth(after, joints_uv, joints_weight, times)
    if not valid.any(axis=0).all():
        unseen = skeleton.names[int(np.argmin(valid.any(axis=0)))]
        raise RtofError(f"{trial.name}: two cameras never see the joint {unseen}, so it has no truth")
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    bones = np.linalg.norm(p[:, 1:] - p[:, list(skeleton.parents[1:])], axis=-1)
    limbs = [j for j, name in enumerate(skeleton.names[1:]) if name.endswith(_LIMBS)]
    names = [view.name for view in trial.views]
    both = zip(_misfit_px(before, uv, weight), _misfit_px(after, uv, weight), strict=True)
    change = [_moved(b, a) for b, a in zip(before, after, strict=True)]
    return Truth(
        poses=PoseSequence(times, p, R, skeleton.names, valid=valid),
        cameras=tuple(after),
        misfit_px=dict(zip(names, both, strict=True)),
        moved=dict(zip(names, change, strict=True)),
        without_one_mm=_without_one_mm(after, joints_uv, joints_weight, times, p),
        bone_spread_mm=float(1000 * bones[:, limbs].std(axis=0).mean()),
    )


def measured_bones(truth: Truth, skeleton: SkeletonModel) -> dict[str, float]:
    """Return the median bone lengths of the triangulation, m, by child joint."""
    p, parents = truth.poses.p_world_joint, list(skeleton.parents[1:])
    length = np.median(np.linalg.norm(p[:, 1:] - p[:, parents], axis=-1), axis=0)
    return dict(zip(skeleton.names[1:], length.tolist(), strict=True))


def _joints(trial: Trial, skeleton: SkeletonModel) -> tuple[Array, Array]:
    """Return joints (C, T, J, 2), px, of the landmark regression and their inverse variances (C, T, J)."""
    uv, weight, regression = [], [], LandmarkRegression.default()
    for view in trial.views:
        seen = view.found.recognition
        adapted = regression.apply(seen.layout.name, view.uv_px[:, seen.order], view.weight[:, seen.order])
        at = [adapted.names.index(name) for name in skeleton.names]
        sigma = np.where(adapted.confidence[:, at] > 0, adapted.sigma_px[:, at], np.inf)
        uv.append(adapted.uv_px[:, at])
        weight.append((10.0 / np.maximum(sigma, 1.0)) ** 2)
    return np.stack(uv), np.stack(weight)


def _smooth(cameras: Sequence[Camera], uv: Array, weight: Array, times: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return triangulated positions (T, J, 3), gaps interpolated, and which were observed (T, J)."""
    p, _ = triangulate(cameras, uv, weight)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(p).all(axis=-1))
    for j in np.flatnonzero(seen.any(axis=0)):
        for i in range(3):
            p[:, j, i] = np.interp(times, times[seen[:, j]], p[seen[:, j], j, i])
    rate_hz = float(1 / np.median(np.diff(times)))
    return (signals.low_pass(p, rate_hz, CUTOFF_HZ) if seen.any(axis=0).all() else p), seen


def _misfit_px(cameras: Sequence[Camera], uv: Array, weight: Array) -> list[float]:
    """Return the median distance of each camera's points from the other cameras' triangulation, px."""
    out = []
    for c, camera in enumerate(cameras):
        others = [i for i in range(len(cameras)) if i != c]
        p, _ = triangulate([cameras[i] for i in others], uv[others], weight[others])
        far = np.linalg.norm(camera.project(p) - uv[c], axis=-1)[weight[c] > 0]
        out.append(float(np.nanmedian(far)) if np.isfinite(far).any() else float("nan"))
    return out


def _moved(before: Camera, after: Camera) -> tuple[float, float]:
    turn = so3.angle_between(before.R_camera_world, after.R_camera_world)
    return float(np.degrees(turn)), float(1000 * np.linalg.norm(after.center_world - before.center_world))


def _without_one_mm(cameras: Sequence[Camera], uv: Array, weight: Array, times: Array, p: Array) -> float:
    if len(cameras) < 3:
        return float("nan")
    changes = []
    for c in range(len(cameras)):
        others = [i for i in range(len(cameras)) if i != c]
        without, _ = _smooth([cameras[i] for i in others], uv[others], weight[others], times)
        changes.append(float(np.nanmean(np.linalg.norm(without - p, axis=-1))))
    return 1000 * float(np.mean(changes))
