"""Joint torques by inverse dynamics, and the external wrench that a motion requires.

The wrench that a motion needs from outside (`BodyDynamics`) is not made by muscles: it is the sum of all external
forces (floor, seat, rail), and of errors of masses and motion. External forces are not measured, so either

* none is assigned: torques of limbs without contact are correct, those of a leg on the floor are those of a
  hanging leg; or
* the one foot that bears load is known (`ground_reaction`): the whole external wrench acts on it, which
  gives the torques of that leg. The load sharing of two feet is unknown: then torques of the legs are NaN.

Standard deviations have two independent components: the covariances of the motion (`Confidence`), by the course in time
of `body_dynamics`, through the low-pass and both derivatives, by Pinocchio's derivatives of inverse dynamics; and
masses of de Leva's segments that are known to `MASS_SIGMA`, alike on the right and the left, with body mass as given.
In neither: the length of bones, centres of mass, what the low-pass takes away of the motion itself, an error of the
body mass, a contact that is not known. docs/dynamics.md compares them with actual errors (``python -m benchmarks
dynamics --corpus DIR``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.kinematics import LIMBS
from rtof_kin.body.motion_file import interpolated
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, angle_table, clinical_name
from rtof_kin.clinical.body_dynamics import MASS_SIGMA, UNKNOWN, BodyDynamics, pose_errors
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.confidence import Confidence
from rtof_kin.formats.joint_trajectory import joint_velocities

EVERY: Final = 1 / 15  #: [s] between frames in which they are computed; variances are interpolated linearly
_ERRORS: Final = 100  # frames whose errors are at once in memory


def dynamics_confidence(
    body: BodyDynamics,
    q: Array,
    v: Array,
    a: Array,
    carries: NDArray[np.int_],
    stated: Confidence | None,
    rate_hz: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return variances of torques (n, 2, D), (N m)^2, and covariances (n, 2, 6, 6) of the wrench about the reference,
    N and N m: of the motion, NaN without its confidence, and of the masses. It needs 70 kB a frame.

    Args:
        body: with the subject's mass. q, v, a: (n, nq), (n, nv), (n, nv), filtered.
        carries: (n,) see `BodyDynamics.at`. stated: of these frames. rate_hz: of the motion, Hz.
    """
    n, D = len(q), body.skeleton.nv - 6
    if stated is not None:
        errors = pose_errors(body.skeleton, q, stated, body.skeleton.forward_kinematics(q)[1])
        gains = errors.gains(rate_hz)
    torques, wrench = (np.full((n, 2, *shape), np.nan, np.float32) for shape in ((D,), (6, 6)))
    for t in range(n):
        S = body.derivatives(q[t], v[t], a[t], int(carries[t]))
        if stated is not None:
            value, velocity, acceleration = (rows @ errors.factors[t] for rows in (S.value, S.velocity, S.acceleration))
            torques[t, 0] = _products(value[:D], velocity[:D], acceleration[:D], gains)
            wrench[t, 0] = _covariance(value[D:], velocity[D:], acceleration[D:], gains)
        torques[t, 1] = MASS_SIGMA**2 * np.sum(S.masses[:D] ** 2, axis=1)
        wrench[t, 1] = MASS_SIGMA**2 * S.masses[D:] @ S.masses[D:].T
    return torques, wrench


def _products(value: Array, velocity: Array, acceleration: Array, gains: Array) -> Array:
    """Variances (m,) of linear functions (m, n) of independent errors and their derivatives."""
    squares = value**2, velocity**2, acceleration**2, 2 * value * acceleration
    return np.asarray(sum(square @ gain for square, gain in zip(squares, gains.T, strict=True)))


def _covariance(value: Array, velocity: Array, acceleration: Array, gains: Array) -> Array:
    """Covariance (m, m) of the same."""
    out = np.asarray(
        sum((rows * gain) @ rows.T for rows, gain in zip((value, velocity, acceleration), gains.T, strict=False))
    )
    both = (value * gains[:, 3]) @ acceleration.T
    return np.asarray(out + both + both.T)


SHORTEST: Final = 0.5  # [s] of the shortest stretch that is differentiated twice
NO_WEIGHT: Final = "not computed: no weight is given, and torques are proportional to it"
_CARRY: Final = tuple(name for limb in LIMBS if "UpLeg" in limb[0] for name in limb[1:])
"""Knees and ankles, without which no torque of a leg is known."""
_EDGE: Final = 0.1  #: [s] at either end of a stretch that are left NaN, where accelerations are one-sided differences


_MARGIN: Final = 2.0  #: [s] beside a block that are filtered with it: the filter's response has fallen below 1e-20


