"""Joint torques by inverse dynamics, and the external wrench that a motion requires.

``tau = M(q) a + h(q, v)`` (Pinocchio's recursive Newton-Euler). The first six rows, the force and moment on
the root, are not made by muscles: they are the sum of all external forces (floor, seat, rail), and of errors
of masses and motion. External forces are not measured, so either

* none is assigned: torques of limbs without contact are correct, those of a leg on the floor are those of a
  hanging leg; or
* the one foot that bears load is known (`single_support`): the whole external wrench acts on it, which
  gives the torques of that leg. The load sharing of two feet is unknown: then torques of the legs are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import never_observed
from rtof_kin.body.rigid_bodies import pin
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, angle_table, clinical_name
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.joint_trajectory import joint_velocities

UNKNOWN: Final = -1  # in `single_support`: both feet, none, or unknown
SHORTEST: Final = 0.5  # [s] of the shortest stretch that is differentiated twice
NO_WEIGHT: Final = "not computed: no weight is given, and torques are proportional to it"
_EDGE: Final = 0.1
"""[s] at either end of a stretch that are left NaN, where accelerations are one-sided differences."""


_MARGIN: Final = 2.0
"""[s] beside a block that are filtered with it: the filter's response has fallen below 1e-20."""


@dataclass(frozen=True)
class JointTorques:
    """Torques of all revolutes, and the external wrench on the root."""

    times: Array
    """(T,) seconds."""
    torques: Array
    """(T, D) N m about the URDF's revolutes, positive along their axes; NaN where unknown."""
    dof_names: tuple[str, ...]
    root_wrench: Array
    """(T, 6) external force, N, and moment about the root, N m, in world axes."""
    unexplained: Array
    """(T, 6) the part of it that is not assigned to a foot."""
    weight_kg: float
    """Body mass, kg."""
    notes: tuple[str, ...]


def joint_torques(
    motion: MotionSequence | MotionSource,
    weight_kg: float | None,
    height: float | None = None,
    sex: str | None = None,
    support: NDArray[np.int_] | None = None,
) -> JointTorques:
    """Compute inverse dynamics of a motion with de Leva's body segment masses.

    Configurations are low-pass filtered at 6 Hz and differentiated twice.

    Args:
        motion: with the bone lengths of the subject. weight_kg: body mass, kg.
        height: standing height, m; a skeleton more than 5 % off is noted, nothing is rescaled.
        sex: de Leva's column, None for the mean.
        support: (T,) the foot that bears all load, see `single_support`; None if unknown.

    Raises:
        InvalidInputError: no body mass, implausible values, or wrong support.
    """
    if weight_kg is None:
        raise InvalidInputError(
            "joint torques: no weight is given; they are proportional to it: pass it in kg"
        )
    source = MotionSource.of(motion)
    skeleton = source.skeleton.with_mass(weight_kg, sex)
    notes = _notes(source, height, support is None)
    T = len(source)
    given = np.full(T, UNKNOWN) if support is None else support
    carries: NDArray[np.int_] = readonly("support", given, (T,), np.int_)
    if not np.all(np.isin(carries, (UNKNOWN, *range(len(SIDES))))):
        raise InvalidInputError(f"support: 0 is the {SIDES[0]} foot, 1 the {SIDES[1]}, {UNKNOWN} unknown")
    tau = np.full((T, skeleton.nv), np.nan)
    wrench, unexplained = np.full((T, 6), np.nan), np.full((T, 6), np.nan)
    short = 0
    for start, stop in signals.runs(source.masks.known & source.masks.valid.all(axis=1)):
        times = source.times[start:stop]
        if times[-1] - times[0] < SHORTEST:
            short += 1
            continue
        step = float(np.median(np.diff(times)))
        for frames, parts in _inverse_dynamics(skeleton, source[start:stop], 1 / step, carries[start:stop]):
            for whole, part in zip((tau, wrench, unexplained), parts, strict=True):
                whole[start:stop][frames] = part
        edge = max(2, round(_EDGE / step))
        for whole in (tau, wrench, unexplained):
            whole[start : start + edge] = whole[stop - edge : stop] = np.nan
    if short:
        notes.append(f"{short} stretch(es) shorter than {SHORTEST:g} s have no torques")
    if support is not None:
        tau[np.ix_(carries == UNKNOWN, _leg_velocities(skeleton))] = np.nan
        notes.append(
            f"torques of the legs in {100 * np.mean(carries != UNKNOWN):.0f} % of the frames, in which one "
            "foot bears all load; load sharing of two feet is unknown without a force plate"
        )
    return JointTorques(
        source.times, tau[:, 6:], skeleton.dof_names, wrench, unexplained,
        skeleton.table.mass_kg, tuple(notes),
    )  # fmt: skip


