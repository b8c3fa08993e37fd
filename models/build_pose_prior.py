"""Make the shipped pose priors: how free motion poses and how it jerks, from the training subjects alone.

``python models/build_pose_prior.py CORPUS.npz`` makes pose_prior.npz, with CORPUS.npz of build_corpus.py;
``python models/build_pose_prior.py CORPUS --upright`` makes upright_prior.npz, with CORPUS as in benchmarks/README.md,
whose people stand, for `rtof_kin.inertial.likelihood`. The rigs of both are several, so they have an even spine.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lifting.training.corpus import read_corpus
from lifting.training.settings import motions_of
from rtof_kin.body.pose_prior_fit import FOLLOWING, LONGEST_S, fit_pose_prior


def main(corpus_path: str, upright: bool) -> None:
    """Read, fit, write."""
    corpus = read_corpus(corpus_path)
    following, longest_s = (1.0, np.inf) if upright else (FOLLOWING, LONGEST_S)
    motions = motions_of(corpus)
    prior = fit_pose_prior(corpus.names, corpus.parents, motions, following=following, longest_s=longest_s)
    name = "upright_prior.npz" if upright else "pose_prior.npz"
    np.savez_compressed(Path(__file__).with_name(name), **prior.arrays())


if __name__ == "__main__":
    main(sys.argv[1], "--upright" in sys.argv)