@dataclass(frozen=True)
class JointTorques:
    """Torques of all revolutes, and the external wrench on the root."""

    times: Array  #: (T,) seconds
    torques: NDArray[np.float32]
    """(T, D) N m about the URDF's revolutes, positive along their axes; NaN where unknown."""
    dof_names: tuple[str, ...]
    root_wrench: NDArray[np.float32]  #: (T, 6) external force, N, and moment about the root, N m, in world axes
    unexplained: NDArray[np.float32]  #: (T, 6) the part of it that is not assigned to a foot
    weight_kg: float  #: Body mass, kg
    notes: tuple[str, ...]
    wrench: Array  #: (T, 6) external force and moment about `reference`, world axes
    reference: Array
    """(T, 3) m, the middle between heel and toe: of the foot that bears all load, else the mean of both."""
    nodes: Index  #: (n,) frames of the next two, which are linear between them
    variances: NDArray[np.float32]
    """(n, 2, D) (N m)^2, of torques by the motion's errors and by those of the masses (`torques`). The first is NaN
    where the motion has no confidence."""
    node_covariances: NDArray[np.float32]  #: (n, 2, 6, 6) of `wrench`, by the same two components, N and N m

    def sigma_parts(self, frames: slice) -> Array:
        """Return standard deviations (N, 2, D), N m, of torques by both components."""
        found = interpolated(self.nodes, self.variances, np.arange(len(self.times))[frames])
        return np.asarray(np.where(np.isnan(self.torques[frames, None]), np.nan, np.sqrt(np.maximum(found, 0.0))))

    def wrench_covariances(self, frames: slice) -> Array:
        """Return covariances (N, 2, 6, 6) of `wrench` by both components, N and N m."""
        entries = self.node_covariances.reshape(len(self.nodes), 2, 36)
        found = interpolated(self.nodes, entries, np.arange(len(self.times))[frames])
        return np.where(np.isnan(self.wrench[frames, :1, None]), np.nan, found).reshape(-1, 2, 6, 6)


def joint_torques(
    motion: Motion | MotionSource,
    weight_kg: float,
    height: float | None = None,
    sex: str | None = None,
    support: NDArray[np.int_] | None = None,
) -> JointTorques:
    """Compute inverse dynamics of a motion with de Leva's body segment masses.

    Configurations are low-pass filtered at 6 Hz and differentiated twice. `InvalidInputError`: implausible values, or
    wrong support.

    Args:
        weight_kg: body mass, kg.
        height: standing height, m; a skeleton more than 5 % off is noted, nothing is rescaled.
        sex: de Leva's column, None for the mean.
        support: (T,) the foot that bears all load, see `FootContacts.support`; None if unknown.
    """
    source = MotionSource.of(motion)
    skeleton = source.skeleton.with_mass(weight_kg, sex)
    notes = _notes(source, height, support is None)
    T = len(source)
    given = np.full(T, UNKNOWN) if support is None else support
    carries: NDArray[np.int_] = readonly("support", given, (T,), np.int_)
    if not np.all(np.isin(carries, (UNKNOWN, *range(len(SIDES))))):
        raise InvalidInputError(f"support: 0 is the {SIDES[0]} foot, 1 the {SIDES[1]}, {UNKNOWN} unknown")
    whole, short = _unknown(T, skeleton.nv), 0
    nothing = (np.full((1, 2, *shape), np.nan, np.float32) for shape in ((skeleton.nv - 6,), (6, 6)))
    at_nodes: dict[str, list[NDArray[Any]]]  # the first where no node follows
    at_nodes = {"nodes": [np.zeros(1, np.intp)], "variances": [next(nothing)], "node_covariances": [next(nothing)]}
    ends = [i for i, name in enumerate(skeleton.names) if name in _CARRY]
    placed = source.masks.known & source.masks.valid[:, [0, *ends]].all(axis=1)
    for start, stop in signals.runs(placed):
        times = source.times[start:stop]
        if times[-1] - times[0] < SHORTEST:
            short += 1
            continue
        step = float(np.median(np.diff(times)))
        dynamics = _inverse_dynamics(skeleton, source[start:stop], 1 / step, carries[start:stop])
        for frames, part, (nodes, *parts) in dynamics:
            for column, found in zip(at_nodes.values(), (start + frames.start + nodes, *parts), strict=True):
                column.append(found)
            for name, array in part.items():
                whole[name][start + frames.start : start + frames.stop] = array
        edge = max(2, round(_EDGE / step))
        for array in whole.values():
            array[start : start + edge] = array[stop - edge : stop] = np.nan
    if short:
        notes.append(f"{short} stretch(es) shorter than {SHORTEST:g} s have no torques")
    if support is not None:
        segments = angle_table(skeleton.table).segments
        own = {segments[f"{side} {word}"] for side in SIDES for word in ("thigh", "shank", "foot")}
        joints = [joint for joint in skeleton.table.joints if joint.name in own]
        legs = [skeleton.dof_names.index(dof.urdf) for joint in joints for dof in joint.dofs]
        whole["torques"][np.ix_(carries == UNKNOWN, legs)] = np.nan
        notes.append(
            f"torques of the legs in {100 * np.mean(carries != UNKNOWN):.0f} % of the frames, in which one "
            "foot bears all load; load sharing of two feet is unknown without a force plate"
        )
    for name in tuple(at_nodes):
        whole[name] = np.concatenate(at_nodes.pop(name))
    notes += _confidence_notes(whole)
    return JointTorques(
        times=source.times, dof_names=skeleton.dof_names, weight_kg=skeleton.table.mass_kg, notes=tuple(notes), **whole
    )