def single_support(gait: GaitAnalysis) -> NDArray[np.int_]:
    """Return (T,) the foot that bears load while the other swings: 0 right, 1 left, `UNKNOWN` otherwise.

    It is unknown while both swing (running) and outside complete strides.

    Args:
        gait: strides of both feet.
    """
    times = gait.events.times
    swings, stands = np.zeros((2, len(SIDES), len(times)), dtype=np.bool_)
    for stride in gait.strides:
        side = SIDES.index(stride.side)
        own = stride.frames(times)
        swings[side, own] |= (times[own] > stride.toe_off) & (times[own] < stride.stop)
        stands[side, own] |= (times[own] >= stride.start) & (times[own] <= stride.toe_off)
    out = np.full(len(times), UNKNOWN)
    for side in range(len(SIDES)):
        out[stands[side] & swings[1 - side]] = side
    return out


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


def _inverse_dynamics(
    skeleton: SkeletonModel, motion: MotionSource, rate_hz: float, carries: NDArray[np.int_]
) -> Iterator[tuple[slice, tuple[Array, Array, Array]]]:
    """Frames of a stretch in blocks, with `_wrenches` of each."""
    for block in motion.blocks(margin=math.ceil(_MARGIN * rate_hz)):
        times, own = block.motion.times, block.own
        q = np.array(smoothed(block.motion.q, rate_hz, CUTOFF_HZ))
        q[:, 3:7] = so3.unit(q[:, 3:7])  # the quaternion of the root is continuous, so it can be filtered
        v = joint_velocities(skeleton, q, times)
        a = np.gradient(v, times, axis=0)
        yield block.frames, _wrenches(skeleton, q[own], v[own], a[own], carries[block.frames])


def _wrenches(
    skeleton: SkeletonModel, q: Array, v: Array, a: Array, carries: NDArray[np.int_]
) -> tuple[Array, Array, Array]:
    """Tau (T, nv), external wrench (T, 6) and its unassigned part (T, 6), about the root in world axes."""
    model, data = skeleton.model, skeleton.model.createData()
    table = angle_table(skeleton.table)
    feet = [_link_joint(skeleton, table.segments[f"{side} foot"]) for side in SIDES]
    root = model.getJointId("root_joint")
    tau, wrench, left = np.empty_like(v), np.empty((len(q), 6)), np.empty((len(q), 6))
    for t in range(len(q)):
        pin.forwardKinematics(model, data, q[t])  # rnea does not compute joint placements in world
        tau[t] = pin.rnea(model, data, q[t], v[t], a[t])
        to_world = pin.SE3(data.oMi[root].rotation, np.zeros(3))
        wrench[t] = left[t] = to_world.act(pin.Force(tau[t, :6])).vector
        if carries[t] != UNKNOWN:
            foot = feet[carries[t]]
            outside = [pin.Force.Zero() for _ in range(model.njoints)]
            outside[foot] = data.oMi[foot].actInv(data.oMi[root].act(pin.Force(tau[t, :6])))
            tau[t] = pin.rnea(model, data, q[t], v[t], a[t], outside)
            left[t] = to_world.act(pin.Force(tau[t, :6])).vector
    return tau, wrench, left


def _link_joint(skeleton: SkeletonModel, name: str) -> int:
    """Pinocchio's index of the last of the three revolutes of a joint, which carries its link."""
    joint = skeleton.table.joints[skeleton.names.index(name)]
    return int(skeleton.model.getJointId(joint.dofs[-1].urdf))


def _leg_velocities(skeleton: SkeletonModel) -> list[int]:
    """Columns of v, and of tau, of both legs."""
    table = angle_table(skeleton.table)
    leg = {table.segments[f"{side} {word}"] for side in SIDES for word in ("thigh", "shank", "foot")}
    dofs = [dof.urdf for joint in skeleton.table.joints if joint.name in leg for dof in joint.dofs]
    return [6 + skeleton.dof_names.index(name) for name in dofs]
