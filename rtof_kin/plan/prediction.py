"""Expected errors of the clinical angles of a planned recording.

The planned recording is simulated with the errors of a real detector and of real sensors, and solved by the same
energy as a real one. The standard deviations stated are those of its information matrix, the Gauss-Newton Hessian at
the optimum, widened for autocorrelated errors exactly as those of a real recording (`CovarianceInflation`). The
differences from the planned movement check them: a Monte-Carlo estimate of the same errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Self

import numpy as np

from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.jobs import JobResult, run_jobs
from rtof_kin.data.confidence import BAND_95
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct, without_warnings
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings

Progress = Callable[[int, int, str], None]
"""Called with (simulated recordings done, in all, the last one)."""
LEAST_SEEN: Final = 0.5
"""Share of the frames below which an angle counts as unobserved."""
SETTINGS: Final = ReconstructionSettings(
    checks=False, sensor_joints=tuple(joint for joint, _ in SkeletonModel.default().sensors.values())
)
"""All setups share one compilation of the energy."""


@dataclass(frozen=True)
class Prediction:
    """Expected errors of A clinical angles."""

    names: tuple[str, ...]
    sigma: Array
    """(A,) rad, root mean square over the movement of the standard deviations stated; NaN if unobserved."""
    error: Array
    """(A,) rad, root mean square difference from the planned movement in the simulations."""
    inside: Array
    """(A,) share of the differences inside the 95 % bands."""
    observed: Array
    """(A,) share of the frames in which the angle is observed."""
    draws: int
    """Simulated recordings."""

    @classmethod
    def of(cls, results: Sequence[Mapping[str, Array]], names: tuple[str, ...]) -> Self:
        """Return the prediction of several simulations, arrays of `measure`."""
        total = {key: np.sum([r[key] for r in results], axis=0) for key in results[0]}
        observed = total["known"] / total["frames"]
        with np.errstate(invalid="ignore", divide="ignore"):
            enough = np.where(observed >= LEAST_SEEN, 1.0, np.nan)
            mean = {key: enough * total[key] / total["known"] for key in ("variance", "square", "inside")}
        return cls(names, np.sqrt(mean["variance"]), np.sqrt(mean["square"]), mean["inside"], observed, len(results))

    def select(self, names: Sequence[str]) -> Self:
        """Return the prediction of some angles, in the order given."""
        columns = [self.names.index(name) for name in names]
        arrays = {key: getattr(self, key)[columns] for key in ("sigma", "error", "inside", "observed")}
        return replace(self, names=tuple(names), **arrays)

    def loss(self, unobserved: Array) -> float:
        """Return the mean standard deviation over the angles, rad.

        Args:
            unobserved: (A,) rad, counted for an angle that is unobserved.
        """
        return float(np.mean(np.where(np.isfinite(self.sigma), self.sigma, unobserved)))


@dataclass(frozen=True)
class Run:
    """One simulated recording, the argument of `measure`."""

    setup: Setup
    seed: int
    lifter: LifterLike | None = None


def measure(run: Run) -> JobResult:
    """Simulate and reconstruct a planned recording, and sum up the errors of its angles."""
    recording = run.setup.recorded(run.seed)
    with without_warnings():
        result = reconstruct(recording, mode=run.setup.mode, lifter=run.lifter, settings=SETTINGS, calibrate=False)
    found, off = angles_and_errors(result)
    assert found.sigma is not None
    known = found.known & np.isfinite(off + found.sigma)
    arrays = {
        "known": known.sum(axis=0).astype(float),
        "frames": np.full(known.shape[1], float(len(known))),
        "variance": np.sum(np.where(known, found.sigma, 0.0) ** 2, axis=0),
        "square": np.sum(np.where(known, off, 0.0) ** 2, axis=0),
        "inside": np.sum(known & (np.abs(off) <= BAND_95 * found.sigma), axis=0).astype(float),
    }
    return JobResult({"angles": list(found.names)}, arrays)


def angles_and_errors(result: Reconstruction) -> tuple[ClinicalAngles, Array]:
    """Return the angles of a simulated recording and their errors (T, A), rad; NaN where unknown."""
    found, truth = clinical_angles(result.motion), result.recording.truth
    assert truth is not None
    seen = all_observed(at_times(truth, result.motion.times))
    off = found.values - clinical_angles(seen, result.motion.skeleton).values
    return found, (off + np.pi) % (2 * np.pi) - np.pi


def predict(
    setups: Mapping[str, Setup],
    draws: int = 2,
    seed: int = 0,
    *,
    lifter: LifterLike | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Prediction | str]:
    """Predict the errors of several setups with the same draws of detector and sensors.

    Args:
        draws: simulated recordings of each. seed: of the first. lifter: as for `reconstruct`.
        workers: processes, one per core if None.

    Returns:
        The prediction of each setup, or why there is none, such as a person out of view.
    """
    if draws < 1:
        raise InvalidInputError(f"plan: {draws} draws; at least one simulated recording is needed")
    jobs = {
        f"{name}-{draw}": Run(setup, seed + draw, lifter) for name, setup in setups.items() for draw in range(draws)
    }
    with TemporaryDirectory() as folder:
        outcome = run_jobs(measure, jobs, Path(folder), workers, progress)
        out: dict[str, Prediction | str] = {}
        for name in setups:
            keys = [f"{name}-{draw}" for draw in range(draws)]
            failed = [outcome.failed[key] for key in keys if key in outcome.failed]
            if failed:
                out[name] = failed[0]
                continue
            names = tuple(outcome.done[keys[0]]["angles"])
            out[name] = Prediction.of([outcome.arrays(key) for key in keys], names)
    return out
