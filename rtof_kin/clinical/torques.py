"""Joint torques by inverse dynamics: what the motion asks of every joint, and what it leaves unexplained.

``tau = M(q) a + h(q, v)`` (Pinocchio's recursive Newton-Euler). Muscles make the torques of the joints;
the first six rows, the force and moment on the root, nobody makes: they are what the floor, a seat or a
hand on a rail must have given, and all errors of masses and motion besides. No force was measured. So
either

* nothing is attributed: torques of limbs that touch nothing are right, those between the root and a foot
  on the floor are those of a leg that hangs; or
* the one foot that carries is known (`single_support`): the whole outer wrench acts on it, and the
  torques of that leg follow. With both feet down nothing tells how they share the load: the legs are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtof_kin.body.observability import never_observed
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.angle_table import SIDES, angle_table
from rtof_kin.clinical.gait import GaitAnalysis
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import STANDARD_GRAVITY
from rtof_kin.formats.joint_trajectory import joint_velocities

Array = NDArray[np.float64]
UNKNOWN = -1
"""In `single_support`: both feet, none, or nobody knows."""
SHORTEST = 0.5
"""Stretches shorter than this, s, are not differentiated twice: their ends would be all of them."""
_EDGE = 0.1
"""Seconds at either end of a stretch whose accelerations one-sided differences make: left NaN."""


@dataclass(frozen=True)
class JointTorques:
    """Torques of every revolute, and the wrench on the root that no muscle makes."""

    times: Array
    """(T,) seconds."""
    torques: Array
    """(T, D) N m about the URDF's revolutes, positive along their axes; NaN where not known."""
    dof_names: tuple[str, ...]
    """D revolutes of the URDF."""
    root_wrench: Array
    """(T, 6) force, N, and moment about the root, N m, in world axes, that must come from outside."""
    unexplained: Array
    """(T, 6) the part of it that was attributed to nothing: all of it, or none where one foot carries."""
    weight_kg: float
    """Body mass, kg."""
    notes: tuple[str, ...]
    """What the torques are not, and why."""

    @property
    def body_weights(self) -> Array:
        """(T,) vertical force from outside in body weights; 1 on average over any cycle that ends as it
        began.
        """
        return np.asarray(self.root_wrench[:, 2] / (self.weight_kg * STANDARD_GRAVITY))


def joint_torques(
    motion: MotionSequence,
    weight_kg: float | None,
    height: float | None = None,
    sex: str | None = None,
    support: NDArray[np.int_] | None = None,
) -> JointTorques:
    """Inverse dynamics of a motion with de Leva's masses.

    Args:
        motion: its skeleton's bone lengths are used as they are.
        weight_kg: body mass, kg. height: standing height, m, to check the skeleton against; a skeleton
            more than 5 % off is noted, nothing is rescaled. sex: de Leva's column, None for the mean.
        support: (T,) which foot carries all that is carried, see `single_support`; None where nothing is
            known about the feet.

    Returns:
        Torques at every valid frame; configurations are low-passed at 6 Hz and differentiated twice.

    Raises:
        ShapeError: no weight, or one that is no person's; support of another length or meaning.
    """
    skeleton = _weighing(motion.skeleton, weight_kg, sex)
    notes = _size_notes(skeleton, height)
    if support is None:
        notes.append(
            "no force of the floor is attributed: torques of a leg in contact are not those of its "
            "muscles; the wrench on the root is what is missing"
        )
    if unseen := never_observed(motion):
        notes.append(
            "nobody observed these degrees of freedom: their torques are those of a body that holds them "
            f"still, about axes that may point elsewhere: {', '.join(unseen)}"
        )
    T = len(motion.q)
    carries = _checked_support(support, T)
    tau = np.full((T, skeleton.nv), np.nan)
    wrench, unexplained = np.full((T, 6), np.nan), np.full((T, 6), np.nan)
    short = 0
    for start, stop in signals.runs(np.isfinite(motion.q).all(axis=1) & motion.poses.valid.all(axis=1)):
        times = motion.times[start:stop]
        if times[-1] - times[0] < SHORTEST:
            short += 1
            continue
        edge = max(2, round(_EDGE / float(np.median(np.diff(times)))))
        parts = _inverse_dynamics(skeleton, motion.q[start:stop], times, carries[start:stop])
        for whole, part in zip((tau, wrench, unexplained), parts, strict=True):
            whole[start + edge : stop - edge] = part[edge:-edge]
    if short:
        notes.append(f"{short} stretch(es) shorter than {SHORTEST:g} s have no torques")
    if support is not None:
        tau[np.ix_(carries == UNKNOWN, _leg_velocities(skeleton))] = np.nan
        notes.append(
            f"torques of the legs in {100 * np.mean(carries != UNKNOWN):.0f} % of the frames: there one "
            "foot is known to carry all; without a force plate nobody can tell how two share it"
        )
    return JointTorques(
        motion.times, tau[:, 6:], skeleton.dof_names, wrench, unexplained,
        skeleton.table.mass_kg, tuple(notes),
    )  # fmt: skip


