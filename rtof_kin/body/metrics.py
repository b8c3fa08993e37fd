"""Error metrics of an estimated motion: position, acceleration, jerk, joint angles.

==================  =======================================================================  =========
mpjpe_mm            mean per joint position error, absolute                                  mm
mpjpe_rr_mm         the same relative to the root (which counts as 0)                        mm
mpjpe_pa_mm         the same after the best similarity transform of every frame (Procrustes) mm
mpjae               mean norm of the difference of second derivatives, per second            m/s^2
mpjje               the same of third derivatives                                            m/s^3
mpjae_frame_mm      the same differences per frame instead of per second                     mm/frame^2
mpjje_frame_mm                                                                               mm/frame^3
angle_deg           mean angle between estimated and true joint rotation (parent to child)   degrees
flexion_deg         mean error of the knees' and elbows' flexion, from the bones             degrees
coverage            fraction of joints and frames in which the estimate is valid             1
==================  =======================================================================  =========
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence

BEGUN_TOGETHER = "mode imu has no global position: the estimate is shifted to start at the truth"
"""Remark on metrics and figures of mode imu, see `comparable`."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Metrics(Mapping[str, float]):
    """Pooled metrics by name as a mapping, and metrics per joint and over time."""

    pooled: dict[str, float]  #: Mean over frames and joints by metric; NaN without data
    per_joint: dict[str, dict[str, float]] = field(repr=False)  #: Mean over frames by joint and metric
    over_time: dict[str, Array] = field(repr=False)
    """'mpjpe_mm', 'mpjpe_rr_mm': (T,) mean over joints; 'joint_mm' (absolute), 'joint_flexion_deg' (knees and
    elbows): (T, J). NaN in frames that are not scored."""

    def __getitem__(self, name: str) -> float:
        return self.pooled[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.pooled)

    def __len__(self) -> int:
        return len(self.pooled)


def evaluate(estimate: PoseSequence, truth: PoseSequence, skeleton: SkeletonModel) -> Metrics:
    """Compute all metrics over the frames in which estimate and truth have all joints and the truth is valid.

    >>> from rtof_kin import Recording, evaluate, reconstruct
    >>> recording = Recording.load("recording")  # of a simulation: its truth is known
    >>> result = reconstruct(recording, mode="sf2")
    >>> errors = evaluate(result.motion.poses, recording.truth, recording.skeleton)
    >>> errors["mpjpe_rr_mm"] < 90
    True

    Args:
        truth: poses of the same joints, interpolated at the times of the estimate.

    Raises:
        UnknownNameError, InvalidInputError: joints differ from the skeleton's; fewer than four common frames.
    """
    skeleton.check_joints(estimate.names, "estimate")
    skeleton.check_joints(truth.names, "truth")
    truth = at_times(truth, estimate.times)
    both = np.asarray(np.isfinite(truth.p_world_joint).all(axis=(1, 2)))
    both &= truth.valid.all(axis=1)
    both &= np.isfinite(estimate.p_world_joint).all(axis=(1, 2))
    if both.sum() < 4:
        raise InvalidInputError("metrics: estimate and truth have fewer than four frames in common")
    p = np.where(both[:, None, None], estimate.p_world_joint, np.nan)
    p_true = np.where(both[:, None, None], truth.p_world_joint, np.nan)
    error = np.linalg.norm(p - p_true, axis=-1) * 1000
    relative = np.linalg.norm((p - p[:, :1]) - (p_true - p_true[:, :1]), axis=-1) * 1000
    aligned = np.full_like(error, np.nan)
    aligned[both] = np.linalg.norm(procrustes(p[both], p_true[both]) - p_true[both], axis=-1) * 1000
    local = (kinematics.local_rotations(skeleton.parents, poses.R_world_bone) for poses in (estimate, truth))
    angle = np.where(both[:, None], so3.angle_between(*local), np.nan)  # of the root in world
    rate = estimate.rate_hz
    acceleration = np.linalg.norm(signals.derivative(p - p_true, rate, 2), axis=-1)
    jerk = np.linalg.norm(signals.derivative(p - p_true, rate, 3), axis=-1)
    figures = {
        "mpjpe_mm": error,
        "mpjpe_rr_mm": relative,
        "mpjpe_pa_mm": aligned,
        "mpjae": acceleration,
        "mpjje": jerk,
        "mpjae_frame_mm": acceleration / rate**2 * 1000,
        "mpjje_frame_mm": jerk / rate**3 * 1000,
        "angle_deg": np.degrees(angle),
        "flexion_deg": np.degrees(np.abs(flexion(p, skeleton) - flexion(p_true, skeleton))),
    }
    names = estimate.names
    return Metrics(
        pooled={n: _mean(v) for n, v in figures.items()} | {"coverage": float(estimate.valid[both].mean())},
        per_joint={
            joint: {n: _mean(v[:, j]) for n, v in figures.items() if np.isfinite(v[:, j]).any()}
            for j, joint in enumerate(names)
        },
        over_time={
            "mpjpe_mm": error.mean(axis=1),
            "mpjpe_rr_mm": relative.mean(axis=1),
            "joint_mm": error,
            "joint_flexion_deg": figures["flexion_deg"],
        },
    )


