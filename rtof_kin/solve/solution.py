"""Result of a fragment solver: poses, and a report of every fragment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Self

import numpy as np

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import Solved
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence

_MISFIT: Final = 3.0  #: Multiple of the median reprojection error from which a fragment causes a warning
_LEAST_MISFIT_PX: Final = 3.0  #: [px] Smallest reprojection error that causes a warning
_LEAST_VISUAL: Final = 5.0  #: [nats] Visual energy of about twenty landmarks with errors of one sigma


class SolverStatus(Enum):
    """How a fragment's optimisation ended, best first."""

    CONVERGED = "The solver converged to its tolerance; see the optimality."
    ACCEPTABLE = (
        "The solver converged at a looser tolerance, where no step lowered the energy any further; see the optimality."
    )
    ITERATION_LIMIT = "The iteration limit was reached before the tolerance."
    UNOBSERVED = "No landmark and no sensor has data in the whole fragment: the result is the prior."
    FAILED = "The solver failed; the initial poses are returned for this fragment."

    @classmethod
    def of(cls, solved: Solved) -> Self:
        """Return the status of a solver that returned a state."""
        if solved.converged:
            return cls.CONVERGED
        return cls.ITERATION_LIMIT if solved.out_of_iterations else cls.ACCEPTABLE


_OUTCOMES: Final = {
    SolverStatus.CONVERGED: "converged",
    SolverStatus.ACCEPTABLE: "at a looser tolerance, where no step lowered the energy any further",
    SolverStatus.ITERATION_LIMIT: "stopped at the iteration limit",
    SolverStatus.UNOBSERVED: "saw nothing",
    SolverStatus.FAILED: "failed",
}


@dataclass(frozen=True)
class FragmentReport:
    """Report of one fragment; everything is measured at the returned point."""

    first_frame: int  #: Index of its first frame; negative in the padding
    status: SolverStatus
    energy: dict[str, float]  #: Weighted energy per term; empty where nothing was solved
    iterations: int
    seconds: float  #: Time of the solver
    sigma_reprojection: float  #: Standard deviation of a landmark, given or estimated from the fragment, px
    optimality: float  #: Largest derivative of the energy, or with limits of the Lagrangian, 1/m or 1/rad
    infeasibility: float  #: Largest violation of a joint's limit, rad

    @property
    def sees_enough(self) -> bool:
        """Whether landmarks have weight in it; else the reprojection sigma is only a default."""
        return self.energy["visual"] > _LEAST_VISUAL


@dataclass(frozen=True)
class Block:
    """Final frames of a recording, N/2 at a time."""

    frames: slice  #: Of the recording
    p_world_joint: Array  #: (n, J, 3), m
    R_world_bone: Array  #: (n, J, 3, 3)
    fragments: tuple[FragmentReport, ...]  #: Reports since the previous block
    confidence: Confidence | None = None
    spread: Confidence | None = None
    """Covariances of what is unseen (`joint_space.covariance`); None where everything is seen."""


@dataclass(frozen=True)
class FragmentSolution:
    """Optimised poses of a recording with a report of every fragment."""

    poses: PoseSequence
    """Blended poses. In Cartesian space orientations follow from positions, with the sensors' twist."""
    fragments: tuple[FragmentReport, ...]
    confidence: Confidence | None = None
    """Covariances of the poses by the Hessian, in joint space, where asked for; not inflated for autocorrelated errors
    (see `uncertainty`)."""
    spread: Confidence | None = None
    """Covariances of what is unseen, by the pose prior (`joint_space.covariance`), to be added to the inflated ones;
    None where everything is seen."""

    @property
    def status(self) -> SolverStatus:
        """The worst status of all fragments."""
        return max((f.status for f in self.fragments), key=list(SolverStatus).index)

    def count(self, status: SolverStatus) -> int:
        """Return the number of fragments with a status."""
        return sum(f.status is status for f in self.fragments)

    @property
    def outcome(self) -> str:
        """Sentence with the number of fragments of each status."""
        converged, *others = ((self.count(status), text) for status, text in _OUTCOMES.items())
        parts = [f"{converged[0]} of {len(self.fragments)} fragments {converged[1]}"]
        return ", ".join([*parts, *(f"{count} {text}" for count, text in others if count)])

    @property
    def energy(self) -> dict[str, float]:
        """Mean over the solved fragments of each weighted energy term."""
        solved = [f.energy for f in self.fragments if f.energy]
        return {t: float(np.mean([energy[t] for energy in solved])) for t in solved[0]} if solved else {}

    @property
    def optimality(self) -> float:
        """Largest optimality of all fragments."""
        return max(f.optimality for f in self.fragments)

    @property
    def iterations(self) -> int:
        """Iterations of all fragments together."""
        return sum(f.iterations for f in self.fragments)

    @property
    def seconds(self) -> float:
        """Solver time of all fragments together, s."""
        return sum(f.seconds for f in self.fragments)


def misfits(
    fragments: Sequence[FragmentReport], times: Array, frames: int, limit_px: float, off_px: Array
) -> tuple[str, ...]:
    """Return warnings about intervals with large reprojection errors.

    Args:
        times: (T,) s of the recording. limit_px: upper bound of the estimates, px.
        off_px: (T,) median distance of the joints from their keypoints; NaN where unknown.
    """
    solved = [f for f in fragments if f.status is not SolverStatus.UNOBSERVED]
    if not solved:
        return ()
    usual = float(np.median([f.sigma_reprojection for f in solved]))
    least = min(max(_MISFIT * usual, _LEAST_MISFIT_PX), limit_px)
    bad = np.zeros(len(times), dtype=bool)
    for f in solved:
        if f.sees_enough and f.sigma_reprojection >= least:
            bad[max(f.first_frame, 0) : f.first_frame + frames] = True
    return tuple(
        f"{times[a]:.1f} to {times[b - 1]:.1f} s: joints lie {np.nanmedian(off_px[a:b]):.0f} px from where "
        f"they were seen, in the median ({np.nanmedian(off_px):.0f} in the whole recording); the pose may be "
        "wrong there, compare it with the video"
        for a, b in signals.runs(bad)
        if np.isfinite(off_px[a:b]).any()
    )
