"""Make models/joint_errors.npz: what is wrong with the joints that are regressed from a real detector's points.

``python -m models.build_joint_errors CORPUS`` with CORPUS as in benchmarks/README.md. The training subjects' motion
is seen by cameras all around; the simulated points of the fitted detector, without exchanges and jumps, are
regressed to joints. Their errors (px x depth / f) are described by `lifting.joint_errors.JointErrors`: the mean
by least squares, covariances of pairs of frames by the direction of the view and the lag between them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lifting.corpus import Corpus, read_corpus
from lifting.joint_errors import MEMORY_S, hidden_joints, harmonics
from rtof_kin.core.array_types import Array

CAMERAS, SEED = 6, 0
LAGS = (0, 1, 2, 3, 5, 8, 12, 18, 26)
"""Distances of the frames of a pair."""
LARGEST = 0.2
"""Errors are clipped there, m."""
RANK = 8
RIDGE = 300.0
"""Weight of zero for the mean's coefficients, in frames."""
