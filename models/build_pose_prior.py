"""Make models/pose_prior.npz: how free motion poses and how it jerks, from the training subjects alone.

``python models/build_pose_prior.py CORPUS`` with CORPUS as in benchmarks/README.md. Every motion counts
twice, as it is and mirrored; orientations are low-passed at 10 Hz, as optical markers jitter.

Rigs differ in where the trunk bends (CMU's at two of four joints, others at one or at all) and in how much
clavicles move (hardly, in this corpus). So the bend between pelvis and upper trunk, which they agree on, is
shared evenly by the four joints of the spine, and clavicles follow the arms as those of people do.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lifting.corpus import read_corpus
from rtof_kin.body import kinematics
from rtof_kin.body.neutral_posture import CLAVICLES, SPINE
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array

CUTOFF_HZ, LEAST_JERK = 10.0, 200.0
MIRROR = np.diag([1.0, -1.0, 1.0])
UNEVEN = np.radians([2.0, 3.0, 2.0])
"""Standard deviation of a joint of the spine about its share of the bend, about x, y, z, rad."""
RHYTHM = np.diag([0.25, 0.0, 0.15])
"""Turn of a clavicle by the turn of the arm relative to it: about x (elevation), y, z (protraction). An arm
that is lowered by 90 degrees lowers it by 20 (scapulohumeral rhythm)."""
LOWERED = np.radians(4.0)
"""Mean of the clavicles below their T-pose, with arms that mostly hang, rad: between rigs whose clavicles
follow the arms and rigs whose clavicles do not move."""
CLAVICLE = np.radians([6.0, 5.0, 6.0])
"""Standard deviation of a clavicle about what the arm tells, rad."""
LEAST = np.radians(0.3)
"""Smallest standard deviation of any combination of joints, rad."""


def main(corpus_path: str) -> None:
    """Read, fit, write."""
    corpus = read_corpus(corpus_path)
    names = corpus.names
    other = [
        names.index(n.replace("Left", "?").replace("Right", "Left").replace("?", "Right")) for n in names
    ]
    local, jerk, root_jerk = [], [], []
    for clip in corpus.clips("train"):
        frames = corpus.frames(clip)
        R = corpus.R_world_bone[frames].astype(float)
        if len(R) < 30:
            continue
        R = so3.nearest_rotation(signals.low_pass(R, 60.0, CUTOFF_HZ))
        own = kinematics.local_rotations(corpus.parents, R)
        local += [own, MIRROR @ own[:, other] @ MIRROR]
        turns = so3.log(np.swapaxes(own[:-1], -1, -2) @ own[1:])
        jerk.append(np.diff(turns, 2, axis=0) * 60.0**3)
        p = signals.low_pass(corpus.p_world_root[frames].astype(float), 60.0, CUTOFF_HZ)
        root_jerk.append(np.diff(p, 3, axis=0) * 60.0**3)
    every = np.concatenate(local)[:, 1:]
    mean = so3.nearest_rotation(every.mean(axis=0))
    for _ in range(10):  # the mean rotation: where the mean rotation vector vanishes
        vectors = so3.log(np.swapaxes(mean, -1, -2) @ every)
        mean = mean @ so3.exp(vectors.mean(axis=0))
    mean, covariance = with_even_spine(names, mean, np.cov(vectors.reshape(len(vectors), -1).T))
    mean, covariance = with_moving_clavicles(names, mean, covariance)
    values, axes = np.linalg.eigh(covariance)
    covariance = axes * np.maximum(values, LEAST**2) @ axes.T
    squares = np.concatenate(jerk) ** 2
    size = np.sqrt(squares.sum(axis=-1).mean(axis=0) / 3)
    size = (size + size[other]) / 2
    np.savez_compressed(
        Path(__file__).with_name("pose_prior.npz"),
        mean_quat_wxyz=so3.to_quat_wxyz(mean),
        covariance=covariance,
        sigma_jerk=np.maximum(size, LEAST_JERK),
        sigma_root_jerk=np.sqrt((np.concatenate(root_jerk) ** 2).mean()),
    )


def with_even_spine(names: Sequence[str], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Share the bend of the trunk evenly: the same mean, variance and correlations for each of its joints.

    Args:
        names: J joints. mean: (J - 1, 3, 3). covariance: (3 (J - 1), 3 (J - 1)) of rotation vectors.
    """
    spine = [names.index(joint) - 1 for joint in SPINE]
    mean, share = mean.copy(), np.zeros((len(mean), len(mean)))
    bend = so3.log(mean[spine[0]] @ mean[spine[1]] @ mean[spine[2]] @ mean[spine[3]])
    mean[spine] = so3.exp(bend / len(spine))
    np.fill_diagonal(share, 1.0)
    share[np.ix_(spine, spine)] = 1 / len(spine)
    average = np.kron(share, np.eye(3))
    uneven = np.zeros_like(share)
    uneven[np.ix_(spine, spine)] = np.eye(len(spine)) - 1 / len(spine)
    return mean, average @ covariance @ average.T + np.kron(uneven, np.diag(UNEVEN**2))


def with_moving_clavicles(names: Sequence[str], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Let clavicles follow the arms.

    Args:
        names, mean, covariance: as for `with_even_spine`.
    """
    mean, follow = mean.copy(), np.eye(len(covariance))
    own = np.zeros(len(covariance))
    for joint in CLAVICLES:
        j, arm = (names.index(n) - 1 for n in (joint, joint.replace("Shoulder", "Arm")))
        rows = slice(3 * j, 3 * j + 3)
        follow[rows, rows], follow[rows, 3 * arm : 3 * arm + 3] = 0.0, RHYTHM
        own[rows] = CLAVICLE**2
        mean[j] = so3.about_axis("x", -LOWERED if joint.startswith("Left") else LOWERED)
    return mean, follow @ covariance @ follow.T + np.diag(own)


if __name__ == "__main__":
    main(sys.argv[1])
