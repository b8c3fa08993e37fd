"""Training motion from datasets that users have obtained themselves.

Their licences keep the data, and what is trained on them, with the user: a corpus carries a note on
that, which goes into every lifter made of it. Takes that test are never opened here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lifting.body import Body
from lifting.corpus import RATE_HZ, Corpus, join_clips
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets import human36m, total_capture
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Called with the takes done, their number, and the last one's name; where it was left out, its name is
followed by ``skipped:`` and the reason."""
TOTAL_CAPTURE_VALIDATION = (("S1", "walking3"), ("S2", "freestyle2"), ("S3", "acting2"))
"""Training takes of Total Capture that only measure a training: one of each subject, each of a kind."""
HUMAN36M_VALIDATION = tuple(("S8", action) for action in ("Discussion", "Sitting", "Walking"))
"""Those of Human3.6M; an action stands for all of its numbers, such as 'Walking 1'."""
MIN_SECONDS = 0.5
"""Shorter pieces between two gaps are left out."""
_ON_WEIGHTS = " Weights trained on it come under the same terms and stay with its licensee."


@dataclass(frozen=True)
class _Source:
    """A dataset as far as training needs it."""

    root: Path
    takes: list[tuple[str, str]]
    """Subject and name of those that may train."""
    read: Callable[[str, str], tuple[PoseSequence, Array]]
    """Poses and joint offsets of a take; frames not wholly finite and valid are cut out."""
    parents: tuple[int, ...]
    rate_hz: float
    acknowledgement: str


def total_capture_corpus(
    root: str | Path,
    progress: Progress | None = None,
    validation: Collection[tuple[str, str]] = TOTAL_CAPTURE_VALIDATION,
) -> Corpus:
    """The paper's training takes: S1 to S3, rom1-3, walking1, walking3, freestyle1-2, acting1-2.

    They are cut where the reference is known to jump or lacks a joint. The floor of each, found as in
    `rtof_kin.simulation.mocap.read_corpus`, lies at z = 0.

    Args:
        root: folder of the dataset, see `rtof_kin.datasets.total_capture`.
        progress: told of every take, also of one that is left out because it is missing or damaged.
        validation: (subject, take) of those held out for the validation curve. Where it is empty,
            everything trains and nothing is measured.

    Raises:
        FileFormatError: there is nothing of the dataset, or no take to train on could be read.
    """
    data = total_capture.TotalCapture(root)

    def read(subject: str, name: str) -> tuple[PoseSequence, Array]:
        take = data.take(subject, name)
        return take.truth, take.joint_offsets

    source = _Source(
        Path(root),
        list(total_capture.TRAIN),
        read,
        SkeletonModel.default().parents,
        RATE_HZ,
        total_capture.ACKNOWLEDGEMENT,
    )
    return _corpus(source, lambda *take: take in validation, progress)


def human36m_corpus(
    root: str | Path,
    progress: Progress | None = None,
    validation: Collection[tuple[str, str]] = HUMAN36M_VALIDATION,
) -> Corpus:
    """Everything of S1, S5, S6, S7 and S8, at 50 Hz and with 17 joints; not S9 and S11, who test.

    There are positions alone, so the segments' orientations come from them and their twist from the
    parents. Shoulders and spine are not rigid: joints are learnt where they were recorded.

    Args:
        root: folder with ``data_3d_h36m.npz``, see `rtof_kin.datasets.human36m`. Neither keypoints nor
            cameras are needed, as windows are watched by virtual cameras.
        progress: told of every action, also of one that is left out because it is damaged.
        validation: (subject, action without number) of those held out for the validation curve.

    Raises:
        FileFormatError: the archive cannot be read, or has nothing to train on.
    """
    data = human36m.Human36M(root)
    parents, names = data.skeleton.parents, data.skeleton.names

    def read(subject: str, action: str) -> tuple[PoseSequence, Array]:
        motion = data.motion(subject, action)
        p, offsets = motion.p_world_joint, motion.joint_offsets
        R = kinematics.rotations_from_positions(parents, offsets, p)
        return PoseSequence(np.arange(len(p)) / motion.rate_hz, p, R, names), offsets

    takes = [take for take in data.sequences if take[0] in human36m.SUBJECTS_TRAIN]
    source = _Source(Path(root), takes, read, parents, human36m.RATE_HZ, human36m.ACKNOWLEDGEMENT)
    return _corpus(
        source, lambda subject, action: (subject, action.rstrip(" 0123456789")) in validation, progress
    )


def _corpus(source: _Source, validates: Callable[[str, str], bool], progress: Progress | None) -> Corpus:
    """All takes that can be read; an error if none of those that train can."""

    def clips() -> Iterator[tuple[MocapClip, str]]:
        trained, problems = 0, [""]
        for done, (subject, name) in enumerate(source.takes, start=1):
            note = f"{subject} {name}"
            split = "validation" if validates(subject, name) else "train"
            try:
                pieces = _pieces(source, subject, name)
            except RtofError as error:
                note += f" skipped: {error}"
                problems.append(note)
            else:
                yield from ((piece, split) for piece in pieces)
                trained += split == "train"
            if progress:
                progress(done, len(source.takes), note)
        if not trained:
            first = "; first of all: ".join(problems[:2])
            raise FileFormatError(source.root, f"no take to train on could be read{first}")

    note = source.acknowledgement + _ON_WEIGHTS
    return join_clips(clips(), source.parents, source.rate_hz, note)


def _pieces(source: _Source, subject: str, name: str) -> list[MocapClip]:
    """The stretches of a take without a gap, its floor at z = 0.

    Raises:
        FileFormatError: none is long enough. Errors of the dataset pass through.
    """
    poses, offsets = source.read(subject, name)
    p = poses.p_world_joint
    good = poses.valid.all(axis=1) & np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))
    runs = [(i, k) for i, k in signals.runs(good) if k - i >= MIN_SECONDS * poses.rate_hz]
    if not runs:
        raise FileFormatError(source.root, f"{subject} {name}: nowhere {MIN_SECONDS:g} s without a gap")
    feet = Body(poses.names, source.parents, ()).feet
    floor = np.percentile(p[good][:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
    on_floor = PoseSequence(poses.times, p - np.array([0.0, 0.0, floor]), poses.R_world_bone, poses.names)
    return [MocapClip(f"{subject} {name}[{i}:{k}]", on_floor[i:k], offsets, subject) for i, k in runs]
