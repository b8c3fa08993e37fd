"""What a fragment solver gives back: poses, and what happened to every fragment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import signals
from rtof_kin.core.numerics.levenberg_marquardt import Solved
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
_MISFIT, _LEAST_MISFIT_PX = 3.0, 3.0
"""Times the median size of residuals, and px, from which a fragment's are worth a warning."""
_LEAST_VISUAL = 5.0
"""[nats] of some twenty landmarks that are off as they are taken to be."""


class SolverStatus(Enum):
    """How a fragment's optimisation ended, best first."""

    CONVERGED = "The solver converged to its tolerance; see the optimality."
    ACCEPTABLE = (
        "The solver converged at a looser tolerance, where no step lowered the energy any further; see "
        "the optimality."
    )
    ITERATION_LIMIT = "The iteration limit was reached before the tolerance."
    UNOBSERVED = "No landmark and no sensor was seen in the whole fragment: it shows the prior alone."
    FAILED = "The solver gave up; the starting poses are returned for this fragment."

    @classmethod
    def of(cls, solved: Solved) -> Self:
        """How a solver ended that gave a state back."""
        if solved.converged:
            return cls.CONVERGED
        return cls.ITERATION_LIMIT if solved.out_of_iterations else cls.ACCEPTABLE


_OUTCOMES = {
    SolverStatus.CONVERGED: "converged",
    SolverStatus.ACCEPTABLE: "at a looser tolerance, where no step lowered the energy any further",
    SolverStatus.ITERATION_LIMIT: "stopped at the iteration limit",
    SolverStatus.UNOBSERVED: "saw nothing",
    SolverStatus.FAILED: "failed",
}


@dataclass(frozen=True)
class FragmentReport:
    """What happened to one fragment."""

    first_frame: int
    """Index of its first frame; negative where it begins in the padding."""
    status: SolverStatus
    energy: dict[str, float]
    """Weighted energy per term at the returned point."""
    iterations: int
    seconds: float
    """Time of the solver."""
    sigma_reprojection: float
    """Standard deviation of a landmark that was used, px; given, or estimated from the fragment."""
    optimality: float
    """Largest derivative of the energy at the returned point, measured there, 1/m or 1/rad; with
    constraints, of the Lagrangian."""
    infeasibility: float
    """Largest violation of a constraint there: of a squared bone length, m^2, or of a joint's limit, rad;
    0 without constraints."""

    @property
    def sees_enough(self) -> bool:
        """Whether landmarks count for something in it: where hardly one was seen, the size that they are
        taken to be off by is a default.
        """
        return self.energy["visual"] > _LEAST_VISUAL


@dataclass(frozen=True)
class Block:
    """Finished frames of a recording, N/2 at a time."""

    frames: slice
    """Which of the recording's they are."""
    p_world_joint: Array
    """(n, J, 3), m."""
    R_world_bone: Array
    """(n, J, 3, 3)."""
    fragments: tuple[FragmentReport, ...]
    """Reports that came in since the block before."""
    confidence: Confidence | None = None
    """Where it was asked for."""


@dataclass(frozen=True)
class FragmentSolution:
    """Optimised poses of a recording and how they came about."""

    poses: PoseSequence
    """Blended poses. In joint space rigid and with whole orientations; in Cartesian space positions as
    they were found, orientations from them, twist from the sensors."""
    fragments: tuple[FragmentReport, ...]
    """One report for every fragment."""
    confidence: Confidence | None = None
    """How well the poses are known by the Hessian alone, in joint space, where it was asked for: what
    lasts (biases, a sensor that slipped) is not in it, see `rtof_kin.solve.uncertainty.covariance_inflation`."""

    @property
    def status(self) -> SolverStatus:
        """The worst status of all fragments."""
        order = list(SolverStatus)
        return max((f.status for f in self.fragments), key=order.index)

    def count(self, status: SolverStatus) -> int:
        """Fragments that ended like this."""
        return sum(f.status is status for f in self.fragments)

    @property
    def outcome(self) -> str:
        """How many fragments ended how, in words."""
        converged, *others = ((self.count(status), text) for status, text in _OUTCOMES.items())
        parts = [f"{converged[0]} of {len(self.fragments)} fragments {converged[1]}"]
        return ", ".join([*parts, *(f"{count} {text}" for count, text in others if count)])

    @property
    def energy(self) -> dict[str, float]:
        """Mean over the fragments of each weighted energy term."""
        terms = self.fragments[0].energy
        return {t: float(np.mean([f.energy[t] for f in self.fragments])) for t in terms}

    @property
    def optimality(self) -> float:
        """Largest of the fragments' optimalities."""
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
    fragments: Sequence[FragmentReport], times: Array, frames: int, limit_px: float
) -> tuple[str, ...]:
    """Sentences about when joints lie far from where they were seen, at all or beside the rest of the
    recording: the pose there may be another one than was seen.

    Args:
        fragments: with sizes of residuals that were estimated. times: (T,) s of the recording.
        frames: N of a fragment. limit_px: that no size is taken to exceed.
    """
    solved = [f for f in fragments if f.status is not SolverStatus.UNOBSERVED]
    if not solved:
        return ()
    usual = float(np.median([f.sigma_reprojection for f in solved]))
    least = min(max(_MISFIT * usual, _LEAST_MISFIT_PX), limit_px)
    bad, size = np.zeros(len(times), dtype=bool), np.zeros(len(times))
    for f in solved:
        if f.sees_enough and f.sigma_reprojection >= least:
            own = slice(max(f.first_frame, 0), f.first_frame + frames)
            bad[own], size[own] = True, np.maximum(size[own], f.sigma_reprojection)
    return tuple(
        f"{times[a]:.1f} to {times[b - 1]:.1f} s: joints lie {size[a:b].max():.0f} px per axis from "
        f"where they were seen ({usual:.1f} is this recording's median); the pose may be wrong there, "
        "compare it with the video"
        for a, b in signals.runs(bad)
    )
