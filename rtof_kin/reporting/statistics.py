"""What audit, summary and terminal tell of a reconstruction: statistics collected part by part.

A long recording is reconstructed in parts (`rtof_kin.reconstruction.parts`), none of which is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.metrics import Metrics
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.motion_views import outside_gaps, root_and_dof_names, root_and_dofs_observed
from rtof_kin.inertial.outlier_rejection import merge_faults
from rtof_kin.reconstruction import quality
from rtof_kin.reconstruction.certificate import Certificate
from rtof_kin.reconstruction.part_results import PartFindings, joined_checks, joined_warnings, sample
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.solve.solution import FragmentReport, FragmentSolution


def reprojection_errors(result: Reconstruction) -> Array:
    """Return reprojection errors (T, L) of the landmarks, px; NaN where unknown. `InvalidInputError`: there are no
    keypoints.
    """
    keypoints = result.keypoints or result.recording.video
    return quality.reprojection_errors(keypoints, result.motion.skeleton, result.motion.poses)


def orientation_residuals(result: Reconstruction) -> tuple[Array, Array]:
    """Return orientation residuals (T, S) rad across the bone and about it, NaN where unknown.

    The residual of a segment with several children or none is all across.
    """
    skeleton, imus = result.motion.skeleton, result.bone_imus
    assert imus is not None
    index = skeleton.index(*imus.joints)
    R = result.motion.poses.R_world_bone[:, index]
    known = np.isfinite(R).all(axis=(2, 3)) & np.isfinite(imus.R_world_bone).all(axis=(2, 3))
    off = np.full((*known.shape, 3), np.nan)
    off[known] = so3.log(np.swapaxes(R[known], -1, -2) @ imus.R_world_bone[known])
    about = np.zeros(known.shape)
    for s, joint in enumerate(imus.joints):
        bone = skeleton.bone_axis(joint)
        about[:, s] = off[:, s] @ bone
        off[:, s] -= about[:, s, None] * bone
    return np.linalg.norm(off, axis=-1), np.where(known, np.abs(about), np.nan)


def acceleration_residuals(result: Reconstruction) -> Array:
    """Return residuals (T, S) m/s^2 between sensors and the second difference of the motion at their lever
    arms; NaN at the ends and where unknown.
    """
    imus, poses = result.bone_imus, result.motion.poses
    assert imus is not None
    index = result.motion.skeleton.index(*imus.joints)
    lever = np.einsum("tsij,sj->tsi", poses.R_world_bone[:, index], imus.p_bone_sensor)
    out = np.full(imus.a_world.shape[:2], np.nan)
    if len(poses) < 3:
        return out
    a = np.diff(poses.p_world_joint[:, index] + lever, n=2, axis=0) * poses.rate_hz**2
    out[1:-1] = np.linalg.norm(a - imus.a_world[1:-1], axis=-1)
    return out


KEPT_ROWS = 20_000  #: Largest number of rows kept for medians; beyond it every second row is dropped, evenly over time


class ColumnStatistics:
    """Mean, RMS, largest value with its time, and median of each of K columns; NaN does not count.

    Medians are exact up to `KEPT_ROWS` rows, then those of evenly spaced rows.
    """

    def __init__(self, columns: int, medians: bool = True) -> None:
        """Begin without rows."""
        self._medians = medians
        self.known = np.zeros(columns, dtype=np.int64)
        """(K,) number of finite values."""
        self.largest, self.largest_at = np.full(columns, np.nan), np.full(columns, np.nan)
        """(K,) largest values, and their times; NaN where nothing is known."""
        self._sum, self._squares = np.zeros(columns), np.zeros(columns)
        self._kept: list[Array] = []
        self._rows, self._step = 0, 1

    def add(self, times: Array, values: NDArray[Any]) -> None:
        """Add rows. `ShapeError`: another number of columns or rows.

        Args:
            times: (T,) s. values: (T, K), numbers or a mask.
        """
        if values.shape != (len(times), len(self.known)):
            raise ShapeError(f"statistics: expected ({len(times)}, {len(self.known)}), got {values.shape}")
        finite = np.isfinite(values)
        plain = np.where(finite, values, 0.0)
        self.known += finite.sum(axis=0)
        self._sum += plain.sum(axis=0)
        self._squares += (plain**2).sum(axis=0)
        if len(times):
            rows = np.where(finite, values, -np.inf).argmax(axis=0)
            top = values[rows, np.arange(values.shape[1])]
            better = np.isfinite(top) & ~(top <= self.largest)
            self.largest[better], self.largest_at[better] = top[better], times[rows[better]]
        if not self._medians:
            return
        self._kept.append(np.array(values[-self._rows % self._step :: self._step], dtype=float))
        self._rows += len(times)
        while -(-self._rows // self._step) > KEPT_ROWS:
            self._kept = [np.concatenate(self._kept)[::2].copy()]
            self._step *= 2

    @property
    def mean(self) -> Array:
        """(K,) means; NaN where nothing is known."""
        return _divided(self._sum, self.known)

    @property
    def rms(self) -> Array:
        """(K,) roots of the mean squares; NaN where nothing is known."""
        return np.asarray(np.sqrt(_divided(self._squares, self.known)))

    @property
    def mean_of_all(self) -> float:
        """Mean of all values; NaN where nothing is known."""
        return float(_divided(self._sum.sum(), self.known.sum()))

    @property
    def rms_of_all(self) -> float:
        """Root of the mean square of all values; NaN where nothing is known."""
        return float(np.sqrt(_divided(self._squares.sum(), self.known.sum())))

    @property
    def median(self) -> Array:
        """(K,) medians; NaN where nothing is known."""
        out, rows = np.full(len(self.known), np.nan), self._values()
        some = np.isfinite(rows).any(axis=0)
        out[some] = np.nanmedian(rows[:, some], axis=0)
        return out

    @property
    def median_of_all(self) -> float:
        """Median of all values; NaN where nothing is known."""
        rows = self._values()
        return float(np.nanmedian(rows)) if np.isfinite(rows).any() else float("nan")

    def _values(self) -> Array:
        return np.concatenate([np.empty((0, len(self.known))), *self._kept])


def _divided(sums: NDArray[Any], counts: NDArray[Any]) -> Array:
    some = counts > 0
    return np.where(some, sums / np.where(some, counts, 1), np.nan)


_WITH_MEDIANS: Final = ("reprojection", "depth", "body height px")  #: Quantities of which medians are used


class ReconstructionStatistics:
    """Statistics of a reconstruction.

    Attributes:
        first: one second of the first part, for what is the same in all.
        frames: number of frames. fragments: reports of the fragment solver, in order.
        root_sigma: standard deviation of the root's horizontal coordinates at the end, m; NaN unless in
            mode imu.
        certificate: of the part that was certified; None without one.
    """

    def __init__(self, first: Reconstruction) -> None:
        """Begin with the first part, or the whole."""
        self.first, self.frames = sample(first), 0
        self.root_sigma = float("nan")
        self.certificate: Certificate | None = None
        self.fragments: list[FragmentReport] = []
        self._faults: list[StreamFault] = []
        self._findings: list[PartFindings] = []
        self._scores: list[tuple[int, Mapping[str, Metrics]]] = []
        self._statistics: dict[str, ColumnStatistics] = {}
        self.add(first)

    @classmethod
    def of(cls, found: Reconstruction | ReconstructionStatistics) -> ReconstructionStatistics:
        """Return the statistics of a reconstruction in one part, or those that are given."""
        return cls(found) if isinstance(found, Reconstruction) else found

    def add(self, part: Reconstruction) -> None:
        """Add the next part."""
        for name, times, values in _blocks(part):
            values = values.reshape(len(times), math.prod(values.shape[1:]))
            if name not in self._statistics:
                self._statistics[name] = ColumnStatistics(values.shape[1], name in _WITH_MEDIANS)
            self._statistics[name].add(times, values)
        if part.solution is not None:
            self.fragments += part.solution.fragments
        self._faults += part.faults
        self._findings.append(PartFindings(float(part.motion.times[0]), part.checks, part.warnings))
        if part.metrics is not None:
            scored = int(np.isfinite(part.metrics.over_time["mpjpe_mm"]).sum())
            means = {stage: replace(found, over_time={}) for stage, found in part.stage_metrics.items()}
            self._scores.append((scored, means))
        self.certificate = part.certificate or self.certificate
        if part.root_sigma is not None:
            self.root_sigma = float(part.root_sigma[-1])
        self.frames += len(part.motion.times)

    def __contains__(self, name: str) -> bool:
        return name in self._statistics

    def __getitem__(self, name: str) -> ColumnStatistics:
        """Statistics of a quantity of `_blocks`."""
        return self._statistics[name]

    @property
    def provenance_shares(self) -> dict[str, float]:
        """Share of all joints and frames by `Provenance`, in lower case -> 0 to 1."""
        return {p.name.lower(): self[f"provenance {p.name.lower()}"].mean_of_all for p in Provenance}

    @property
    def from_prior(self) -> dict[str, float]:
        """Unobserved degrees of freedom by URDF name, and the root's orientation -> share of the frames."""
        names = root_and_dof_names(self.first.motion.skeleton)
        return {n: float(v) for n, v in zip(names, self["from prior"].mean, strict=True) if v > 0}

    @property
    def limit_violations(self) -> dict[str, float]:
        """Largest excess, rad, of each revolute that violates its limits."""
        names, largest = self.first.motion.report.dof_names, self["limit excess"].largest
        return {name: float(v) for name, v in zip(names, largest, strict=True) if v > 0}

    @property
    def mean_sigmas(self) -> tuple[float, float] | None:
        """Mean standard deviations per axis of the joints, relative to the root and in world, m."""
        if "position sigma" not in self:
            return None
        return self["relative sigma"].mean_of_all, self["position sigma"].mean_of_all

    @property
    def parts(self) -> int:
        """Number of parts."""
        return len(self._findings)

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return self.frames / self.first.motion.poses.rate_hz

    @property
    def faults(self) -> tuple[StreamFault, ...]:
        """Faults of all parts; those that go on from one part to the next are one."""
        return tuple(self._faults) if self.parts == 1 else merge_faults(self._faults)

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the whole, see `joined_checks`."""
        return joined_checks(self._findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the whole, see `joined_warnings`."""
        return joined_warnings(self._findings)

    @property
    def solution(self) -> FragmentSolution | None:
        """Report of the solver with the fragments of all parts, and the poses of the first one."""
        found = self.first.solution
        return None if found is None else replace(found, fragments=tuple(self.fragments), confidence=None)

    @property
    def stage_metrics(self) -> dict[str, Metrics]:
        """Errors against the truth by stage: means over all scored frames; empty without a truth."""
        if len(self._scores) <= 1:
            return dict(self._scores[0][1]) if self._scores else {}
        counts = [count for count, _ in self._scores]
        stages = self._scores[0][1]
        return {stage: _mean_of([found[stage] for _, found in self._scores], counts) for stage in stages}

    @property
    def metrics(self) -> Metrics | None:
        """Those of the motion; None without a truth."""
        return self.stage_metrics.get(self.first.mode)


