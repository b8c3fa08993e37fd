"""The fragment solver on whole recordings: what it minimises, reports, and does not remember."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import planted
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rtof_kin import rotations as so3
from rtof_kin.errors import ShapeError, SolverError, UnknownNameError
from rtof_kin.fragment import FragmentReport, FragmentSolver, SolverStatus
from rtof_kin.fragment_problem import TERMS, FragmentSettings, rigid_pairs
from rtof_kin.inertial_ik import InertialGuidedIK
from rtof_kin.skeleton import MotionSequence, SkeletonModel
from rtof_kin.types import BoneImuSequence, KeypointSequence, PoseSequence, Provenance

Array = NDArray[np.float64]
BODY, SMALL = SkeletonModel.default(), SkeletonModel.human36m()
N = 16
PLAIN = FragmentSettings(sigma_reprojection=8.0, refit_root=False)
"""One solver call a fragment, from the start as it is given."""
SMALL_SENSORS = ("LElbow", "RKnee", "LHip", "Hip")


class Inspected(FragmentSolver):
    """A solver that keeps the answer of each fragment before they are blended."""

    answers: list[Array]

    def _solve_fragment(self, first: int, start: PoseSequence, data: dict[str, Array]):  # type: ignore[no-untyped-def]
        X, report = super()._solve_fragment(first, start, data)
        self.answers.append(X)
        return X, report


@cache
def body(s: FragmentSettings = FragmentSettings(), frames: int = N) -> FragmentSolver:  # noqa: B008
    return FragmentSolver(BODY, frames, s)


@cache
def small(s: FragmentSettings = PLAIN, frames: int = 8) -> Inspected:
    return Inspected(SMALL, frames, s, SMALL_SENSORS)


class Scene:
    """A motion, what was observed of it, and poses to start from."""

    def __init__(self, skeleton: SkeletonModel, frames: int, sigma_px: float = 4.0, seed: int = 0):
        joints = planted.LIMBS if skeleton is BODY else SMALL_SENSORS
        self.truth: MotionSequence = planted.moving(skeleton, frames, seed)
        self.seen = planted.keypoints(self.truth.poses, sigma_px)
        self.imus = planted.bone_imus(skeleton, self.truth.poses, joints, 4.0, 0.4)
        self.lifted = planted.lifted_poses(self.truth)
        self.start = InertialGuidedIK(skeleton).refine(self.lifted, self.imus)

    @property
    def p(self) -> Array:
        return self.truth.poses.p_world_joint


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(BODY, 60)


def inside(first: int, frames: int, T: int) -> slice:
    return slice(max(first, 0), min(first + frames, T))


# --- what is minimised -----------------------------------------------------------------------------


@pytest.mark.parametrize("change", [
    {},
    {"bone_lengths": "free", "prior": "positions", "huber_reprojection": None},
    {"k_V": 0.3, "k_S": 0.0, "k_I": 0.9},
])  # fmt: skip
@pytest.mark.parametrize("max_iterations", [2, 60])
def test_every_report_is_the_documented_energy_and_its_true_gradient(
    change: dict[str, object], max_iterations: int
) -> None:
    s = Scene(SMALL, 12)
    set_ = replace(PLAIN, **change, max_iterations=max_iterations)  # type: ignore[arg-type]
    seen = replace(
        s.seen, confidence=np.random.default_rng(0).uniform(0.2, 1.0, s.seen.confidence.shape)
    )
    seen = planted.unseen(seen, slice(2, 6), [3, 4])
    R = np.array(s.imus.R_world_bone)
    R[7, 1] = np.nan
    imus = replace(s.imus, R_world_bone=R)
    solver = small(set_)
    solver.answers = []
    solution = solver.solve(s.start, seen, imus)
    assert [report.first_frame for report in solution.fragments] == [-4, 0, 4, 8]
    for report, answer in zip(solution.fragments, solver.answers, strict=True):
        part = inside(report.first_frame, 8, 12)
        X = answer[part.start - report.first_frame : part.stop - report.first_frame]

        def residuals(x: Array, part: slice = part) -> dict[str, Array]:
            return planted.documented_residuals(
                x.reshape(-1, len(SMALL.names), 3), s.start[part], seen[part], imus[part],
                SMALL, set_, frames=8, sigma_px=8.0,
            )  # fmt: skip

        peer = {term: float(np.sum(r**2)) for term, r in residuals(X).items()}
        assert report.energy == pytest.approx(peer, rel=1e-8, abs=1e-12)

        def total(x: Array) -> float:
            return sum(float(np.sum(r**2)) for r in residuals(x).values())  # noqa: B023

        gradient = []
        for i in range(X.size):
            step = np.zeros(X.size)
            step[i] = 1e-5
            gradient.append((total(X.ravel() + step) - total(X.ravel() - step)) / 2e-5)
        assert report.optimality == pytest.approx(np.abs(gradient).max(), rel=1e-4, abs=2e-6)
        if max_iterations > 2:
            assert report.status is SolverStatus.CONVERGED
            assert report.optimality < 5e-6


def test_scipy_reaches_the_same_minimum() -> None:
    # Five frames in N = 10: both fragments see all of them, and nothing else is coupled to them.
    s = Scene(SMALL, 5)
    solution = small(PLAIN, 10).solve_and_forget(s) if False else None
    solver = FragmentSolver(SMALL, 10, PLAIN, SMALL_SENSORS)
    solution = solver.solve(s.start, s.seen, s.imus)

    def residuals(x: Array) -> Array:
        terms = planted.documented_residuals(
            x.reshape(5, -1, 3), s.start, s.seen, s.imus, SMALL, PLAIN, frames=10, sigma_px=8.0
        )
        return np.concatenate([r.ravel() for r in terms.values()])

    x0 = s.start.p_world_joint.ravel()
    peer = least_squares(residuals, x0, x_scale=0.1, ftol=1e-12, xtol=1e-12, gtol=1e-12)
    assert np.abs(peer.x - x0).max() > 0.02
    for report in solution.fragments:
        assert sum(report.energy.values()) == pytest.approx(2 * peer.cost, rel=1e-7)
    np.testing.assert_allclose(solution.poses.p_world_joint.ravel(), peer.x, atol=2e-5)
