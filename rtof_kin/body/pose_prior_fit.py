"""Fit of a pose prior to free motion.

Every motion counts twice, as it is and mirrored; orientations are low-passed at 10 Hz, as optical markers jitter.

A person counts at most `LONGEST_S` of motion, in frames spread over all of it: the covariance of all rigs and people
has the differences between persons, and these want many persons, not many minutes. (Between- and within-person
covariances weighted apart gained nothing on held-out people: one view does not show a person's constants.)

Rigs differ in where the trunk bends (CMU's at two of four joints, others at one or at all) and in how much
clavicles move (hardly, in free joint rotations). So where they are mixed, the bend between pelvis and upper trunk,
which they agree on, is shared evenly by the four joints of the spine, and the clavicles are a mixture, in equal
parts, of those of the motion and of ones that follow the arms as those of people do. The prior of a laboratory that
records and judges with one rig keeps the trunk of that rig.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import CLAVICLES, JOINTS, RHYTHM, SPINE, NeutralPosture, PosePrior
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

CUTOFF_HZ, LEAST_JERK = 10.0, 200.0
LEAST_SUBJECTS: Final = 3  #: Fewest persons of known posture from whom the spread about the own posture is estimated
LONGEST_S: Final = 120.0  #: Motion of one person that counts, s
SHRINK_S: Final = 60.0  #: Duration of motion that a known prior counts for, s
UNEVEN = np.radians([2.0, 3.0, 2.0])
"""Standard deviation of a joint of the spine about its share of the bend, about x, y, z, rad."""
LOWERED = np.radians(4.0)  #: Mean of following clavicles below their T-pose, with arms that mostly hang, rad
FOLLOWING: Final = 0.5  #: Share of clavicles that follow the arms in a prior of several rigs
CLAVICLE = np.radians([6.0, 5.0, 6.0])  #: Standard deviation of a clavicle about what the arm tells, rad
PERSON_S: Final = 25.0  #: Least motion of a person that shows the person's mean, s
PERSONS: Final = 8  #: Fewest such persons that show the spread between persons
BUILT: Final = (*JOINTS, "Neck", "Head")  #: Joints whose means differ between persons by build, not by what they do
MOST_BETWEEN: Final = 0.85  #: Largest share of the variance of any combination of joints that is between persons
LEAST = np.radians(0.3)  #: Smallest standard deviation of any combination of joints, rad
TRUNK: Final = (*SPINE, "Neck")  #: Joints whose distances along the trunk tell rigs apart
SAME_SHARE: Final = 0.03  #: Largest difference of such a distance within a rig, as a share of the trunk's length
_MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class PersonMotion:
    """Motion of a person."""

    subject: str
    R_world_bone: Array  #: (T, J, 3, 3)
    p_world_root: Array  #: (T, 3) m
    rate_hz: float


def of_one_rig(names: Sequence[str], joint_offsets: Array) -> bool:
    """Return whether skeletons of `joint_offsets` (C, J, 3) divide the trunk alike, as one rig's of many persons do."""
    lengths = np.linalg.norm(joint_offsets[:, [names.index(joint) for joint in TRUNK]], axis=-1)
    shares = lengths / lengths.sum(axis=1, keepdims=True)
    return bool(np.abs(shares - np.median(shares, axis=0)).max() < SAME_SHARE)


def fit_pose_prior(
    names: Sequence[str],
    parents: Sequence[int],
    motions: Sequence[PersonMotion],
    even_spine: bool = True,
    postures: Mapping[str, NeutralPosture] | None = None,
    known: PosePrior | None = None,
    following: float = FOLLOWING,
    longest_s: float = LONGEST_S,
) -> PosePrior:
    """Return the prior of motions.

    Args:
        names: J joints of the 21-joint skeleton. parents: (J,). motions: one or more, longer than three frames.
        even_spine: whether the motions are of several rigs, see the module.
        postures: of subjects whose T-pose is known; from `LEAST_SUBJECTS` on, the covariance about the person's own
            posture is estimated too, and kept if it is the smaller one.
        known: prior that counts as `SHRINK_S` of motion beside the motions; None counts nothing.
        following: share of clavicles that follow the arms, where rigs are several. longest_s: motion of one person
            that counts, s.
    """
    other = _other_side(names)
    seconds = {m.subject: 0.0 for m in motions}
    for m in motions:
        seconds[m.subject] += len(m.R_world_bone) / m.rate_hz
    steps = [max(1, round(seconds[m.subject] / longest_s)) for m in motions]
    local, jerk, root_jerk = zip(
        *([x[::step] for x in _observed(parents, m)] for m, step in zip(motions, steps, strict=True)), strict=True
    )
    both = [part for own in local for part in (own, _MIRROR @ own[:, other] @ _MIRROR)]
    mean, vectors = _mean(np.concatenate(both)[:, 1:])
    covariance = np.cov(vectors.reshape(len(vectors), -1).T)
    if even_spine:
        mean, covariance = of_mixed_rigs(names, mean, covariance, following)
    size = np.sqrt((np.concatenate(jerk) ** 2).sum(axis=-1).mean(axis=0) / 3)
    prior = PosePrior(
        tuple(names),
        so3.to_quat_wxyz(mean),
        _firm(covariance),
        np.maximum((size + size[other]) / 2, LEAST_JERK),
        float(np.sqrt((np.concatenate(root_jerk) ** 2).mean())),
    )
    persons = {
        subject: np.concatenate([own for m, own in zip(motions, local, strict=True) if m.subject == subject])
        for subject in sorted({m.subject for m in motions} & (postures or {}).keys())
    }
    if postures and len(persons) >= LEAST_SUBJECTS:
        own = [(postures[s], rotations) for s, rotations in persons.items()]
        prior = _with_postures(prior, own, following if even_spine else None)
    elif even_spine:
        prior = _with_persons(prior, local, motions)
    return prior if known is None else shrunk(prior, known, SHRINK_S / (SHRINK_S + sum(seconds.values())))


