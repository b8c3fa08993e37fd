"""Joint-space solver of a recording: one fragment after the other, blended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter
from typing import Final

import numpy as np

from rtof_kin.body.observability import DIRECTION, WHOLE, levels_by_points
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import ContactPoints
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.covariance import (
    blended,
    confidence_of,
    state_covariances,
    unseen_covariance,
    unseen_times,
)
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.solution import Block, FragmentReport, SolverStatus
from rtof_kin.solve.terms import PointData, Term
from rtof_kin.vision.image_points import measurements

_LOCAL_MINIMUM: Final = 1.8
"""Ratio of reprojection sigmas of neighbouring fragments that indicates a local minimum; biases and
outliers change it by less."""
_PENDING: Final = 4  #: Fragments that may still be solved again from a later neighbour


class JointSpaceSolver:
    """Optimises configurations of a skeleton; see `rtof_kin.solve.fragment_solver.FragmentSolver`."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int,
        settings: JointSpaceSettings,
        places: tuple[str, ...] = (),
        terms: tuple[Term, ...] = (),
    ) -> None:
        """Keep the arguments of `Observations`."""
        self.skeleton, self.frames, self.settings = skeleton, frames, settings
        self.places, self.terms = places, terms

    def run(
        self,
        guess: InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | None,
        contact_points: ContactPoints | None,
        progress: Callable[[int, int], None] | None,
        confidence: bool = False,
        views: Sequence[KeypointSequence] = (),
        observed: Mapping[str, PointData] | None = None,
    ) -> Iterator[Block]:
        """Yield blocks of N/2 frames; the arguments are those of `FragmentSolver.solve`."""
        if keypoints is not None:
            used = measurements(keypoints, self.skeleton)
            if not set(used.names) & set(keypoints.names):
                raise SolverError("keypoints: none of the landmarks is one of the skeleton")
        data = Observations(
            self.skeleton,
            self.frames,
            self.settings,
            guess,
            keypoints,
            bone_imus,
            contact_points,
            self.places,
            views,
            self.terms,
            observed,
        )
        half, times = self.frames // 2, guess.poses.times
        i = np.arange(self.frames)
        taper = np.minimum(i + 0.5, self.frames - i - 0.5) ** 2
        share = taper[:half] / (taper[half:] + taper[:half])
        fragments = _Fragments(data, self.settings, confidence).settled(range(-half, len(times), half), progress)
        reports: list[FragmentReport] = []
        unseen = unseen_times(data)
        for previous, piece in pairwise(fragments):
            frames = slice(piece.first, min(piece.first + half, len(times)))
            count, known, spread = frames.stop - piece.first, None, None
            x = data.space.blend(previous.x[half:], piece.x[:half], taper[half:], taper[:half])[:count]
            if previous.covariance is not None and piece.covariance is not None:
                C = blended(previous.covariance[half:], piece.covariance[:half], share)[:count]
                known = confidence_of(data.space, times[frames], x, C, data.fixed)
                if unseen[frames].any():
                    C = unseen_covariance(data, unseen[frames])
                    spread = confidence_of(data.space, times[frames], x, C, data.fixed)
            reports = [piece.report] if reports else [previous.report, piece.report]
            yield Block(frames, *data.space.poses(x), tuple(reports), known, spread)

    def oriented(
        self,
        poses: PoseSequence,
        keypoints: KeypointSequence | None,
        _: BoneImuSequence | None,
        views: Sequence[KeypointSequence] = (),
    ) -> PoseSequence:
        """Return the poses with flags of the orientations that landmarks beside the joints show."""
        ends = [j not in self.skeleton.parents for j in range(len(poses.names))]
        for seen in (keypoints, *views):
            if seen is not None:
                levels = levels_by_points(self.skeleton, seen)
                poses = replace(
                    poses,
                    orientation_observed=poses.orientation_observed | (levels == WHOLE),
                    direction_observed=poses.direction_observed | ((levels == DIRECTION) & ends),
                )
        return poses


@dataclass(frozen=True)
class _Piece:
    """A solved fragment."""

    x: Array  #: (N, 3 + 4A) states
    report: FragmentReport
    covariance: Array | None  #: (N, D, D) of their tangents, where asked for; NaN where unobserved

    @property
    def first(self) -> int:
        return self.report.first_frame

    def fits_worse(self, other: _Piece) -> bool:
        """Whether its reprojection errors are much larger than another's, as in a local minimum."""
        a, b = self.report, other.report
        solved = {a.status, b.status}.isdisjoint((SolverStatus.FAILED, SolverStatus.UNOBSERVED))
        return solved and a.sees_enough and a.sigma_reprojection > _LOCAL_MINIMUM * b.sigma_reprojection