def single_support(gait: GaitAnalysis) -> NDArray[np.int_]:
    """(T,) the foot that carries while the other swings: 0 right, 1 left, `UNKNOWN` otherwise.

    Both swing at once (running) is unknown too, and so is everything outside complete strides.
    """
    times = gait.events.times
    swings, stands = np.zeros((2, len(SIDES), len(times)), dtype=np.bool_)
    for stride in gait.strides:
        side = SIDES.index(stride.side)
        swings[side] |= (times > stride.toe_off) & (times < stride.stop)
        stands[side] |= (times >= stride.start) & (times <= stride.toe_off)
    out = np.full(len(times), UNKNOWN)
    for side in range(len(SIDES)):
        out[stands[side] & swings[1 - side]] = side
    return out


def _weighing(skeleton: SkeletonModel, weight_kg: float | None, sex: str | None) -> SkeletonModel:
    if weight_kg is None:
        raise ShapeError("joint torques: no weight is given; they are proportional to it: say it in kg")
    return skeleton.with_mass(weight_kg, sex)


def _checked_support(support: NDArray[np.int_] | None, frames: int) -> NDArray[np.int_]:
    given = np.full(frames, UNKNOWN) if support is None else support
    carries: NDArray[np.int_] = readonly("support", given, (frames,), np.int_)
    if not np.all(np.isin(carries, (UNKNOWN, *range(len(SIDES))))):
        raise ShapeError(f"support: 0 is the {SIDES[0]} foot, 1 the {SIDES[1]}, {UNKNOWN} unknown")
    return carries


def _size_notes(skeleton: SkeletonModel, height: float | None) -> list[str]:
    if height is None:
        return []
    if not 0.4 < height < 2.6:
        raise ShapeError(f"joint torques: a height of {height:g} m is no person's; give metres")
    if abs(skeleton.height / height - 1) < 0.05:
        return []
    return [
        f"the skeleton is {skeleton.height:.2f} m tall, the height given {height:.2f} m: torques are "
        "the skeleton's"
    ]


def _inverse_dynamics(
    skeleton: SkeletonModel, q: Array, times: Array, carries: NDArray[np.int_]
) -> tuple[Array, Array, Array]:
    """Tau (T, nv), outer wrench (T, 6) and its unattributed part (T, 6), about the root in world axes."""
    q = _smooth_configurations(q, float(1 / np.median(np.diff(times))))
    v = joint_velocities(skeleton, q, times)
    a = np.gradient(v, times, axis=0)
    model, data = skeleton.model, skeleton.model.createData()
    table = angle_table(skeleton.table)
    feet = [_last_joint(skeleton, table.segments[f"{side} foot"]) for side in SIDES]
    root = model.getJointId("root_joint")
    tau, wrench, left = np.empty_like(v), np.empty((len(q), 6)), np.empty((len(q), 6))
    for t in range(len(q)):
        pin.forwardKinematics(model, data, q[t])  # rnea itself places no joint in the world
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


def _smooth_configurations(q: Array, rate_hz: float) -> Array:
    """Low-passed; the root's quaternion, which is continuous, is brought back to unit length."""
    out = np.array(smoothed(q, rate_hz, CUTOFF_HZ))
    out[:, 3:7] = so3.unit(out[:, 3:7])
    return out


def _last_joint(skeleton: SkeletonModel, name: str) -> int:
    """Pinocchio's number of the joint whose link is a segment: the last of its three revolutes."""
    joint = skeleton.table.joints[skeleton.names.index(name)]
    return int(skeleton.model.getJointId(joint.dofs[-1].urdf))


def _leg_velocities(skeleton: SkeletonModel) -> list[int]:
    """Columns of v, and of tau, of both legs."""
    table = angle_table(skeleton.table)
    leg = {table.segments[f"{side} {word}"] for side in SIDES for word in ("thigh", "shank", "foot")}
    dofs = [dof.urdf for joint in skeleton.table.joints if joint.name in leg for dof in joint.dofs]
    return [6 + skeleton.dof_names.index(name) for name in dofs]