def _other_side(names: Sequence[str]) -> list[int]:
    """Index of each joint's counterpart on the other side of the body."""
    swapped = (n.replace("Left", "?").replace("Right", "Left").replace("?", "Right") for n in names)
    return [names.index(name) for name in swapped]


def _observed(parents: Sequence[int], motion: PersonMotion) -> tuple[Array, Array, Array]:
    """Low-passed rotations relative to parents (T, J, 3, 3) and jerks (T - 3, J, 3), root's (T - 3, 3)."""
    rate = motion.rate_hz
    R = so3.nearest_rotation(signals.low_pass(motion.R_world_bone, rate, CUTOFF_HZ))
    local = kinematics.local_rotations(parents, R)
    turns = so3.log(np.swapaxes(local[:-1], -1, -2) @ local[1:])
    p = signals.low_pass(motion.p_world_root, rate, CUTOFF_HZ)
    return local, np.diff(turns, 2, axis=0) * rate**3, np.diff(p, 3, axis=0) * rate**3


def _mean(local: Array) -> tuple[Array, Array]:
    """Mean rotations (J - 1, 3, 3), where the mean rotation vectors vanish, and the vectors (N, J - 1, 3)."""
    mean = so3.nearest_rotation(local.mean(axis=0))
    for _ in range(10):
        vectors = so3.log(np.swapaxes(mean, -1, -2) @ local)
        mean = mean @ so3.exp(vectors.mean(axis=0))
    return mean, vectors


def _with_postures(
    prior: PosePrior, persons: Sequence[tuple[NeutralPosture, Array]], following: float | None
) -> PosePrior:
    """Add the covariance of rotations (T, J, 3, 3) of persons about the means that their postures give them,
    if the posture's joints have less variance about these.
    """
    size, frames = len(prior.covariance), sum(len(own) for _, own in persons)
    moment = np.zeros((size, size))
    for posture, own in persons:
        mean = so3.from_quat_wxyz(prior.about(posture).mean_quat_wxyz)
        vectors = so3.log(np.swapaxes(mean, -1, -2) @ own[:, 1:]).reshape(-1, size)
        moment += vectors.T @ vectors / frames
    mirror = _mirror_of(prior.joints)
    about = (moment + mirror @ moment @ mirror.T) / 2
    if following is not None:
        about = of_mixed_rigs(prior.joints, so3.from_quat_wxyz(prior.mean_quat_wxyz), about, following)[1]
    about = _firm(about)
    rows = np.ravel([3 * (prior.joints.index(joint) - 1) + np.arange(3) for joint in JOINTS])
    smaller = np.diagonal(about)[rows].sum() < np.diagonal(prior.covariance)[rows].sum()
    return replace(prior, covariance_about_posture=about) if smaller else prior


def _with_persons(prior: PosePrior, local: Sequence[Array], motions: Sequence[PersonMotion]) -> PosePrior:
    """Add the covariance of rotations (T, J, 3, 3) of motions about the means of their persons, where enough persons
    show it: that of the means, of joints that differ by build, taken from the whole.

    Between persons, the correlations of n persons count n of n + `PERSONS`, and the covariance is at most
    `MOST_BETWEEN` of the whole.
    """
    mean = so3.from_quat_wxyz(prior.mean_quat_wxyz)
    rows = dict[str, list[tuple[float, Array]]]()
    for own, m in zip(local, motions, strict=True):
        vectors = so3.log(np.swapaxes(mean, -1, -2) @ own[:, 1:]).mean(axis=0).ravel()
        rows.setdefault(m.subject, []).append((len(m.R_world_bone) / m.rate_hz, vectors))
    long = [own for own in rows.values() if sum(seconds for seconds, _ in own) >= PERSON_S]
    if len(long) < PERSONS:
        return prior
    means = np.array([np.average([v for _, v in own], axis=0, weights=[s for s, _ in own]) for own in long])
    moment, mirror = means.T @ means / len(means), _mirror_of(prior.joints)
    moment = (moment + mirror @ moment @ mirror.T) / 2
    built = np.repeat([joint in BUILT for joint in prior.joints[1:]], 3)
    average, uneven = _even_spine(prior.joints)
    between = average @ (moment * np.outer(built, built)) @ average.T + np.kron(uneven, np.diag(UNEVEN**2)) / 2
    share = PERSONS / (len(long) + PERSONS)
    between = (1 - share) * between + share * np.diag(np.diagonal(between))
    root = np.linalg.cholesky(prior.covariance)
    values, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, between).T))
    within = root @ (axes * (1 - np.clip(values, 0.0, MOST_BETWEEN))) @ axes.T @ root.T
    return replace(prior, covariance_about_posture=_firm(within))


