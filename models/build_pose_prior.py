"""Make models/pose_prior.npz: how free motion poses and how it jerks, from the training subjects alone.

``python models/build_pose_prior.py CORPUS`` with CORPUS as in benchmarks/README.md. Every motion counts
twice, as it is and mirrored; orientations are low-passed at 10 Hz, as optical markers jitter.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lifting.corpus import read_corpus
from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals

CUTOFF_HZ, LEAST_JERK = 10.0, 200.0
MIRROR = np.diag([1.0, -1.0, 1.0])
LEAST_SHOULDER = np.radians(6.0)
"""Clavicles hardly move in the skeletons of this corpus; they do in people."""


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
    covariance = np.cov(vectors.reshape(len(vectors), -1).T)
    for j, name in enumerate(names[1:]):
        if name.endswith("Shoulder"):
            rows = slice(3 * j, 3 * j + 3)
            covariance[rows, rows] += np.eye(3) * LEAST_SHOULDER**2
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


if __name__ == "__main__":
    main(sys.argv[1])
