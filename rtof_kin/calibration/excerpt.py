"""Excerpt of a recording: the fragments that a calibration uses, one after the other.

What a calibration costs goes with the length of the excerpt, not with that of the recording: a recording is
given as one slice or several, of which fragments are chosen by what their sensors and landmarks show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.core.array_types import Array
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.inertial.outlier_rejection import find_disagreements, merge_faults
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.initial_guess import InitialGuess
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.settings import JointSpaceSettings

_MISALIGNED_FRACTION = 0.8  # Minimum fraction of the excerpt over which a sensor must disagree to count as misaligned


@dataclass(frozen=True)
class Slice:
    """A recording, or the part of it between two times, made ready for calibration."""

    recording: Recording  # With IMUs, an approximate calibration, and evenly spaced keypoints
    guess: InitialGuess  # At the keypoints' times, from poses after SF2
    bone_imus: BoneImuSequence  # Sensors at those times


@dataclass(frozen=True)
class Excerpt:
    """Fragments of one recording, joined; times jump between them."""

    slices: tuple[Slice, ...]
    data: tuple[Observations, ...]  # Of each slice; all have the same states and sensors
    fragments: tuple[tuple[int, int], ...]  # Slice and first frame there of every fragment, in the order of time

    left_out: tuple[StreamFault, ...] = ()  # Intervals of sensors that are not used, by segment

    @classmethod
    def chosen(cls, slices: Sequence[Slice], frames: int, settings: JointSpaceSettings, most_seconds: float) -> Self:
        """Choose fragments of slices: the liveliest of each of so many equal parts.

        Args:
            slices: of one recording, in the order of time; those in which other sensors have data than in the one
                with most of them are left out.
            most_seconds: length of all fragments, s.
        """
        data = [_observed(part, frames, settings) for part in slices]
        sensed = max(data, key=lambda own: len(own.space.names) - len(own.fixed))
        alike = [i for i, own in enumerate(data) if _same_states(own, sensed)]
        data = [data[i] for i in alike]
        whole = [
            (i, first) for i, own in enumerate(data) for first in range(0, len(own.start) - frames + 1, frames)
        ] or [(0, 0)]
        count = max(int(min(float(len(whole)), most_seconds * data[0].rate_hz / frames)), 1)
        motion = np.array([liveliness(data[i], first) for i, first in whole])
        best = [part[np.argmax(motion[part])] for part in np.array_split(np.arange(len(whole)), count)]
        return cls(tuple(slices[i] for i in alike), tuple(data), tuple(whole[k] for k in best))

    @property
    def frames(self) -> int:
        """N of a fragment."""
        return self.data[0].frames

    @property
    def firsts(self) -> range:
        """First frame of every fragment in the excerpt."""
        return range(0, len(self.fragments) * self.frames, self.frames)

    def joined(self, values: Sequence[Array]) -> Array:
        """Return the excerpt's frames (T', ...) of values (T, ...) of every slice."""
        return np.concatenate([values[i][first : first + self.frames] for i, first in self.fragments])

    @property
    def times(self) -> Array:
        """(T',) stamps of the video, s."""
        return self.joined([part.guess.poses.times for part in self.slices])

    @property
    def observations(self) -> CalibrationObservations:
        """Of the T' frames."""
        given = self.data[0]
        rows = {name: self.joined([own.rows[name] for own in self.data]) for name in given.rows}
        w_acceleration = self.joined([own.w_acceleration for own in self.data])
        for fault in self.left_out:
            during = (self.times >= fault.start) & (self.times <= fault.stop)
            s = given.sensors.index(fault.what)
            rows["w_sensor"][during, s], w_acceleration[during, s] = 0.0, 0.0
        a_world = self.joined([own.a_world for own in self.data])
        return CalibrationObservations(self.times, rows, given.constant, a_world, w_acceleration)

    def by_slice(self, values: Array) -> list[tuple[int, Array]]:
        """Return slices and their part of values (T', ...) of the excerpt's frames."""
        counts = np.bincount([i for i, _ in self.fragments]) * min(self.frames, len(values))
        parts = np.split(values, np.cumsum(counts)[:-1])
        return [(i, part) for i, part in enumerate(parts) if len(part)]

    def slipped(self, states: Sequence[Array]) -> tuple[StreamFault, ...]:
        """Intervals in which a sensor contradicts the motion solved with all of them, but for sensors that do so nearly
        always, which a constant mounting error explains; `states`: (N, 3 + 4A) of every fragment.
        """
        faults, seconds = list[StreamFault](), 0.0
        for (i, first), x in zip(self.fragments, states, strict=True):
            own = slice(first, min(first + self.frames, len(self.data[i].start)))
            start = self.slices[i].guess.poses
            poses = start.with_poses(own, *(v[: own.stop - first] for v in self.data[i].space.poses(x)))
            seconds += float(poses.times[-1] - poses.times[0])
            faults += find_disagreements(poses, self.slices[i].bone_imus[own], self.data[i].skeleton)
        lasting = {
            name
            for name in {fault.what for fault in faults}
            if sum(f.stop - f.start for f in faults if f.what == name) >= _MISALIGNED_FRACTION * seconds
        }
        return merge_faults(fault for fault in faults if fault.what not in lasting)


def _observed(part: Slice, frames: int, settings: JointSpaceSettings) -> Observations:
    recording = part.recording
    return Observations(
        recording.skeleton,
        frames,
        settings,
        part.guess,
        recording.keypoints,
        part.bone_imus,
        places=part.bone_imus.joints,
    )


def _same_states(one: Observations, other: Observations) -> bool:
    """Whether the same joints turn, with the same sensors."""
    return (
        one.space.names == other.space.names
        and one.fixed == other.fixed
        and np.array_equal(one.problem.sigma_jerk, other.problem.sigma_jerk)
    )


def liveliness(data: Observations, first: int) -> float:
    """Return how much the sensors of a fragment are accelerated, times the share of landmarks seen."""
    own = slice(first, first + data.frames)
    return float(np.std(data.a_world[own], axis=0).sum() * np.mean(data.confidence[own] > 0))