def _mirror_of(names: Sequence[str]) -> Array:
    """Matrix that mirrors rotation vectors (3 (J - 1)): they change sign, but for the part across the mirror."""
    return np.kron(np.eye(len(names) - 1)[np.array(_other_side(names))[1:] - 1], -_MIRROR)


def _even_spine(names: Sequence[str]) -> tuple[Array, Array]:
    """Matrix (3 (J - 1), 3 (J - 1)) that shares the bend of the spine, and (J - 1, J - 1) of what differs from it."""
    spine = np.ix_(*2 * [[names.index(joint) - 1 for joint in SPINE]])
    share, uneven = np.eye(len(names) - 1), np.zeros((len(names) - 1, len(names) - 1))
    share[spine], uneven[spine] = 1 / len(SPINE), np.eye(len(SPINE)) - 1 / len(SPINE)
    return np.asarray(np.kron(share, np.eye(3))), uneven


def shrunk(prior: PosePrior, known: PosePrior, share: float) -> PosePrior:
    """Return the prior with the moments of a mixture of two. share: of the known one, 0 to 1."""
    mean, other = (so3.from_quat_wxyz(p.mean_quat_wxyz) for p in (prior, known))
    mean, covariance = _mixture(mean, other, prior.covariance, known.covariance, share)

    def mixed(own: Array, given: Array) -> Array:
        return (1 - share) * own + share * given

    about = prior.covariance_about_posture
    if about is not None:
        given = known.covariance_about_posture
        about = mixed(about, known.covariance if given is None else given)
    return PosePrior(
        prior.joints,
        so3.to_quat_wxyz(mean),
        covariance,
        np.sqrt(mixed(prior.sigma_jerk**2, known.sigma_jerk**2)),
        float(np.sqrt((1 - share) * prior.sigma_root_jerk**2 + share * known.sigma_root_jerk**2)),
        about,
    )


def _mixture(mean: Array, other: Array, covariance: Array, others: Array, share: float) -> tuple[Array, Array]:
    """Moments of a mixture of two: means (J - 1, 3, 3), covariances (3 (J - 1), 3 (J - 1)), share of the other one."""
    apart = so3.log(np.swapaxes(mean, -1, -2) @ other)
    spread = (1 - share) * covariance + share * others + share * (1 - share) * np.outer(apart, apart)
    return mean @ so3.exp(share * apart), spread


def _firm(covariance: Array) -> Array:
    """The covariance with `LEAST` as its smallest standard deviation."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.maximum(values, LEAST**2) @ axes.T)


def of_mixed_rigs(names: Sequence[str], mean: Array, covariance: Array, following: float) -> tuple[Array, Array]:
    """Return the prior, mean (J - 1, 3, 3) and covariance of rotation vectors, of motions of several rigs: with the
    bend of the trunk shared evenly (mean, variance and correlations), and clavicles a share of which follow the arms.
    """
    spine = [names.index(joint) - 1 for joint in SPINE]
    mean, (average, uneven) = mean.copy(), _even_spine(names)
    bend = so3.log(mean[spine[0]] @ mean[spine[1]] @ mean[spine[2]] @ mean[spine[3]])
    mean[spine] = so3.exp(bend / len(spine))
    covariance = average @ covariance @ average.T + np.kron(uneven, np.diag(UNEVEN**2))
    lowered, follow, own = mean.copy(), np.eye(len(covariance)), np.zeros(len(covariance))
    for joint in CLAVICLES:
        j, arm = (names.index(n) - 1 for n in (joint, joint.replace("Shoulder", "Arm")))
        rows = slice(3 * j, 3 * j + 3)
        follow[rows, rows], follow[rows, 3 * arm : 3 * arm + 3] = 0.0, RHYTHM
        own[rows] = CLAVICLE**2
        lowered[j] = so3.about_axis("x", -LOWERED if joint.startswith("Left") else LOWERED)
    return _mixture(mean, lowered, covariance, follow @ covariance @ follow.T + np.diag(own), following)
