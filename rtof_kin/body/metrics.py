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
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.over_time import ALL, BLOCK, Stream
from rtof_kin.data.poses import PoseSequence

BEGUN_TOGETHER = "mode imu has no global position: the estimate is shifted to start at the truth"
"""Remark on metrics and figures of mode imu, see `comparable`."""
Poses = PoseSequence | Stream[PoseSequence]
_AFTER: Final = 3  #: Frames after a block that its differences need
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


def evaluate(estimate: Poses, truth: Poses, skeleton: SkeletonModel) -> Metrics:
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
    estimate, over_time = Stream.of(estimate), dict[str, list[Array]]()
    sums, frames, valid = dict[str, Array](), 0, 0  # by metric: sums and numbers of values (2, J)
    truth = resampled(truth, estimate.times)
    for pair in zip(estimate.blocks(_AFTER), truth.blocks(_AFTER), strict=True):
        figures, both = _figures(*pair, skeleton, estimate.rate_hz)
        for name, values in figures.items():
            known = np.isfinite(own := values[:BLOCK])
            sums[name] = sums.get(name, 0.0) + np.stack([np.sum(own, axis=0, where=known), known.sum(axis=0)])
        error, relative, bent = (figures[name][:BLOCK] for name in ("mpjpe_mm", "mpjpe_rr_mm", "flexion_deg"))
        of_block = {"mpjpe_mm": error.mean(axis=1), "mpjpe_rr_mm": relative.mean(axis=1)}
        for name, own in (of_block | {"joint_mm": error, "joint_flexion_deg": bent}).items():
            over_time.setdefault(name, []).append(own)
        frames += int(np.count_nonzero(both[:BLOCK]))
        valid += int(np.count_nonzero(pair[0].valid[:BLOCK][both[:BLOCK]]))
    if frames < 4:
        raise InvalidInputError("metrics: estimate and truth have fewer than four frames in common")
    return Metrics(
        pooled={name: _ratio(*own.sum(axis=1)) for name, own in sums.items()}
        | {"coverage": valid / (frames * len(skeleton.names))},
        per_joint={
            joint: {name: _ratio(*own[:, j]) for name, own in sums.items() if own[1, j]}
            for j, joint in enumerate(skeleton.names)
        },
        over_time={name: np.concatenate(parts) for name, parts in over_time.items()},
    )


def _figures(
    estimate: PoseSequence, truth: PoseSequence, skeleton: SkeletonModel, rate_hz: float
) -> tuple[dict[str, Array], Mask]:
    """Return the figures (T, J) of consecutive frames by metric, those of differences shorter; and a mask (T,) of the
    frames that are scored.
    """
    skeleton.check_joints(estimate.names, "estimate")
    skeleton.check_joints(truth.names, "truth")
    both: Mask = np.asarray(np.isfinite(truth.p_world_joint).all(axis=(1, 2)))
    both &= truth.valid.all(axis=1)
    both &= np.isfinite(estimate.p_world_joint).all(axis=(1, 2))
    p = np.where(both[:, None, None], estimate.p_world_joint, np.nan)
    p_true = np.where(both[:, None, None], truth.p_world_joint, np.nan)
    aligned = np.full(p.shape[:2], np.nan)
    aligned[both] = np.linalg.norm(procrustes(p[both], p_true[both]) - p_true[both], axis=-1) * 1000
    local = (kinematics.local_rotations(skeleton.parents, poses.R_world_bone) for poses in (estimate, truth))
    angle = np.where(both[:, None], so3.angle_between(*local), np.nan)  # of the root in world
    acceleration = np.linalg.norm(signals.derivative(p - p_true, rate_hz, 2), axis=-1)
    jerk = np.linalg.norm(signals.derivative(p - p_true, rate_hz, 3), axis=-1)
    return {
        "mpjpe_mm": np.linalg.norm(p - p_true, axis=-1) * 1000,
        "mpjpe_rr_mm": np.linalg.norm((p - p[:, :1]) - (p_true - p_true[:, :1]), axis=-1) * 1000,
        "mpjpe_pa_mm": aligned,
        "mpjae": acceleration,
        "mpjje": jerk,
        "mpjae_frame_mm": acceleration / rate_hz**2 * 1000,
        "mpjje_frame_mm": jerk / rate_hz**3 * 1000,
        "angle_deg": np.degrees(angle),
        "flexion_deg": np.degrees(np.abs(flexion(p, skeleton) - flexion(p_true, skeleton))),
    }, both


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


