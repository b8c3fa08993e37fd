"""Make models/pose_prior.npz: how free motion poses and how it jerks, from the training subjects alone.

``python models/build_pose_prior.py CORPUS`` with CORPUS as in benchmarks/README.md. Its rigs are several, so
the prior has an even spine.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lifting.training.corpus import read_corpus
from lifting.training.settings import motions_of
from rtof_kin.body.pose_prior_fit import fit_pose_prior


def main(corpus_path: str) -> None:
    """Read, fit, write."""
    corpus = read_corpus(corpus_path)
    prior = fit_pose_prior(corpus.names, corpus.parents, motions_of(corpus))
    np.savez_compressed(Path(__file__).with_name("pose_prior.npz"), **prior.arrays())


if __name__ == "__main__":
    main(sys.argv[1])
