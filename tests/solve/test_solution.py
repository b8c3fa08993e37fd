"""Summary, status and warnings of a solution."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from rtof_kin.core.numerics.levenberg_marquardt import Solved
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.solution import FragmentReport, FragmentSolution, SolverStatus, misfits

POSES = PoseSequence(np.zeros(1), np.zeros((1, 1, 3)), np.eye(3)[None, None], ("Hips",))


def report(status: SolverStatus = SolverStatus.CONVERGED, k: float = 1.0) -> FragmentReport:
    return FragmentReport(
        first_frame=0,
        status=status,
        energy={"visual": k, "smooth": 2 * k},
        iterations=int(k),
        seconds=0.1 * k,
        sigma_reprojection=4.0,
        optimality=k,
        infeasibility=0.0,
    )


def test_a_solution_sums_up_its_fragments() -> None:
    solution = FragmentSolution(POSES, (report(k=1), report(k=6), report(k=2)))
    assert solution.iterations == 9
    assert solution.seconds == pytest.approx(0.9)
    assert solution.optimality == 6
    assert solution.energy == pytest.approx({"visual": 3.0, "smooth": 6.0})


@pytest.mark.parametrize("better, worse", list(pairwise(SolverStatus)))
def test_the_status_of_a_solution_is_its_worst_fragments(better: SolverStatus, worse: SolverStatus) -> None:
    reports = (report(better), report(worse), report(better), report())
    assert FragmentSolution(POSES, reports).status is worse


def test_the_outcome_counts_fragments_instead_of_naming_the_worst_alone() -> None:
    loose, failed = report(SolverStatus.ACCEPTABLE), report(SolverStatus.FAILED)
    outcome = FragmentSolution(POSES, (report(), loose, report(), loose, failed)).outcome
    assert outcome.startswith("2 of 5 fragments converged, 2 at a looser tolerance")
    assert outcome.endswith("1 failed")
    assert FragmentSolution(POSES, (report(), report())).outcome == "2 of 2 fragments converged"


def test_stalled_and_limited_solvers_have_different_status() -> None:
    stalled = Solved(np.zeros((1, 3)), 7, False, np.zeros((1, 0)))
    assert SolverStatus.of(stalled) is SolverStatus.ACCEPTABLE
    assert SolverStatus.of(replace(stalled, out_of_iterations=True)) is SolverStatus.ITERATION_LIMIT
    assert SolverStatus.of(replace(stalled, converged=True)) is SolverStatus.CONVERGED


def fitted(*sizes: float) -> tuple[str, ...]:
    """Warnings of fragments of ten frames, five apart, with residuals of these sizes, at 10 Hz."""
    firsts = range(-5, 5 * len(sizes), 5)
    reports = [
        replace(report(k=9.0), first_frame=first, sigma_reprojection=size)
        for first, size in zip(firsts, sizes, strict=False)
    ]
    return misfits(reports, np.arange(40) / 10, 10, 25.0, np.where(np.arange(40) < 25, 31.0, 2.0))


def test_fragments_with_larger_errors_cause_a_warning() -> None:
    (warning,) = fitted(0.5, 0.5, 0.6, 3.9, 12.5, 0.5, 0.5, 0.5, 0.5)
    assert warning.startswith(
        "1.0 to 2.4 s: joints lie 31 px from where they were seen, in the median (31 in the whole"
    )
    assert len(fitted(0.5, 4.0, 0.5, 0.5, 0.5, 0.5, 0.5, 9.0, 0.5)) == 2


def test_equal_errors_cause_a_warning_only_at_the_limit() -> None:
    assert fitted(4.0, 6.0, 9.0, 11.0, 5.0, 0.5, 4.0, 4.0, 5.0) == ()
    assert fitted(0.5, 0.5, 0.5, 2.9, 0.5, 0.5, 0.5, 0.5, 0.5) == ()
    (warning,) = fitted(*[25.0] * 9)
    assert warning.startswith("0.0 to 3.9 s")


def test_hardly_observed_fragments_cause_no_warning() -> None:
    reports = [replace(report(k=0.1), first_frame=5 * i - 5, sigma_reprojection=25.0) for i in range(9)]
    assert misfits(reports, np.arange(40) / 10, 10, 25.0, np.where(np.arange(40) < 25, 31.0, 2.0)) == ()