class _Fragments:
    """Solves the fragments of one recording."""

    def __init__(self, data: Observations, settings: JointSpaceSettings, confidence: bool) -> None:
        self.data, self.settings, problem = data, settings, data.problem
        self._confidence = confidence
        self._real_time = LevenbergMarquardt(problem, data.limits)

    def settled(self, firsts: Sequence[int], progress: Callable[[int, int], None] | None) -> Iterator[_Piece]:
        """Yield the fragments; one that fits much worse than an overlapping one is solved again from it."""
        pending: list[_Piece] = []
        for done, first in enumerate(firsts, start=1):
            piece = self._solve(first)
            if pending and piece.fits_worse(pending[-1]):
                piece = self._retried(piece, pending[-1])
            pending.append(piece)
            for i in range(len(pending) - 1, 0, -1):
                if not pending[i - 1].fits_worse(pending[i]):
                    break
                pending[i - 1] = self._retried(pending[i - 1], pending[i])
            if progress is not None:
                progress(done, len(firsts))
            if len(pending) > _PENDING:
                yield pending.pop(0)
        yield from pending

    def _retried(self, piece: _Piece, other: _Piece) -> _Piece:
        """The fragment solved from a neighbour's states, continued by its own guess, if that is better."""
        index, _, _ = self.data.fragment(piece.first)
        shared = max(piece.first, other.first) + np.arange(self.data.frames // 2)
        own, theirs = shared - piece.first, shared - other.first
        edge = -1 if other.first < piece.first else 0
        x = self.data.space.carried_on(self.data.start[index], own[edge], other.x[theirs[edge]])
        x[own] = other.x[theirs]
        again = self._solve(piece.first, x)
        kept = again if piece.fits_worse(again) else piece
        a, b = piece.report, again.report
        both = replace(kept.report, iterations=a.iterations + b.iterations, seconds=a.seconds + b.seconds)
        return replace(kept, report=both)

    def _solve(self, first: int, start: Array | None = None) -> _Piece:
        """The frames from `first`, from the initial guess or other states (N, 3 + 4A)."""
        data, s = self.data, self.settings
        index, inside, values = data.fragment(first)
        began = perf_counter()
        data.problem.bind(values)
        annealing = Annealing(s, data.problem, data.confidence[index], data.points.sizes, values.observation)
        x, failed = data.start[index] if start is None else start, True
        try:
            anneals = s.annealing if s.sigma_reprojection is None else 0
            solved = self._real_time.solve(x, anneals + s.max_iterations, s.tolerance, None, annealing)
            failed = not np.isfinite(solved.x).all()
        except SolverError:
            pass  # the report has the status FAILED
        if failed:
            M = len(data.limits.names) if data.limits else 0
            solved = Solved(x, 0, False, np.zeros((len(x), M)))
        seconds, status = perf_counter() - began, SolverStatus.of(solved)
        if failed or not data.anything_seen(first, inside):
            status = SolverStatus.FAILED if failed else SolverStatus.UNOBSERVED
        report, covariance = self._report(solved, first, annealing.sigma, seconds, status), None
        if self._confidence:
            usable, D = status not in (SolverStatus.UNOBSERVED, SolverStatus.FAILED), data.space.size
            nothing = np.full((len(x), D, D), np.nan)
            covariance = state_covariances(data.problem, self._real_time, solved) if usable else nothing
        return _Piece(solved.x, report, covariance)

    def _report(self, solved: Solved, first: int, sigma: float, seconds: float, status: SolverStatus) -> FragmentReport:
        """Report measured at the returned point."""
        data = self.data
        energy, _ = data.problem.value(solved.x)
        gradient, infeasibility = data.problem.gradient(solved.x), 0.0
        if data.limits is not None:
            excess = data.limits.excess(data.limits.values(solved.x))
            infeasibility = float(np.abs(excess).max(initial=0.0))
            gradient = gradient + data.limits.force(solved.x, solved.multipliers)
        return FragmentReport(
            first_frame=first,
            status=status,
            energy=energy,
            iterations=solved.iterations,
            seconds=seconds,
            sigma_reprojection=sigma,
            optimality=float(np.abs(gradient).max()),
            infeasibility=infeasibility,
        )
