"""Pose prior of a corpus, which a lifter's file carries."""

from __future__ import annotations

from typing import Final, Literal, get_args

import numpy as np

from lifting.corpus import Corpus
from rtof_kin.body.neutral_posture import NeutralPosture, posture_from_t_pose
from rtof_kin.body.pose_prior import PosePrior, shipped_prior
from rtof_kin.body.pose_prior_fit import PersonMotion, fit_pose_prior, of_one_rig
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence

PriorChoice = Literal["auto", "even", "own", "none"]
"""Pose prior of a training. even: for several rigs; own: the trunk of the one rig; auto: one of the
two, by the skeletons; none: no prior, the shipped one is used."""
LEAST_FRAMES: Final = 30
"""Frames of the shortest clip that a prior is fitted to."""
PRIORS: Final = get_args(PriorChoice)


def prior_of_corpus(corpus: Corpus, choice: PriorChoice = "auto") -> PosePrior | None:
    """Return the pose prior of the training clips; None for 'none', for joints other than the package's 21
    and where every clip is too short.

    Args:
        choice: see `PriorChoice`.
    """
    motions = motions_of(corpus)
    table = read_skeleton_table(model_path("skeleton.toml"))
    if choice == "none" or not motions or (table.names, table.parents) != (corpus.names, corpus.parents):
        return None
    one_rig = of_one_rig(corpus.names, corpus.joint_offsets[corpus.clips("train")].astype(float))
    even = choice == "even" or (choice == "auto" and not one_rig)
    known = shipped_prior(corpus.names)
    return fit_pose_prior(corpus.names, corpus.parents, motions, even, postures_of(corpus), known)


def motions_of(corpus: Corpus) -> list[PersonMotion]:
    """Return the training clips of `LEAST_FRAMES` or more."""
    return [
        PersonMotion(
            corpus.subjects[clip],
            corpus.R_world_bone[corpus.frames(clip)].astype(float),
            corpus.p_world_root[corpus.frames(clip)].astype(float),
            corpus.rate_hz,
        )
        for clip in corpus.clips("train")
        if corpus.start[clip + 1] - corpus.start[clip] >= LEAST_FRAMES
    ]


def postures_of(corpus: Corpus) -> dict[str, NeutralPosture]:
    """Return the neutral postures of those training subjects who stand in a T-pose, from the first one.

    Args:
        corpus: of the 21-joint skeleton, with orientations in the link frames.
    """
    found: dict[str, NeutralPosture] = {}
    for clip in corpus.clips("train"):
        p, subject = corpus.positions(clip).astype(float), corpus.subjects[clip]
        if subject in found or len(p) < 2:
            continue
        times = np.arange(len(p)) / corpus.rate_hz
        R = corpus.R_world_bone[corpus.frames(clip)].astype(float)
        poses = PoseSequence(times, p, R, corpus.names)
        if (posture := posture_from_t_pose(poses, corpus.parents)) is not None:
            found[subject] = posture
    return found
