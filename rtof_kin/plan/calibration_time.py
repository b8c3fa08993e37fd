"""How long to move until delay, headings and mountings of the sensors are observed.

Recordings of a movement, cut to several lengths, are simulated with the errors that sensors put on by hand
have, and calibrated from their own motion as a real recording is. Stated are the standard deviations of the
calibration's information matrix; the errors planted in the simulations check them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, RtofError
from rtof_kin.core.jobs import JobResult, run_jobs
from rtof_kin.plan.prediction import SETTINGS, Progress
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import without_warnings
from rtof_kin.reconstruction.self_calibration import calibrate_recording
from rtof_kin.recording.recording import Recording

SECONDS: Final = (5.0, 10.0, 20.0, 30.0)
"""Lengths that are tried."""
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

    seconds: Array
    """(n,) s."""
    sigma: dict[str, Array]
    """Kind of `PLANTED` -> (n,) stated, s or rad; of sensors the root mean square."""
    error: dict[str, Array]
    """The same of the errors that are left in the simulations."""

    def needed(self, kind: str) -> float | None:
        """Return the shortest length, s, from which on a kind is observed, by statement and simulation.

        Args:
            kind: of `PLANTED`.
        """
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
            return f"Move for at least {max(times):.0f} s, for the calibration to observe {_listed(needed)}."
        left = ", ".join(f"{kind} ({_value(kind, self._worst(kind))} left)" for kind in never)
        return (
            f"{self.seconds[-1]:.0f} s of this movement do not let the calibration observe {left}: add the "
            "movement 'calibration', or calibrate by a pose."
        )

    def _worst(self, kind: str) -> float:
        """The larger of what is stated and what is left after the longest movement."""
        return float(max(self.sigma[kind][-1], self.error[kind][-1]))


@dataclass(frozen=True)
class _Run:
    setup: Setup
    seconds: float
    seed: int
    lifter: LifterLike | None


def calibration_time(
    setup: Setup,
    draws: int = 2,
    seed: int = 0,
    *,
    lifter: LifterLike | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> CalibrationTime:
    """Return how well lengths of a movement calibrate the sensors.

    Args:
        setup: with the movement; lengths beyond it are left out. draws: simulated recordings of each length.
        seed: of the first. lifter: as for `reconstruct`. workers: processes, one per core if None.

    Raises:
        InvalidInputError: there are no sensors, or the movement is too short. RtofError: no simulated
            recording could be calibrated.
    """
    if not setup.sensors:
        raise InvalidInputError("plan: without sensors there is nothing to calibrate")
    longest = setup.poses.times[-1] - setup.poses.times[0]
    lengths = [s for s in SECONDS if s < longest] + [float(min(longest, SECONDS[-1]))]
    lengths = list(dict.fromkeys(lengths))
    jobs = {
        f"{i}-{draw}": _Run(setup, seconds, seed + draw, lifter)
        for i, seconds in enumerate(lengths)
        for draw in range(draws)
    }
    with TemporaryDirectory() as folder:
        outcome = run_jobs(_measure, jobs, Path(folder), workers, progress)
        rows: list[dict[str, Array]] = []
        for i in range(len(lengths)):
            keys = [f"{i}-{draw}" for draw in range(draws) if f"{i}-{draw}" in outcome.done]
            if not keys:
                problem = next(iter(outcome.failed.values()))
                raise RtofError(f"plan: no simulated recording could be calibrated: {problem}")
            arrays = [outcome.arrays(key) for key in keys]
            rows.append({name: np.sqrt(np.mean([a[name] for a in arrays])) for name in arrays[0]})
    sigma = {kind: np.array([row[kind] for row in rows]) for kind in PLANTED}
    error = {kind: np.array([row[f"{kind} error"] for row in rows]) for kind in PLANTED}
    return CalibrationTime(np.array(lengths), sigma, error)


def _measure(run: _Run) -> JobResult:
    """Mean squares of the standard deviations stated, and of the errors left."""
    poses = run.setup.poses
    poses = poses[: int(np.searchsorted(poses.times, poses.times[0] + run.seconds - 1e-9)) + 1]
    true = replace(run.setup, poses=poses).recorded(run.seed, late=False)
    wrong = planted(true, run.seed)
    with without_warnings():
        found = calibrate_recording(wrong, priors=_PRIORS, lifter=run.lifter, settings=SETTINGS)
    corrected = found.apply(wrong)
    arrays: dict[str, Any] = {
        kind: np.mean(
            [
                np.mean(q.sigma[:1] ** 2 if kind != "mounting" else q.sigma**2)
                for q in found.quantities
                if q.kind == kind
            ]
        )
        for kind in PLANTED
    }
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


def _value(kind: str, value: float) -> str:
    factor, unit = UNITS[kind]
    return f"{factor * value:.0f} {unit}"


def _listed(kinds: Sequence[str] | dict[str, Any]) -> str:
    *others, last = kinds
    return f"{', '.join(others)} and {last}"
