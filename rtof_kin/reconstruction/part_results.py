"""Results of the parts of a long recording: cut to the kept frames, and continued from the part before."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import replace

import numpy as np

from rtof_kin.body.metrics import stage_metrics
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.reconstruction.quality import misfit_warnings, reprojection_errors
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.solution import FragmentReport, FragmentSolution, SolverStatus


def cut(result: Reconstruction, kept: slice, first: int = 0) -> Reconstruction:
    """Return some frames of a reconstruction, with their errors, faults, fragments and warnings.

    Args:
        kept: its frames to keep.
        first: number of its first frame in the whole recording, in which the fragments are counted afterwards.
    """
    times = result.motion.times[kept]
    start, stop = float(times[0]), float(times[-1])
    recording = result.recording.between(start, stop)
    stages = {name: poses[kept] for name, poses in result.stages.items()}
    scores = stage_metrics(stages, recording.truth, result.motion.skeleton, result.mode)
    solution = None if result.solution is None else _cut_solution(result.solution, kept)
    warnings = _cut_warnings(result, solution, kept)
    if solution is not None:
        moved = (replace(f, first_frame=f.first_frame + first) for f in solution.fragments)
        solution = replace(solution, fragments=tuple(moved))
    return replace(
        result,
        recording=recording,
        motion=result.motion[kept],
        stages=stages,
        keypoints=None if result.keypoints is None else result.keypoints[kept],
        bone_imus=None if result.bone_imus is None else result.bone_imus[kept],
        solution=solution,
        metrics=scores.get(result.mode),
        stage_metrics=scores,
        root_sigma=None if result.root_sigma is None else result.root_sigma[kept],
        faults=tuple(_clipped(result.faults, start, stop)),
        warnings=warnings,
    )


def sample(result: Reconstruction) -> Reconstruction:
    """Return the first second of a reconstruction with arrays of its own, so that the rest can be freed."""
    first = cut(result, slice(0, round(result.motion.poses.rate_hz)))
    body = result.motion.skeleton
    return deepcopy(first, {id(body): body})


def _cut_solution(solution: FragmentSolution, kept: slice) -> FragmentSolution:
    """The fragments that begin in the kept frames; in the first part, also the one before its first frame."""
    least = kept.start if kept.start > 0 else -np.inf
    own = tuple(f for f in solution.fragments if least <= f.first_frame < kept.stop)
    return FragmentSolution(solution.poses[kept], own)


def _cut_warnings(result: Reconstruction, cut: FragmentSolution | None, kept: slice) -> tuple[str, ...]:
    """Warnings, but of misfits those in the kept frames."""
    settings = result.choices.settings
    if cut is None or settings is None or result.solution is None or result.keypoints is None:
        return result.warnings
    off = reprojection_errors(result.keypoints, result.motion.skeleton, result.solution.poses)
    of_all = misfit_warnings(result.solution, off, settings)
    others = tuple(warning for warning in result.warnings if warning not in of_all)
    own = (replace(f, first_frame=f.first_frame - (kept.start or 0)) for f in cut.fragments)
    return others + misfit_warnings(replace(cut, fragments=tuple(own)), off[kept], settings)


def _clipped(faults: Iterable[StreamFault], start: float, stop: float) -> Iterator[StreamFault]:
    for fault in faults:
        if fault.start <= stop and fault.stop >= start:
            yield replace(fault, start=max(fault.start, start), stop=min(fault.stop, stop))


def lost(like: Reconstruction, recording: Recording, times: Array, why: str) -> Reconstruction:
    """Return a part that could not be reconstructed: poses are NaN, nothing is observed.

    Args:
        recording: of this one, corrected as that of the other; the other's where nothing was recorded.
        times: (T,) s of its frames.
    """
    skeleton, T = like.motion.skeleton, len(times)
    q = np.full((T, skeleton.nq), np.nan)
    p = np.full((T, len(skeleton.names), 3), np.nan)
    poses = PoseSequence(times, p, np.full((*p.shape, 3), np.nan), skeleton.names)
    motion = Motion(skeleton, q, poses, skeleton.check(q), _unknown(like.motion.confidence, times))
    keypoints, imus = like.keypoints, like.bone_imus
    if keypoints is not None:
        keypoints = evenly_spaced(recording.keypoints or keypoints, times)
    if imus is not None:
        S = len(imus.joints)
        R, a = np.full((T, S, 3, 3), np.nan), np.full((T, S, 3), np.nan)
        imus = replace(imus, times=times, R_world_bone=R, a_world=a)
    solution = None
    if like.solution is not None:
        report = FragmentReport(0, SolverStatus.UNOBSERVED, {}, 0, 0.0, np.nan, 0.0, 0.0)
        solution = FragmentSolution(poses, (report,))
    return replace(
        like,
        recording=recording,
        motion=motion,
        stages={like.mode: poses},
        keypoints=keypoints,
        bone_imus=imus,
        solution=solution,
        metrics=None,
        stage_metrics={},
        root_sigma=None if like.root_sigma is None else np.full(T, np.nan),
        faults=(),
        checks=(),
        warnings=(f"{times[0]:.1f} to {times[-1]:.1f} s: not reconstructed: {why}",),
    )


def _unknown(like: Confidence | None, times: Array) -> Confidence | None:
    """Covariances of NaN."""
    if like is None:
        return None
    T, J, P = len(times), len(like.names), len(like.pairs)
    joints = np.full((T, J, 3, 3), np.nan)
    return Confidence(times, like.names, joints, joints, like.pairs, np.full((T, P, 3, 3), np.nan))


class Seam:
    """Continues each part where the one before ends: angles and root quaternion stay continuous, and in mode
    imu, which has no global position, so does the root's path.
    """

    def __init__(self) -> None:
        """Begin before the first part."""
        self._q: Array | None = None
        """Last known configuration."""
        self._root: tuple[Array, float] | None = None
        """Root [m] and its variance [m^2] in the first frame of the next part, by this one."""

    def continued(self, part: Reconstruction, kept: slice, first: int) -> Reconstruction:
        """Return the kept frames of the next part, continued.

        Args:
            kept, first: as for `cut`.
        """
        if part.root_sigma is not None:
            part = self._on_path(part, part.root_sigma, kept)
        out = cut(part, kept, first)
        q = _continuous(out.motion.skeleton, out.motion.q, self._q)
        known = np.flatnonzero(np.isfinite(q).all(axis=1))
        self._q = q[known[-1]] if len(known) else self._q
        return replace(out, motion=replace(out.motion, q=q))

    def _on_path(self, part: Reconstruction, sigma: Array, kept: slice) -> Reconstruction:
        """The part with its root where the part before expects it."""
        p = part.motion.poses.p_world_joint[:, 0]
        if self._root is not None:
            (expected, variance), begin = self._root, kept.start
            shift = (expected - p[begin]) * [1.0, 1.0, 0.0]  # the floor gives the height
            sigma = np.sqrt(np.maximum(sigma**2 - sigma[begin] ** 2, 0.0) + variance)
            part = replace(_moved(part, shift), root_sigma=sigma)
            p = p + shift
        if kept.stop < len(p):
            self._root = p[kept.stop], float(sigma[kept.stop] ** 2)
        return part


def _moved(part: Reconstruction, shift: Array) -> Reconstruction:
    def moved(poses: PoseSequence) -> PoseSequence:
        return poses.with_poses(slice(None), poses.p_world_joint + shift)

    motion, q = part.motion, part.motion.q.copy()
    q[:, :3] += shift
    stages = {name: moved(poses) for name, poses in part.stages.items()}
    return replace(part, motion=replace(motion, q=q, poses=moved(motion.poses)), stages=stages)


def _continuous(skeleton: SkeletonModel, q: Array, before: Array | None) -> Array:
    """The same configurations (T, nq), on the branch of angles nearest to one before (nq,)."""
    known = np.isfinite(q).all(axis=1)
    if before is None or not known.any():
        return q
    joints = [joint for joint in skeleton.table.joints if joint.dofs]
    columns = np.array([[7 + skeleton.dof_names.index(dof.urdf) for dof in joint.dofs] for joint in joints])
    out, rows = q.copy(), np.vstack([before, q[known]])
    out[np.ix_(known, columns.ravel())] = so3.euler_continuous(rows[:, columns])[1:].reshape(known.sum(), -1)
    if rows[0, 3:7] @ rows[1, 3:7] < 0:
        out[:, 3:7] *= -1
    return out