def stage_metrics(
    stages: Mapping[str, PoseSequence], truth: PoseSequence | None, skeleton: SkeletonModel, mode: str
) -> dict[str, Metrics]:
    """Return all metrics of every stage of a mode; empty without truth or with fewer than four frames of it."""
    if truth is None:
        return {}
    first, last = truth.times[[0, -1]]
    poses = next(iter(stages.values()))
    known = np.isfinite(poses.p_world_joint).all(axis=(1, 2))
    if np.count_nonzero(known & (poses.times >= first) & (poses.times <= last)) < 4:
        _log.warning("the truth covers fewer than four frames with a pose: nothing is scored")
        return {}
    truth = at_times(truth, poses.times)  # once; those of all stages
    return {name: evaluate(comparable(poses, truth, mode), truth, skeleton) for name, poses in stages.items()}


def comparable(estimate: PoseSequence, truth: PoseSequence, mode: str) -> PoseSequence:
    """Return an estimate to be compared with a truth: in mode imu shifted to it, else unchanged.

    The shift is constant; the roots coincide in the first frame with both, see `BEGUN_TOGETHER`.

    Args:
        mode: see `core.choices`.
    """
    if mode != "imu":
        return estimate
    true = at_times(truth, estimate.times)
    shift = true.p_world_joint[:, 0] - estimate.p_world_joint[:, 0]
    known = np.flatnonzero(np.isfinite(shift).all(axis=1) & true.valid[:, 0])
    if len(known) == 0:
        return estimate
    return estimate.with_poses(slice(None), estimate.p_world_joint + shift[known[0]])


def aligned_worlds(estimate: PoseSequence, truth: PoseSequence) -> tuple[PoseSequence, float, Array]:
    """Return an estimate in the world of the truth, the angle (rad) and the shift (3,) m that bring it there.

    One rotation about the vertical and one translation for all frames, by least squares over all joints
    (Umeyama 1991, in the horizontal plane): two systems share the vertical, not where they count from.
    """
    true = at_times(truth, estimate.times).p_world_joint
    known = np.isfinite(estimate.p_world_joint + true).all(axis=2)
    p, q = estimate.p_world_joint[known], true[known]
    if not len(p):
        return estimate, 0.0, np.zeros(3)
    a, b = (points[:, :2] - points[:, :2].mean(axis=0) for points in (p, q))
    angle = float(np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)))
    R = so3.about_axis("z", angle)
    shift = q.mean(axis=0) - R @ p.mean(axis=0)
    moved = estimate.p_world_joint @ R.T + shift
    return replace(estimate, p_world_joint=moved, R_world_bone=R @ estimate.R_world_bone), angle, shift


def motionless(truth: PoseSequence) -> PoseSequence:
    """Return the mean position and orientation of the truth in every frame (zero-motion baseline)."""
    p = np.where(truth.valid[..., None], truth.p_world_joint, np.nan)
    mean = [[_mean(p[:, j, i]) for i in range(3)] for j in range(p.shape[1])]
    R = truth.R_world_bone
    known = truth.valid & np.isfinite(R).all(axis=(2, 3))
    still = so3.nearest_rotation(np.sum(R, axis=0, where=known[..., None, None]))
    still[~known.any(axis=0)] = np.nan
    return PoseSequence(truth.times, np.broadcast_to(mean, p.shape), np.broadcast_to(still, R.shape), truth.names)


def procrustes(p: Array, p_true: Array) -> Array:
    """Return p after the best similarity transform of each frame onto p_true (Umeyama 1991). p, p_true: (T, J, 3) m."""
    mean, mean_true = p.mean(axis=1, keepdims=True), p_true.mean(axis=1, keepdims=True)
    a, b = p - mean, p_true - mean_true
    R = so3.nearest_rotation(np.einsum("tji,tjk->tik", b, a))
    turned = np.einsum("tik,tjk->tji", R, a)
    scale = np.sum(turned * b, axis=(1, 2)) / np.sum(a * a, axis=(1, 2))
    return np.asarray(scale[:, None, None] * turned + mean_true)


def flexion(p: Array, skeleton: SkeletonModel) -> Array:
    """Return the angle (T, J), rad, between the bones at knees and elbows; NaN elsewhere. p: (T, J, 3) m."""
    out = np.full(p.shape[:2], np.nan)
    for j in hinges(skeleton):
        (child,) = kinematics.children_of(skeleton.parents, j)
        out[:, j] = so3.angle_of(p[:, j] - p[:, skeleton.parents[j]], p[:, child] - p[:, j])
    return out


def hinges(skeleton: SkeletonModel) -> list[int]:
    """Return the indices of knees and elbows."""
    wanted, joints = ("knee flexion", "elbow flexion"), skeleton.table.joints
    return [i for i, j in enumerate(joints) if any(dof.clinical.endswith(wanted) for dof in j.dofs)]


def at_times(truth: PoseSequence, times: Array) -> PoseSequence:
    """Interpolate a truth at other times; NaN where it is invalid or missing. times: (T,) s."""
    if np.array_equal(truth.times, times):
        return truth
    p = np.where(truth.valid[..., None], truth.p_world_joint, np.nan)
    return PoseSequence(
        times,
        signals.interpolate(truth.times, p, times, max_gap=1.5 / truth.rate_hz),
        signals.interpolate_rotations(truth.times, truth.R_world_bone, times),
        truth.names,
    )


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")
