"""How many sensors does a protocol need? The reconstruction, rerun with sensors removed, angle by angle.

First each sensor alone is left out, then one after the other the one that is missed least, down to none
(without a camera, to the last). What a set of sensors gives is compared with what all of them give, and
with the truth where the recording has one. **A difference from the full set is no error**: the full set
errs too, and where it errs together with a smaller set nobody sees it. And an order of removal is one way
down: other sets of the same size may do as well or better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core import signals
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.report.sensor_study.sensor_sets import SensorSet, measured

Array = NDArray[np.float64]
TOLERANCE = np.radians(5.0)
"""rad within which an angle counts as kept: differences beyond 5 degrees may mislead a clinical decision
(McGinley, Baker, Wolfe, Morris: Gait & Posture 29, 2009)."""
LEAST_SEEN = 0.9
"""Share of the frames in which an angle that is kept must be seen."""
MOST_GREEDY = 8
"""Sensors up to which every removal is tried at every step where nobody says how."""


@dataclass(frozen=True)
class SensorStudy:
    """What every sensor of a recording is worth."""

    recording: str
    segments: dict[str, str]
    """Sensor -> segment that carries it."""
    angles: tuple[str, ...]
    """A clinical names: those that the full set sees at least at times."""
    full: SensorSet
    without: tuple[SensorSet, ...]
    """Each sensor left out alone, in the order of the sensors."""
    path: tuple[SensorSet, ...]
    """From the full set down, one sensor fewer each."""
    has_truth: bool
    """Whether the recording has a truth, so that there are errors."""
    reconstruction: Reconstruction
    """By the full set."""

    def measure(self, found: SensorSet) -> Array:
        """(A,) rad: errors where there are some, else differences from the full set."""
        return found.error if self.has_truth else found.difference

    def kept(self, found: SensorSet, tolerance: float = TOLERANCE) -> NDArray[np.bool_]:
        """(A,) whether angles are seen, and within the tolerance of the truth, or of the full set."""
        return np.asarray((found.seen >= LEAST_SEEN) & (self.measure(found) <= tolerance))

    def fewest(self, angle: str, tolerance: float = TOLERANCE) -> SensorSet | None:
        """The last set on the way down up to which an angle was kept all along; None where it is not even
        with all sensors.
        """
        a, last = self.angles.index(angle), None
        for found in self.path:
            if not self.kept(found, tolerance)[a]:
                break
            last = found
        return last


def number_of_runs(sensors: int, camera: bool = True, greedy: bool | None = None) -> int:
    """Reconstructions that a study of so many sensors takes.

    Args:
        sensors: how many. camera: whether there are keypoints, and so a run without any sensor.
        greedy: as for `study_sensors`.
    """
    steps = sensors if camera else sensors - 1
    if _is_greedy(sensors, greedy):
        return 1 + sum(sensors - step for step in range(steps)) if steps else 1
    return 1 + sensors + max(steps - 1, 0)


def study_sensors(
    recording: Recording,
    *,
    greedy: bool | None = None,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> SensorStudy:
    """Reconstruct a recording with all its sensors, without each of them, and with fewer and fewer.

    The recording is taken as it is: to study one that is calibrated from itself, calibrate it first with
    all sensors (`SelfCalibration.apply`).

    Args:
        recording: with calibrated IMUs, and keypoints or not.
        greedy: whether each step down tries every sensor that is left, n (n + 1) / 2 runs in all; else
            they go in the order in which they are missed when left out alone. Where not given: up to
            `MOST_GREEDY` sensors.
        lifter, settings: as for `reconstruct`; the problem is compiled once for all sets of sensors.
        progress: told ("study", runs done, runs in all).

    Raises:
        ShapeError: there are no sensors; only one, and no camera. Errors of `reconstruct` pass through.
    """
    imus = recording.imus
    if imus is None:
        raise ShapeError(f"recording {recording.name}: has no IMUs, so there is nothing to leave out")
    camera = recording.keypoints is not None
    if not camera and len(imus.names) < 2:
        raise ShapeError(f"recording {recording.name}: with one sensor and no camera nothing can be left out")
    total = number_of_runs(len(imus.names), camera, greedy)
    bone_imus = recording.bone_imus()
    assert bone_imus is not None
    settings = settings or ReconstructionSettings()
    settings = replace(settings, sensor_joints=(*settings.sensor_joints, *bone_imus.joints))
    runs = _Runs(recording, lifter, settings, progress, total)
    full = runs.of(imus.names)
    without = tuple(runs.of(_less(imus.names, name)) for name in imus.names)
    path = _way_down(runs, full, without, 0 if camera else 1, _is_greedy(len(imus.names), greedy))
    assert runs.reconstruction is not None
    return SensorStudy(
        recording.name, dict(zip(imus.names, bone_imus.joints, strict=True)), runs.angles, full, without,
        path, recording.truth is not None, runs.reconstruction,
    )  # fmt: skip


def _is_greedy(sensors: int, greedy: bool | None) -> bool:
    return sensors <= MOST_GREEDY if greedy is None else greedy


def _less(names: Sequence[str], left_out: str) -> tuple[str, ...]:
    return tuple(name for name in names if name != left_out)


def _way_down(
    runs: _Runs, full: SensorSet, without: tuple[SensorSet, ...], fewest: int, greedy: bool
) -> tuple[SensorSet, ...]:
    """From the full set to the fewest sensors; its first step is the best of those without one."""
    path = [full, min(without, key=lambda found: found.loss)]
    missed = dict(zip(full.sensors, (found.loss for found in without), strict=True))
    while len(path[-1].sensors) > fewest:
        left = path[-1].sensors
        tried = left if greedy else (min(left, key=lambda name: missed[name]),)
        path.append(min((runs.of(_less(left, name)) for name in tried), key=lambda found: found.loss))
    return tuple(path)


class _Runs:
    """Reconstructions of one recording with some of its sensors, measured against the first of them."""

    def __init__(
        self, recording: Recording, lifter: LifterLike | None, settings: ReconstructionSettings,
        progress: Callable[[str, int, int], None] | None, total: int,
    ) -> None:  # fmt: skip
        self.recording, self.lifter, self.settings = recording, lifter, settings
        self.progress, self.done, self.total = progress or (lambda stage, done, total: None), 0, total
        self.reconstruction: Reconstruction | None = None
        self.full: ClinicalAngles | None = None
        self.truth: ClinicalAngles | None = None
        self.angles: tuple[str, ...] = ()

    def of(self, sensors: Sequence[str]) -> SensorSet:
        """What these sensors give; the first set asked for is the full one."""
        self.progress("study", self.done, self.total)
        angles = self._angles(tuple(sensors))
        if self.full is None:
            self.angles = tuple(np.array(angles.names)[angles.known.any(axis=0)].tolist())
            self.full = angles.select(self.angles)
            self.truth = _true_angles(self.recording, self.full)
        self.done += 1
        self.progress("study", self.done, self.total)
        return measured(tuple(sensors), angles.select(self.angles), self.full, self.truth)

    def _angles(self, sensors: tuple[str, ...]) -> ClinicalAngles:
        imus = self.recording.imus
        assert imus is not None
        if sensors:
            recording = replace(self.recording, imus=imus.select(sensors))
            mode: Mode = "rtof" if recording.keypoints is not None else "imu"
        else:
            recording, mode = replace(self.recording, imus=None, calibration=None), "rto"
        result = reconstruct(
            recording, mode=mode, lifter=self.lifter, settings=self.settings, calibrate=False
        )
        self.reconstruction = self.reconstruction or result
        return clinical_angles(result.motion)


def _true_angles(recording: Recording, like: ClinicalAngles) -> ClinicalAngles | None:
    """The truth's angles at the times of others."""
    truth = recording.truth
    if truth is None:
        return None
    poses = PoseSequence(
        times=like.times,
        p_world_joint=signals.interpolate(truth.times, truth.p_world_joint, like.times),
        R_world_bone=signals.interpolate_rotations(truth.times, truth.R_world_bone, like.times),
        names=truth.names,
    )
    return clinical_angles(all_observed(poses), recording.skeleton).select(like.names)
