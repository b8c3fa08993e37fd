"""Sensor study: accuracy of each angle when sensors are removed from a reconstruction.

First each sensor is omitted alone, then sensors are removed one after the other, the one with the smallest loss first,
down to none (without a camera, to one). Each set is compared with the full set, and with the reference if the
recording has one. A difference from the full set is not an error: errors that both share cancel. A sensor that stays
until late in this order is not proven to be needed: other sets of the same size may be equally good or better.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

import rtof_kin
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.angle_names import SECOND_SHOULDER, label
from rtof_kin.reporting.audit_results import Headline
from rtof_kin.reporting.clinical_findings import SECOND_PELVIS
from rtof_kin.reporting.sensor_study.accuracy import LONGEST, Part, SensorSet, liveliest_part, spread
from rtof_kin.reporting.sensor_study.runs import Progress, Runs

TOLERANCE: Final = np.radians(5.0)
"""[rad] largest RMS of an angle that is kept: differences beyond 5 degrees may mislead a clinical decision
(McGinley, Baker, Wolfe, Morris: Gait & Posture 29, 2009)."""
LEAST_SEEN: Final = 0.9  # smallest share of frames in which an angle that is kept is observed
MOST_GREEDY: Final = 8  # largest number of sensors for which the greedy search is the default
_FIRST: Final = 2  # sets of a step that are tried before others are compared with them
CLEARLY: Final = 2.0  # standard errors from which the losses of two sets differ clearly


@dataclass(frozen=True)
class SensorStudy:
    """Importance of each sensor of a recording."""

    recording: str
    part: Part  #: What was studied of it
    segments: dict[str, str]  #: Sensor -> segment that carries it
    places: dict[str, str]  #: The same in words, e.g. 'left shank'.
    angles: tuple[str, ...]  #: A names of the angles that the full set observes
    moved: Array  #: (A,) rad, standard deviation of each angle over time, of the reference or the full set
    full: SensorSet
    steps: tuple[tuple[SensorSet, ...], ...]
    """Sets that were tried at each removal; the first ones omit each sensor alone."""
    has_truth: bool  #: Whether the recording has a reference, so that there are errors
    camera: bool  #: Whether there are keypoints
    verdict: Headline  #: On the reconstruction with the full set
    choices: dict[str, Any]  #: How it was made, as JSON values

    @property
    def without(self) -> tuple[SensorSet, ...]:
        """Each sensor omitted alone, in the order of the sensors."""
        return self.steps[0]

    @property
    def path(self) -> tuple[SensorSet, ...]:
        """From the full set down, with one sensor fewer each."""
        return (self.full, *map(_least, self.steps))

    @property
    def runs(self) -> int:
        """Number of reconstructions."""
        return 1 + sum(map(len, self.steps))

    @property
    def shown(self) -> tuple[int, ...]:
        """Indices of the angles without those of a joint in a second sequence, which only the table has."""
        second = (SECOND_PELVIS, SECOND_SHOULDER)
        return tuple(a for a, name in enumerate(self.angles) if not any(part in name for part in second))

    def measure(self, found: SensorSet) -> Array:
        """Return (A,) rad: errors if there is a reference, else differences from the full set."""
        return found.error if self.has_truth else found.difference

    def kept(self, found: SensorSet, tolerance: float = TOLERANCE) -> Mask:
        """Return (A,) whether angles are observed and within the tolerance, rad."""
        return np.asarray((found.seen >= LEAST_SEEN) & (self.measure(found) <= tolerance))

    def fewest(self, angle: str, tolerance: float = TOLERANCE) -> SensorSet | None:
        """Return the smallest set of the path up to which an angle is kept throughout; None for none."""
        a, last = self.angles.index(angle), None
        for found in self.path:
            if not self.kept(found, tolerance)[a]:
                break
            last = found
        return last

    def as_good(self, step: int) -> tuple[str, ...]:
        """Return the sensors whose removal at a step was not clearly worse than that of the one removed."""
        best = _least(self.steps[step])
        return tuple(
            omitted(found, self.path[step].sensors)
            for found in self.steps[step]
            if found is not best and not found.loss - best.loss > CLEARLY * found.scatter(best)
        )


def _least(tried: Sequence[SensorSet]) -> SensorSet:
    return min(tried, key=lambda found: found.loss)


def omitted(found: SensorSet, sensors: Sequence[str]) -> str:
    """Return the first of some sensors that a set does not have."""
    return next(name for name in sensors if name not in found.sensors)


def number_of_runs(sensors: int, camera: bool = True, greedy: bool | None = None) -> int:
    """Return the largest number of reconstructions of a study; a greedy one usually needs fewer."""
    steps = sensors if camera else sensors - 1
    if _is_greedy(sensors, greedy):
        return 1 + sum(sensors - step for step in range(steps))
    return 1 + sensors + max(steps - 1, 0)


def study_sensors(
    recording: Recording,
    *,
    greedy: bool | None = None,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    longest: float = LONGEST,
    folder: Path | None = None,
    workers: int | None = 1,
    progress: Progress | None = None,
) -> SensorStudy:
    """Reconstruct a recording with all sensors, without each of them, and with fewer and fewer.

    The recording is not calibrated; apply `SelfCalibration.apply` with all sensors before, if wanted.
    `InvalidInputError`: there are no sensors, or only one and no camera; `longest` is not positive. `RtofError`: a run
    failed; the others are saved.

    Args:
        recording: with calibrated IMUs, with or without keypoints.
        greedy: whether each removal tries the remaining sensors, at most n (n + 1) / 2 + 1 runs in all; else
            sensors are removed in the order of their loss when omitted alone. Default: up to `MOST_GREEDY`
            sensors. A set is not tried where a larger one has a larger loss than the best set of this size:
            that a set is no better than a larger one is assumed.
        lifter, settings: as for `reconstruct`.
        longest: s; of a longer recording, the part with the most movement is studied.
        folder: where each run is saved; runs that it has are not repeated, so it must be one that
            `rtof_kin.core.jobs.open_runs` made for this recording and these settings. None: nothing is saved.
        workers: processes, see `rtof_kin.core.jobs.run_jobs`. progress: see `runs.Progress`.
    """
    _check_removable(recording)
    imus, bone_imus, camera = recording.imus, recording.bone_imus(), recording.keypoints is not None
    assert imus is not None
    assert bone_imus is not None
    part = liveliest_part(recording, longest)
    settings = settings or ReconstructionSettings()
    settings = replace(settings, sensor_joints=(*settings.sensor_joints, *bone_imus.joints))
    names = imus.names
    with TemporaryDirectory() if folder is None else nullcontext(folder) as place:
        most = number_of_runs(len(names), camera, greedy)
        runs = Runs(part.of(recording), lifter, settings, most, Path(place), workers, progress)
        full = runs.full()
        steps = _steps(runs, full.accuracy, 0 if camera else 1, _is_greedy(len(names), greedy))
    segments = dict(zip(names, bone_imus.joints, strict=True))
    words = {joint: label(name) for name, joint in angle_table(recording.skeleton.table).segments.items()}
    places = {sensor: words.get(joint, joint) for sensor, joint in segments.items()}
    reference = full.angles if full.truth is None else full.truth
    measured = full.angles.names, spread(reference), full.accuracy, steps, full.truth is not None
    return SensorStudy(recording.name, part, segments, places, *measured, camera, full.verdict, full.choices)


def identity_of(
    recording: Recording, lifter: LifterLike | None, settings: ReconstructionSettings, longest: float
) -> dict[str, Any]:
    """Return everything that the runs of a study depend on, as plain values for `open_runs`. `InvalidInputError`: see
    `study_sensors`.
    """
    _check_removable(recording)
    part = liveliest_part(recording, longest)
    return {
        "command": "study",
        "version": rtof_kin.__version__,
        "recording": recording.digest(),
        "lifter": getattr(lifter, "sha256", None),
        "settings": repr(settings),
        "part_s": [part.start, part.stop],
    }


def _check_removable(recording: Recording) -> None:
    """Raise where a recording has no sensor to omit."""
    if recording.imus is None:
        raise InvalidInputError(f"recording {recording.name}: has no IMUs, so there is nothing to omit")
    if recording.keypoints is None and len(recording.imus.names) < 2:
        raise InvalidInputError(
            f"recording {recording.name}: has one sensor and no camera, so there is nothing to omit"
        )


def _steps(runs: Runs, full: SensorSet, least: int, greedy: bool) -> tuple[tuple[SensorSet, ...], ...]:
    """Sets tried at each removal, down to the least number of sensors."""
    names = full.sensors
    without = runs.measured([_less(names, name) for name in names], "each sensor omitted alone")
    if not greedy:
        order = [omitted(found, names) for found in sorted(without, key=lambda found: found.loss)]
        sets = [tuple(n for n in names if n not in order[:k]) for k in range(2, len(names) - least + 1)]
        return (without, *((found,) for found in runs.measured(sets, "in the order of their loss alone")))
    steps = [without]
    while len(left := _least(steps[-1]).sensors) > least:
        runs.expect(sum(range(least + 1, len(left) + 1)))
        steps.append(_greedy_step(runs, left, [full, *chain(*steps)]))
    return tuple(steps)


def _greedy_step(runs: Runs, left: tuple[str, ...], tried: Sequence[SensorSet]) -> tuple[SensorSet, ...]:
    """Sets with one sensor less, the most promising ones first, but those that a larger set shows to be worse;
    the number of processes does not matter to which sets are tried.
    """

    def bound(sensors: tuple[str, ...]) -> float:
        return max(found.loss for found in tried if {*sensors} < {*found.sensors})

    what = f"{len(left)} sensors left, which one is removed"
    sets = sorted((_less(left, name) for name in left), key=bound)
    first = runs.measured(sets[:_FIRST], what)
    better = [sensors for sensors in sets[_FIRST:] if bound(sensors) < _least(first).loss]
    return (*first, *runs.measured(better, what))


def _is_greedy(sensors: int, greedy: bool | None) -> bool:
    return sensors <= MOST_GREEDY if greedy is None else greedy


def _less(names: Sequence[str], one: str) -> tuple[str, ...]:
    return tuple(name for name in names if name != one)