def comparable(estimate: Poses, truth: Poses, mode: str) -> Poses:
    """Return an estimate to be compared with a truth: in mode imu shifted to it, else unchanged.

    The shift is constant; the roots coincide in the first frame with both, see `BEGUN_TOGETHER`.

    Args:
        mode: see `core.choices`.
    """
    if mode != "imu":
        return estimate
    whole = Stream.of(estimate)
    for poses, true in zip(whole.blocks(), resampled(truth, whole.times).blocks(), strict=True):
        shift = true.p_world_joint[:, 0] - poses.p_world_joint[:, 0]
        known = np.flatnonzero(np.isfinite(shift).all(axis=1) & true.valid[:, 0])
        if len(known):
            return _moved(whole, 0.0, shift[known[0]])
    return estimate


def _moved(estimate: Stream[PoseSequence], angle: float, shift: Array) -> Stream[PoseSequence]:
    """Return poses that are turned about the vertical by an angle, rad, and then shifted, (3,) m."""
    R = so3.about_axis("z", angle)

    def part(rows: slice) -> PoseSequence:
        poses = estimate.part(rows)
        return replace(poses, p_world_joint=poses.p_world_joint @ R.T + shift, R_world_bone=R @ poses.R_world_bone)

    return Stream(estimate.times, part)


def aligned_worlds(estimate: Poses, truth: Poses) -> tuple[Stream[PoseSequence], float, Array]:
    """Return an estimate in the world of the truth, the angle (rad) and the shift (3,) m that bring it there.

    One rotation about the vertical and one translation for all frames, by least squares over all joints
    (Umeyama 1991, in the horizontal plane): two systems share the vertical, not where they count from.
    """
    estimate, centre = Stream.of(estimate), np.empty((0, 2, 3))
    count, sums, products = 0, np.zeros((2, 3)), np.zeros((2, 2))
    for pair in zip(estimate.blocks(), resampled(truth, estimate.times).blocks(), strict=True):
        both = np.stack([poses.p_world_joint.reshape(-1, 3) for poses in pair], axis=1)
        both = both[np.isfinite(both).all(axis=(1, 2))]
        centre = both[:1] if not len(centre) else centre  # near the means: products keep their digits
        both = both - centre
        count, sums, products = count + len(both), sums + both.sum(axis=0), products + both[:, 0, :2].T @ both[:, 1, :2]
    if not count:
        return estimate, 0.0, np.zeros(3)
    products -= np.outer(sums[0, :2], sums[1, :2]) / count
    angle = float(np.arctan2(products[0, 1] - products[1, 0], np.trace(products)))
    p, p_true = centre[0] + sums / count
    shift = p_true - so3.about_axis("z", angle) @ p
    return _moved(estimate, angle, shift), angle, shift


def motionless(truth: PoseSequence) -> PoseSequence:
    """Return the mean position and orientation of the truth in every frame (zero-motion baseline)."""
    return zero_motion(Stream.of(truth)).part(ALL)


def zero_motion(truth: Stream[PoseSequence]) -> Stream[PoseSequence]:
    """Return the same of a truth that is read by blocks."""
    names = truth.part(slice(0, 1)).names
    p, R, counts = np.zeros((len(names), 3)), np.zeros((len(names), 3, 3)), np.zeros((2, len(names)))
    for poses in truth.blocks():
        known = poses.valid & np.isfinite(poses.R_world_bone).all(axis=(2, 3))
        p += np.sum(poses.p_world_joint, axis=0, where=poses.valid[..., None])
        R += np.sum(poses.R_world_bone, axis=0, where=known[..., None, None])
        counts += np.sum([poses.valid, known], axis=1)
    p[counts[0] == 0] = np.nan
    p, R = p / np.maximum(counts[0], 1)[:, None], so3.nearest_rotation(R)
    R[counts[1] == 0] = np.nan

    def part(rows: slice) -> PoseSequence:
        times = truth.times[rows]
        every = [np.broadcast_to(one, (len(times), *one.shape)) for one in (p, R)]
        return PoseSequence(times, every[0], every[1], names)

    return Stream(truth.times, part)


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
    return resampled(truth, times).part(ALL)


def resampled(truth: Poses, times: Array) -> Stream[PoseSequence]:
    """Return the same of a truth that may be read by blocks."""
    known = Stream.of(truth)
    if np.array_equal(known.times, times):
        return known
    gap = 1.5 / known.rate_hz

    def part(rows: slice) -> PoseSequence:
        at = times[rows]
        near = signals.within(known.times, at[0] - 2 * gap, at[-1] + 2 * gap)
        first = min(near.start, len(known) - 1)
        poses = known.part(slice(first, max(near.stop, first + 1)))
        p = signals.interpolate(poses.times, np.where(poses.valid[..., None], poses.p_world_joint, np.nan), at, gap)
        return PoseSequence(at, p, signals.interpolate_rotations(poses.times, poses.R_world_bone, at, gap), poses.names)

    return Stream(times, part)


def _ratio(total: float, count: float) -> float:
    return float(total / count) if count else float("nan")
