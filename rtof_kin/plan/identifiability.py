"""What the measurements of a planned recording do not determine, and what it is confused with.

At the optimum of a simulated recording the Hessian of the energy is taken without the pose prior and without
the anchors to the lifter, with the same smoothness: it is the information of camera and sensors alone. An
angle whose standard deviation by it exceeds `NOT_IDENTIFIABLE` is not identifiable: its value is that of a
usual person in this posture. The quantity that it is confused with is the one with which its error is
correlated most under the measurements alone: a change of both leaves image and sensors nearly as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.clinical import decomposition as jcs
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.camera import Camera
from rtof_kin.plan.prediction import SETTINGS
from rtof_kin.plan.setup import Setup
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.covariance import state_covariances
from rtof_kin.solve.joint_space.observations import Observations
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.settings import JointSpaceSettings

NOT_IDENTIFIABLE: Final = np.radians(30.0)
"""[rad] Least standard deviation, by the measurements alone, of an angle that is not identifiable."""
CONFUSED: Final = 0.6  #: Least correlation of errors that counts as a confusion
ROOT: Final = ("sideways position", "vertical position", "distance")
"""Position of the pelvis as seen by the camera: to its right, down, along its axis."""
_FRAGMENTS: Final = 5  #: Over the movement
_STEP: Final = 1e-4  #: [m, rad] of the central differences
_FIXED: Final = 1e-5  #: [rad] Standard deviation of an angle that the model fixes, such as the adduction of a hinge
_ASSUMED: Final = ("w_prior", "w_torso", "w_bone", "w_root")
"""Weights of the pose prior and of the anchors to the initial guess."""


@dataclass(frozen=True)
class Weakness:
    """An angle that is not identifiable."""

    angle: str
    sigma: float  #: [rad] Standard deviation by the measurements alone
    confused_with: str = ""  #: Another angle or one of `ROOT`; empty where the measurements hardly depend on the angle
    correlation: float = 0.0  #: Of the two errors, under the measurements alone

    @property
    def words(self) -> str:
        """The reason in words, the direction first."""
        name = self.angle.replace("_", " ")
        if not self.confused_with:
            size = "more than 90 deg" if self.sigma > np.pi / 2 else f"{np.degrees(self.sigma):.0f} deg"
            return f"{name}: image and sensors alone leave a standard deviation of {size}"
        other = self.confused_with.replace("_", " ")
        return f"{name} against {other}: a change of both leaves image and sensors nearly as they are"


@dataclass(frozen=True)
class Information:
    """Information of A angles, over the movement."""

    names: tuple[str, ...]
    sigma: Array  #: (A,) rad, standard deviations by the measurements alone; NaN for an angle that the model fixes
    correlation: Array  #: (A, A + 3) of the errors under the measurements alone, with those of all angles and of `ROOT`

    def weaknesses(self, shown: Sequence[str], others: Sequence[str]) -> tuple[Weakness, ...]:
        """Return those of some angles that are not identifiable, the least first; they may be confused with others,
        and with `ROOT`.
        """
        found = []
        for name in shown:
            a = self.names.index(name)
            if not self.sigma[a] > NOT_IDENTIFIABLE:
                continue
            partners = [self.names.index(other) for other in others if _joint(other) != _joint(name)]
            partners += range(len(self.names), len(self.names) + len(ROOT))
            best = max(partners, key=lambda b: abs(self.correlation[a, b]))
            size = float(abs(self.correlation[a, best]))
            confused = (*self.names, *ROOT)[best] if size >= CONFUSED else ""
            found.append(Weakness(name, float(self.sigma[a]), confused, size))
        return tuple(sorted(found, key=lambda weakness: -weakness.sigma))


def information(setup: Setup, seed: int, lifter: LifterLike | None = None) -> Information:
    """Return the information of the measurements alone, in a simulated recording."""
    names = tuple(row.name for row in angle_table(setup.skeleton.table).rows)
    variances, correlations = [], []
    for space, x, covariance in _covariances(setup, seed, lifter):
        J = _rates(space, x, setup.camera)
        C = J @ covariance @ J.T
        deviation = np.sqrt(np.where(np.diag(C) > _FIXED**2, np.diag(C), np.nan))
        variances.append(deviation[: len(names)] ** 2)
        correlations.append(np.nan_to_num(C / np.outer(deviation, deviation))[: len(names)])
    return Information(names, np.sqrt(np.mean(variances, axis=0)), np.mean(correlations, axis=0))


def _covariances(setup: Setup, seed: int, lifter: LifterLike | None) -> Iterator[tuple[StateSpace, Array, Array]]:
    """State (1, 3 + 4A) in the middle of some fragments, and its covariance (D, D) by the measurements."""
    job = Job.of(setup.recorded(seed), None, lifter, SETTINGS, None).with_solver(None)
    prepared, s, N = job.prepare(setup.mode), job.settings.fragment, SETTINGS.frames
    assert isinstance(s, JointSpaceSettings)
    data = Observations(
        prepared.skeleton,
        N,
        s,
        prepared.guess,
        prepared.recording.video,
        prepared.bone_imus,
        places=SETTINGS.sensor_joints,
    )
    solver, last = LevenbergMarquardt(data.problem, data.limits), max(len(prepared.start) - N, 0)
    for first in sorted({round(last * i / (_FRAGMENTS - 1)) for i in range(_FRAGMENTS)}):
        index, _, values = data.fragment(first)
        data.problem.bind(values)
        annealing = Annealing(s, data.problem, data.confidence[index], data.points.sizes, values.observation)
        steps = s.annealing + s.max_iterations
        solved = solver.solve(data.start[index], steps, s.tolerance, None, annealing)
        for name in _ASSUMED:
            data.problem.reweigh(name, np.zeros_like(values.observation[name]))
        yield data.space, solved.x[[N // 2]], state_covariances(data.problem, solver, solved)[N // 2]


def _rates(space: StateSpace, x: Array, camera: Camera) -> Array:
    """Derivatives (A + 3, D) of angles and `ROOT` by the tangent of a state (1, 3 + 4A)."""
    columns = []
    for step in _STEP * np.eye(space.size):
        after, before = (_quantities(space, space.retract(x, sign * step[None]), camera) for sign in (1, -1))
        off = after - before
        off[:-3] = (off[:-3] + np.pi) % (2 * np.pi) - np.pi
        columns.append(off / (2 * _STEP))
    return np.stack(columns, axis=1)


def _quantities(space: StateSpace, x: Array, camera: Camera) -> Array:
    """Angles, rad, and the root's position as seen by the camera, m, (A + 3,) of a state."""
    (p, R), table = space.poses(x), angle_table(space.skeleton.table)
    relative = jcs.relative_rotations(R, space.skeleton, table)
    angles = [jcs.decompose(joint.sequence, relative[joint.name])[0] for joint in table.joints]
    return np.concatenate([*angles, camera.to_camera(p[0, :1])[0]])


def _joint(angle: str) -> str:
    """Side and joint of an angle, the same in all conventions."""
    words = [word for word in angle.split("_") if word not in ("opensim", "xzy")]
    return " ".join(words[:2] if words[0] in ("left", "right") else words[:1])
