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
from typing import Any, Final, Self

import numpy as np

from rtof_kin.body.metrics import at_times
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.environment import without_warnings
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.jobs import JobResult, run_jobs
from rtof_kin.data.confidence import BAND_95
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

Progress = Callable[[int, int, str], None]  #: Called with (simulated recordings done, in all, the last one)
LEAST_SEEN: Final = 0.5  #: Share of the frames below which an angle counts as unobserved
SETTINGS: Final = ReconstructionSettings(
    checks=False, sensor_joints=tuple(joint for joint, _ in SkeletonModel.default().sensors.values())
)
"""All setups share one compilation of the energy."""


@dataclass(frozen=True)
class Prediction:
    """Expected errors of A clinical angles."""

    names: tuple[str, ...]
    sigma: Array  #: (A,) rad, root mean square over the movement of the standard deviations stated; NaN if unobserved
    error: Array  #: (A,) rad, root mean square difference from the planned movement in the simulations
    inside: Array  #: (A,) share of the differences inside the 95 % bands
    observed: Array  #: (A,) share of the frames in which the angle is observed
    draws: int  #: Simulated recordings

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


@dataclass(frozen=True)
class Run:
    """One simulated recording, the argument of `measure`."""

    setup: Setup
    seed: int
    lifter: LifterLike | None = None
    seconds: float = np.inf  #: [s] from its start that are calibrated by `calibration_time`


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
    """Predict the errors of several setups with the same draws of detector and sensors, `draws` from `seed` on.

    Returns the prediction of each setup, or why there is none, such as a person out of view.
    """
    if draws < 1:
        raise InvalidInputError(f"plan: {draws} draws; at least one simulated recording is needed")
    jobs = {f"{name}-{i}": Run(setup, seed + i, lifter) for name, setup in setups.items() for i in range(draws)}
    out: dict[str, Prediction | str] = {}
    with TemporaryDirectory() as folder:
        outcome = run_jobs(measure, jobs, Path(folder), workers, progress)
        for name in setups:
            keys = [f"{name}-{draw}" for draw in range(draws)]
            if failed := [outcome.failed[key] for key in keys if key in outcome.failed]:
                out[name] = failed[0]
            else:
                names = tuple(outcome.done[keys[0]]["angles"])
                out[name] = Prediction.of([outcome.arrays(key) for key in keys], names)
    return out


SECONDS: Final = (5.0, 10.0, 20.0, 30.0)  #: Lengths that are tried
PLANTED: Final = {"delay": 0.04, "heading": np.radians(10.0), "mounting": np.radians(8.0)}
"""Standard deviations before the calibration: s; rad; rad per axis across the bone."""
ENOUGH: Final = {"delay": 0.01, "heading": np.radians(5.0), "mounting": np.radians(5.0)}
"""Standard deviations, s and rad, with which a quantity counts as observed."""
UNITS: Final = {"delay": (1e3, "ms"), "heading": (180 / np.pi, "deg"), "mounting": (180 / np.pi, "deg")}
"""Factor and unit for display."""
_PRIORS: Final = CalibrationPriors(
    sigma_delay=PLANTED["delay"],
    sigma_heading=PLANTED["heading"],
    sigma_swing=PLANTED["mounting"],
    sigma_twist=PLANTED["mounting"],
    most_seconds=SECONDS[-1],
)


@dataclass(frozen=True)
class CalibrationTime:
    """Standard deviations of the calibration by the length of the movement; n lengths."""

    seconds: Array  #: (n,) s
    sigma: dict[str, Array]  #: Kind of `PLANTED` -> (n,) stated, s or rad; of sensors the root mean square
    error: dict[str, Array]  #: The same of the errors that are left in the simulations

    def needed(self, kind: str) -> float | None:
        """Return the shortest length, s, from which on a kind of `PLANTED` is observed, by statement and simulation."""
        good = np.maximum(self.sigma[kind], self.error[kind]) <= ENOUGH[kind]
        later = np.flatnonzero(~good)
        first = int(later[-1]) + 1 if len(later) else 0
        return float(self.seconds[first]) if first < len(good) else None

    @property
    def words(self) -> str:
        """How long to move, and what stays unobserved."""
        needed = {kind: self.needed(kind) for kind in self.sigma}
        times = [time for time in needed.values() if time is not None]
        never = [kind for kind, time in needed.items() if time is None]
        if not never:
            *others, last = needed
            kinds = f"{', '.join(others)} and {last}"
            return f"Move for at least {max(times):.0f} s, for the calibration to observe {kinds}."
        worst = {kind: UNITS[kind][0] * max(self.sigma[kind][-1], self.error[kind][-1]) for kind in never}
        left = ", ".join(f"{kind} ({value:.0f} {UNITS[kind][1]} left)" for kind, value in worst.items())
        return (
            f"{self.seconds[-1]:.0f} s of this movement do not let the calibration observe {left}: add the "
            "movement 'calibration', or calibrate by a pose."
        )


