"""Input and output of peers: material, fragments, answers and scores."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording

Trace = list[tuple[float, Array]]
"""Seconds since a solver began, and the state it had then."""


@dataclass(frozen=True)
class Material:
    """A recording and where solvers start."""

    skeleton: SkeletonModel
    start: PoseSequence
    keypoints: KeypointSequence
    imus: BoneImuSequence

    @classmethod
    def demo(cls) -> Material:
        """The demo recording, not calibrated from itself but for the clock of its video, with SF2's poses."""
        found = reconstruct(Recording.load(model_path("demo")), mode="sf2")
        assert found.bone_imus is not None
        return cls(found.recording.skeleton, found.stages["sf2"], found.keypoints, found.bone_imus)

    def __getitem__(self, frames: slice) -> Material:
        return replace(self, start=self.start[frames], keypoints=self.keypoints[frames], imus=self.imus[frames])

    def tiled(self, frames: int) -> Material:
        """Repeat the material forwards and backwards up to a number of frames, without jumps in position."""
        T, start, seen, imus = len(self.start), self.start, self.keypoints, self.imus
        to_and_fro = np.arange(frames) % (2 * T)
        at = np.where(to_and_fro < T, to_and_fro, 2 * T - 1 - to_and_fro)
        times = start.times[0] + np.arange(frames) / start.rate_hz
        p, R = start.p_world_joint[at], start.R_world_bone[at]
        return Material(
            self.skeleton,
            PoseSequence(times, p, R, start.names),
            replace(seen, times=times, uv_px=seen.uv_px[at], confidence=seen.confidence[at], own_times=None),
            replace(imus, times=times, R_world_bone=imus.R_world_bone[at], a_world=imus.a_world[at]),
        )


@dataclass(frozen=True)
class Fragment:
    """One fragment's start and observations."""

    first: int
    """Index of its first frame; negative in the padding."""
    x0: Array
    """(N, ...) the starting state, the same for all solvers."""
    data: Any
    """Named parameters of `FragmentProblem`, or `FragmentData`."""


@dataclass(frozen=True)
class Answer:
    """Solution of a solver."""

    x: Array
    """(N, ...) the state."""
    seconds: float
    iterations: int
    converged: bool
    """True if the solver reports convergence."""
    multipliers: Array | None = None
    """(N, M) of the limits."""


@dataclass(frozen=True)
class Score:
    """Evaluation of an answer by the package's own energy."""

    energy: float
    """[1]"""
    gradient: float
    """Largest component of the energy's gradient, of the Lagrangian's with multipliers; 1/m or 1/rad."""
    violation_deg: float
    """Largest violation of a limit."""


class Solver(Protocol):
    """Minimises a fragment's energy from its start; fills the trace where one is given."""

    def solve(self, fragment: Fragment, trace: Trace | None = None) -> Answer: ...
