"""Results of the parts of a long recording: cut to the kept frames, and continued from the part before."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from itertools import groupby
from typing import Any, Final

import numpy as np
from scipy.special import bdtr

from rtof_kin.body.skeleton import ConfigurationReport, Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.camera import CameraTurning
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.outlier_rejection import merge_faults
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.reconstruction.quality import misfit_warnings, reprojection_errors
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.solution import FragmentReport, FragmentSolution, SolverStatus


def cut(result: Reconstruction, kept: slice, first: int = 0) -> Reconstruction:
    """Return some frames of a reconstruction, with their errors, faults, fragments and warnings; `kept`: its frames to
    keep; `first`: number of its first frame in the whole recording, in which the fragments are counted afterwards.
    """
    times = result.motion.times[kept]
    start, stop = float(times[0]), float(times[-1])
    recording = result.recording.between(start, stop)
    warnings, solution = result.warnings, result.solution
    if solution is not None:  # its fragments that begin in the kept frames; at first also the one before these
        least = kept.start if kept.start > 0 else -np.inf
        own = tuple(f for f in solution.fragments if least <= f.first_frame < kept.stop)
        solution = FragmentSolution(solution.poses[kept], own)
        warnings = _cut_warnings(result, solution, kept)
        moved = (replace(f, first_frame=f.first_frame + first) for f in solution.fragments)
        solution = replace(solution, fragments=tuple(moved))
    return replace(
        result,
        recording=recording,
        motion=result.motion[kept],
        stages={name: poses[kept] for name, poses in result.stages.items()},
        keypoints=None if result.keypoints is None else result.keypoints[kept],
        bone_imus=None if result.bone_imus is None else result.bone_imus[kept],
        solution=solution,
        root_sigma=None if result.root_sigma is None else result.root_sigma[kept],
        faults=tuple(
            replace(fault, start=max(fault.start, start), stop=min(fault.stop, stop))
            for fault in result.faults
            if fault.start <= stop and fault.stop >= start
        ),
        warnings=warnings,
    ).scored()


def sample(result: Reconstruction) -> Reconstruction:
    """Return the first second of a reconstruction with arrays of its own, so that the rest can be freed."""
    first = cut(result, slice(0, round(result.motion.poses.rate_hz)))
    body = result.motion.skeleton
    return deepcopy(first, {id(body): body})


def _cut_warnings(result: Reconstruction, cut: FragmentSolution, kept: slice) -> tuple[str, ...]:
    """Warnings, but of misfits those in the kept frames."""
    settings = result.choices.settings
    if settings is None or result.solution is None or result.keypoints is None:
        return result.warnings
    off = reprojection_errors(result.keypoints, result.motion.skeleton, result.solution.poses)
    of_all = misfit_warnings(result.solution, off, settings)
    others = tuple(warning for warning in result.warnings if warning not in of_all)
    own = (replace(f, first_frame=f.first_frame - (kept.start or 0)) for f in cut.fragments)
    return others + misfit_warnings(replace(cut, fragments=tuple(own)), off[kept], settings)


def lost(like: Reconstruction, recording: Recording, times: Array, why: str) -> Reconstruction:
    """Return a part that could not be reconstructed: poses are NaN, nothing is observed.

    Args:
        recording: of this one, corrected as that of the other; the other's where nothing was recorded.
        times: (T,) s of its frames.
    """
    skeleton, known, imus = like.motion.skeleton, like.motion.confidence, like.bone_imus

    def missing(*shape: int) -> Array:
        return np.full((len(times), *shape), np.nan)

    q, J = missing(skeleton.nq), len(skeleton.names)
    poses = PoseSequence(times, missing(J, 3), missing(J, 3, 3), skeleton.names)
    if known is not None:
        joints, pairs = missing(len(known.names), 3, 3), missing(len(known.pairs), 3, 3)
        known = Confidence(times, known.names, joints, joints, known.pairs, pairs)
    if imus is not None:
        S = len(imus.joints)
        imus = replace(imus, times=times, R_world_bone=missing(S, 3, 3), a_world=missing(S, 3))
    report = FragmentReport(0, SolverStatus.UNOBSERVED, {}, 0, 0.0, np.nan, 0.0, 0.0)
    keypoints = like.keypoints
    return replace(
        like,
        recording=recording,
        motion=Motion(skeleton, q, poses, skeleton.check(q), known),
        stages={like.mode: poses},
        keypoints=None if keypoints is None else evenly_spaced(recording.keypoints or keypoints, times),
        bone_imus=imus,
        solution=None if like.solution is None else FragmentSolution(poses, (report,)),
        stage_metrics={},
        root_sigma=None if like.root_sigma is None else missing(),
        faults=(),
        checks=(),
        warnings=(f"{times[0]:.1f} to {times[-1]:.1f} s: not reconstructed: {why}",),
    )


class Seam:
    """Continues each part where the one before ends: angles and root quaternion stay continuous, and in mode
    imu, which has no global position, so does the root's path.
    """

    def __init__(self) -> None:
        self._q: Array | None = None  #: Last known configuration
        self._root: tuple[Array, float] | None = None
        """Root [m] and its variance [m^2] in the first frame of the next part, by this one."""

    def continued(self, part: Reconstruction, kept: slice, first: int) -> Reconstruction:
        """Return the kept frames of the next part, continued; of a root with a path, all frames are given."""
        if part.root_sigma is not None:
            part = cut(self._on_path(part, part.root_sigma, kept), kept, first)
        q = _continuous(part.motion.skeleton, part.motion.q, self._q)
        known = np.flatnonzero(np.isfinite(q).all(axis=1))
        self._q = q[known[-1]] if len(known) else self._q
        return replace(part, motion=replace(part.motion, q=q))

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


_FALSE_ALARMS: Final = 0.05
"""Share of correct recordings in which a check fails, at most (benchmarks/results/planted.md)."""
_CHANCE: Final = 0.95
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class PartFindings:
    """What was found in one part."""

    start: float  #: Time of its first frame, s
    checks: tuple[Check, ...]
    warnings: tuple[str, ...]


def joined_checks(parts: Sequence[PartFindings]) -> tuple[Check, ...]:
    """Return one check in place of those of the parts: it fails where at least half of the parts in which
    it was possible fail, and two at least. It is the one of median value among those that agree with that.
    """
    return parts[0].checks if len(parts) == 1 else tuple(_joined(own) for own in _alike(parts))


def joined_warnings(parts: Sequence[PartFindings]) -> tuple[str, ...]:
    """Return the warnings of all parts once each, with those about checks that fail in some parts only:
    in two neighbouring ones, or in more than one false alarm in twenty explains.
    """
    if len(parts) == 1:
        return parts[0].warnings
    times: dict[str, list[float]] = {}
    for part in parts:
        for sentence in part.warnings:
            times.setdefault(sentence, []).append(part.start)
    out = []
    for text, at in times.items():
        where = f" (in {len(at)} of {len(parts)} parts, first from {at[0]:.0f} s)"
        out.append(text if len(at) in (1, len(parts)) else text + where)
    for own in _alike(parts):
        wrong = [(start, check) for start, check in own if check.failed]
        runs = (len(list(run)) for fails, run in groupby(own, lambda one: one[1].failed) if fails)
        possible = sum(check.passed or check.failed for _, check in own)
        explained = not wrong or bdtr(len(wrong) - 1, possible, _FALSE_ALARMS) < _CHANCE
        if _joined(own).failed or (explained and max(runs, default=0) < 2):
            continue
        start, check = wrong[0]
        out.append(f"in {len(wrong)} of {len(parts)} parts, first from {start:.0f} s: {check.message}")
    return tuple(out)


_Own = list[tuple[float, Check]]  #: Start of a part, s, and its check


def _alike(parts: Sequence[PartFindings]) -> Iterator[_Own]:
    """Yield each check of all parts; numbers in its name do not count."""
    found: dict[tuple[str, str], _Own] = {}
    for part in parts:
        for check in part.checks:
            key = _NUMBER.sub("#", check.name), check.subject
            found.setdefault(key, []).append((part.start, check))
    yield from found.values()


def _joined(own: _Own) -> Check:
    known = sorted((check for _, check in own if check.passed or check.failed), key=lambda c: c.value)
    if not known:
        return own[0][1]
    wrong = [check for check in known if check.failed]
    right = [check for check in known if check.passed]
    if len(wrong) >= max(2, len(right)):
        typical = wrong[len(wrong) // 2]
        return replace(typical, advice=f"{typical.advice} (in {len(wrong)} of {len(own)} parts)".strip())
    if right:
        return right[len(right) // 2]
    (lone,) = wrong
    why = f"possible in 1 of {len(own)} parts only, where it fails: too little to tell"
    return Check.unknown(lone.name, lone.subject, lone.unit, why)


# --- the parts as one ----------------------------------------------------------------------------


def joined(parts: Sequence[Reconstruction]) -> Reconstruction:
    """Return the parts of a recording as one reconstruction, which keeps them."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    recordings = [first.recording]
    for part in parts[1:]:  # one in which nothing was recorded has that of another
        recordings += [part.recording] if part.recording.start_s > recordings[-1].stop_s else []
    streams = {
        name: _one([getattr(own, name) for own in recordings]) for name in ("keypoints", "imus", "truth", "views")
    }
    recording = replace(first.recording, **streams)
    names = [name for name in first.stages if all(name in part.stages for part in parts)]
    findings = [PartFindings(float(part.motion.times[0]), part.checks, part.warnings) for part in parts]
    motion = _one([part.motion for part in parts])
    reports = tuple(report for part in parts if part.solution is not None for report in part.solution.fragments)
    return replace(
        first,
        recording=recording,
        motion=motion,
        stages={name: _one([part.stages[name] for part in parts]) for name in names},
        keypoints=_one([part.keypoints for part in parts]),
        bone_imus=_one([part.bone_imus for part in parts]),
        solution=None if first.solution is None else FragmentSolution(motion.poses, reports, motion.confidence),
        root_sigma=_one([part.root_sigma for part in parts]),
        faults=merge_faults(fault for part in parts for fault in part.faults),
        warnings=joined_warnings(findings),
        checks=joined_checks(findings),
        certificate=next((part.certificate for part in parts if part.certificate is not None), None),
        parts=tuple(parts),
    ).scored()


def _one(values: Sequence[Any], counts: Sequence[int] = ()) -> Any:
    """Values of consecutive frames as one: arrays with a row a frame, and data of such; others are the first's.

    Args:
        counts: frames of each, by default by their times.
    """
    first = values[0]
    if any(value is None for value in values):
        return None
    if isinstance(first, tuple):
        return tuple(map(_one, zip(*values, strict=True))) if len({len(value) for value in values}) == 1 else ()
    if isinstance(first, np.ndarray):
        return np.concatenate(values)
    counts = counts or [len(value.times) for value in values]
    changed = {}
    for field in fields(first):
        own = [getattr(value, field.name) for value in values]
        if isinstance(own[0], PoseSequence | Confidence | CameraTurning | ConfigurationReport):
            changed[field.name] = _one(own, counts)
        elif all(
            isinstance(array, np.ndarray) and array.shape[:1] == (n,) for array, n in zip(own, counts, strict=True)
        ):
            changed[field.name] = np.concatenate(own)
    return replace(first, **changed)