def calibration_time(
    setup: Setup,
    draws: int = 2,
    seed: int = 0,
    *,
    lifter: LifterLike | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> CalibrationTime:
    """Return how well lengths of a movement, `draws` recordings of each, calibrate the sensors; lengths beyond the
    movement of the setup are left out. `InvalidInputError`: there are no sensors, or the movement is too short;
    `RtofError`: no simulated recording could be calibrated.
    """
    if not setup.sensors:
        raise InvalidInputError("plan: without sensors there is nothing to calibrate")
    longest = float(min(setup.poses.times[-1] - setup.poses.times[0], SECONDS[-1]))
    lengths = [*(seconds for seconds in SECONDS if seconds < longest), longest]
    jobs = {f"{s:g}-{i}": Run(setup, seed + i, lifter, s) for s in lengths for i in range(draws)}
    rows: list[dict[str, Array]] = []
    with TemporaryDirectory() as folder:
        outcome = run_jobs(_measure, jobs, Path(folder), workers, progress)
        for seconds in lengths:
            arrays = [outcome.arrays(key) for key in outcome.done if key.startswith(f"{seconds:g}-")]
            if not arrays:
                problem = next(iter(outcome.failed.values()))
                raise RtofError(f"plan: no simulated recording could be calibrated: {problem}")
            rows.append({name: np.sqrt(np.mean([a[name] for a in arrays])) for name in arrays[0]})
    sigma = {kind: np.array([row[kind] for row in rows]) for kind in PLANTED}
    error = {kind: np.array([row[f"{kind} error"] for row in rows]) for kind in PLANTED}
    return CalibrationTime(np.array(lengths), sigma, error)


def _measure(run: Run) -> JobResult:
    """Mean squares of the standard deviations stated, and of the errors left."""
    poses = run.setup.poses
    poses = poses[: int(np.searchsorted(poses.times, poses.times[0] + run.seconds - 1e-9)) + 1]
    true = replace(run.setup, poses=poses).recorded(run.seed, late=False)
    wrong = planted(true, run.seed)
    with without_warnings():
        found = calibrate_recording(wrong, priors=_PRIORS, lifter=run.lifter, settings=SETTINGS)
    corrected = found.apply(wrong)
    arrays: dict[str, Any] = {}
    for kind in PLANTED:
        own = [q.sigma if kind == "mounting" else q.sigma[:1] for q in found.quantities if q.kind == kind]
        arrays[kind] = np.mean([np.mean(sigma**2) for sigma in own])
    return JobResult({}, arrays | {f"{kind} error": v for kind, v in _left(corrected, true).items()})


def planted(recording: Recording, seed: int) -> Recording:
    """Return a recording whose clock and sensors are off as those of a first attempt are."""
    assert recording.calibration is not None
    assert recording.imus is not None
    rng, own = np.random.default_rng([seed, 27]), recording.calibration
    S = len(own.sensors)
    late = float(np.clip(PLANTED["delay"] * rng.standard_normal(), -2 * PLANTED["delay"], 2 * PLANTED["delay"]))
    heading = so3.exp(PLANTED["heading"] * rng.standard_normal((S, 1)) * [0.0, 0.0, 1.0])
    mounting = so3.exp(PLANTED["mounting"] * rng.standard_normal((S, 3)))
    wrong = replace(own, R_world_inertial=heading @ own.R_world_inertial, R_sensor_bone=own.R_sensor_bone @ mounting)
    keypoints = recording.video.on_clock(recording.video.times + late)
    return replace(recording, keypoints=keypoints, calibration=wrong, truth=None)


def _left(found: Recording, true: Recording) -> dict[str, Array]:
    """Mean squares of what is left of the errors."""
    assert found.calibration is not None
    assert true.calibration is not None
    a, b = found.calibration, true.calibration
    turned = so3.log(a.R_world_inertial @ np.swapaxes(b.R_world_inertial, -1, -2))
    mounted = so3.log(np.swapaxes(b.R_sensor_bone, -1, -2) @ a.R_sensor_bone)
    late = found.video.times[0] - true.video.times[0]
    return {"delay": np.square(late), "heading": np.mean(turned[:, 2] ** 2), "mounting": np.mean(mounted**2)}