def _blocks(part: Reconstruction) -> Iterator[tuple[str, Array, NDArray[Any]]]:
    """Yield name, times (T,) and values (T, ...) of every quantity."""
    motion, poses, imus = part.motion, part.motion.poses, part.bone_imus
    yield "invalid", motion.times, ~poses.valid
    yield "unobserved", motion.times, np.asarray(poses.provenance <= Provenance.BRIDGED)
    for one in Provenance:
        yield f"provenance {one.name.lower()}", motion.times, np.asarray(poses.provenance == one)
    yield "singular", motion.times, motion.report.singular
    yield "limit excess", motion.times, np.nan_to_num(motion.report.limit_excess)
    masks = MotionSource.of(motion).masks
    inside = outside_gaps(masks)
    yield "from prior", motion.times[inside], np.logical_not(root_and_dofs_observed(masks)[inside])
    if part.keypoints is not None:
        landmarks = part.keypoints.landmarks
        depth = part.keypoints.camera.to_camera(poses.p_world_joint[:, 0])[:, 2]
        yield "unseen", motion.times, ~landmarks.seen
        yield "points unseen", motion.times, ~part.keypoints.seen
        yield "reprojection", motion.times, reprojection_errors(part)
        yield "depth", motion.times, depth
        yield "body height px", motion.times, part.keypoints.camera.K[1, 1] * motion.skeleton.height / depth
    if imus is not None:
        swing, twist = orientation_residuals(part)
        yield "missing", imus.times, np.asarray(np.isnan(imus.R_world_bone[..., 0, 0]))
        yield "swing", imus.times, swing
        yield "twist", imus.times, twist
        yield "acceleration", imus.times, acceleration_residuals(part)
    if motion.confidence is not None:
        yield "relative sigma", motion.times, motion.confidence.relative_sigma[:, 1:]
        yield "position sigma", motion.times, motion.confidence.position_sigma
        yield "orientation sigma", motion.times, motion.confidence.orientation_sigma
    if (raw := part.recording.imus) is not None:
        yield "sensor unknown", raw.times, np.asarray(np.isnan(raw.R_inertial_sensor).any(axis=(2, 3)))
        force = np.abs(raw.f_sensor)
        largest = np.nan_to_num(force, nan=-np.inf).max(axis=-1)
        yield "specific force", raw.times, np.where(np.isfinite(force).any(axis=-1), largest, np.nan)


def _mean_of(found: list[Metrics], counts: list[int]) -> Metrics:
    """Means of parts, weighted by their numbers of frames; nothing over time."""

    def mean(tables: list[Mapping[str, float]]) -> dict[str, float]:
        out = {}
        for name in dict.fromkeys(name for table in tables for name in table):
            both = zip(counts, tables, strict=True)
            known = [(count, table[name]) for count, table in both if np.isfinite(table.get(name, np.nan))]
            total = sum(count for count, _ in known)
            out[name] = sum(count * value for count, value in known) / total if total else float("nan")
        return out

    joints = dict.fromkeys(joint for metrics in found for joint in metrics.per_joint)
    per_joint = {joint: mean([metrics.per_joint.get(joint, {}) for metrics in found]) for joint in joints}
    return Metrics(mean([metrics.pooled for metrics in found]), per_joint, {})