_Arrays = dict[str, NDArray[Any]]  # of `JointTorques`, by its fields


def _unknown(frames: int, nv: int) -> _Arrays:
    """Arrays of NaN."""
    widths = {"torques": nv - 6, "root_wrench": 6, "unexplained": 6}
    out: _Arrays = {name: np.full((frames, width), np.nan, np.float32) for name, width in widths.items()}
    return out | {"wrench": np.full((frames, 6), np.nan), "reference": np.full((frames, 3), np.nan)}


def _notes(motion: MotionSource, height: float | None, no_support: bool) -> list[str]:
    """Notes on the size of the skeleton, on external forces and on unobserved degrees of freedom."""
    skeleton, notes = motion.skeleton, []
    if height is not None and not 0.4 < height < 2.6:
        raise InvalidInputError(f"joint torques: a height of {height:g} m is not plausible; give metres")
    if height is not None and abs(skeleton.height / height - 1) >= 0.05:
        notes.append(
            f"the skeleton is {skeleton.height:.2f} m tall, the height given {height:.2f} m: torques are "
            "those of the skeleton"
        )
    if no_support:
        notes.append(
            "no ground reaction force is assigned: torques of a leg in contact are not those of its muscles; "
            "the wrench on the root is what is missing"
        )
    if unseen := never_observed(motion.masks):
        names = ", ".join(clinical_name(skeleton.table, dof) for dof in unseen)
        notes.append(
            "these degrees of freedom are unobserved: their torques are those of a body that keeps them "
            f"constant, about axes whose direction is uncertain: {names}"
        )
    return notes


def _confidence_notes(found: _Arrays) -> list[str]:
    """Notes on the standard deviations."""
    if not np.isfinite(found["torques"]).any():
        return []
    if not np.isfinite(found["variances"][:, 0]).any():
        return [
            "the motion has no confidence, so the standard deviations contain only those of the masses "
            f"({100 * MASS_SIGMA:.0f} % of each segment)"
        ]
    return [
        "standard deviations: errors of the motion by its confidence (in simulation with held-out people 1.0 to 2.5 "
        "times the actual errors of torques; of the vertical force, without sensors, half of them), masses of segments "
        f"to {100 * MASS_SIGMA:.0f} %; bone lengths, body mass and impacts faster than {CUTOFF_HZ:g} Hz are not in them"
    ]


def _inverse_dynamics(
    skeleton: SkeletonModel, motion: MotionSource, rate_hz: float, carries: NDArray[np.int_]
) -> Iterator[tuple[slice, _Arrays, tuple[NDArray[Any], ...]]]:
    """Frames of a stretch in blocks, with their dynamics, and nodes by their place in the block."""
    body = BodyDynamics(skeleton)
    for block in motion.blocks(margin=math.ceil(_MARGIN * rate_hz)):
        times, own, supports = block.motion.times, block.own, carries[block.frames]
        q = np.array(smoothed(block.motion.q, rate_hz, CUTOFF_HZ))
        q[:, 3:7] = so3.unit(q[:, 3:7])  # the quaternion of the root is continuous, so it can be filtered
        v = joint_velocities(skeleton, q, times)
        a = np.gradient(v, times, axis=0)
        q, v, a = q[own], v[own], a[own]
        nodes = np.union1d(np.arange(0, len(q), max(1, math.floor(EVERY * rate_hz))), [len(q) - 1])
        parts = []
        for few in np.split(nodes, range(_ERRORS, len(nodes), _ERRORS)):
            stated = motion.read(block.start + few[0], block.start + few[-1] + 1).confidence
            stated = None if stated is None else stated[few - few[0]]
            parts.append(dynamics_confidence(body, q[few], v[few], a[few], supports[few], stated, rate_hz))
        found = [body.at(*frame) for frame in zip(q, v, a, supports.tolist(), strict=True)]
        yield (
            block.frames,
            {
                "torques": np.array([one.tau[6:] for one in found]),
                "root_wrench": np.array([one.root_wrench for one in found]),
                "unexplained": np.array([one.left for one in found]),
                "wrench": np.array([one.wrench for one in found]),
                "reference": np.array([one.reference for one in found]),
            },
            (nodes, *map(np.concatenate, zip(*parts, strict=True))),
        )
        del block, found  # before the next one is read
