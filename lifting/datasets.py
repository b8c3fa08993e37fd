"""Training motion from datasets that users have obtained themselves.

Their licences keep the data, and what is trained on them, with the user: a corpus carries a note on that
into every lifter. Test takes are never opened here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Final

import numpy as np

from lifting.body import Body
from lifting.corpus import RATE_HZ, Corpus, join_clips
from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets import human36m, total_capture
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip

Progress = Callable[[int, int, str], None]
"""Called with the takes done, their number, and the last one's name, followed by ``skipped:`` and the
reason if it was left out."""
Take = tuple[str, str]
"""Subject and name."""
TOTAL_CAPTURE_VALIDATION: Final = (("S1", "walking3"), ("S2", "freestyle2"), ("S3", "acting2"))
"""Training takes of Total Capture used for validation: one of each subject, each of another kind."""
HUMAN36M_VALIDATION: Final = tuple(("S8", action) for action in ("Discussion", "Sitting", "Walking"))
"""Those of Human3.6M; an action stands for all of its numbers, such as 'Walking 1'."""
MIN_SECONDS: Final = 0.5
"""Least duration of a piece between two gaps, s."""
_ON_WEIGHTS = " Weights trained on it come under the same terms and stay with its licensee."


def total_capture_corpus(
    root: str | Path, progress: Progress | None = None, validation: Collection[Take] = TOTAL_CAPTURE_VALIDATION
) -> Corpus:
    """Read the paper's training takes: S1 to S3, rom1-3, walking1, walking3, freestyle1-2, acting1-2.

    They are cut where the reference jumps or lacks a joint, and moved to a floor at z = 0.

    Args:
        root: folder of the dataset, see `rtof_kin.datasets.total_capture`. progress: see `Progress`.
        validation: takes for the validation curve; if empty, all takes train.

    Raises:
        FileFormatError: the folder is not the dataset, or no take to train on could be read.
    """
    data = total_capture.TotalCapture(root)

    def pieces(subject: str, name: str) -> list[MocapClip]:
        take = data.take(subject, name)
        return _pieces(Path(root), (subject, name), take.truth, take.joint_offsets, parents)

    parents, takes = SkeletonModel.default().parents, list(total_capture.TRAIN)
    clips = _clips(Path(root), takes, pieces, set(validation), progress)
    return join_clips(clips, parents, RATE_HZ, total_capture.ACKNOWLEDGEMENT + _ON_WEIGHTS)


def human36m_corpus(
    root: str | Path, progress: Progress | None = None, validation: Collection[Take] = HUMAN36M_VALIDATION
) -> Corpus:
    """Read S1, S5, S6, S7 and S8 at 50 Hz with 17 joints.

    The data are positions, so orientations are computed from them with the twist of their parents;
    shoulders and spine are not rigid, so recorded joints are kept.

    Args:
        root: folder with ``data_3d_h36m.npz``, see `rtof_kin.datasets.human36m`. progress: see `Progress`.
        validation: (subject, action without number) for the validation curve.

    Raises:
        FileFormatError: the archive cannot be read, or has nothing to train on.
    """
    data = human36m.Human36M(root)
    parents, names = data.skeleton.parents, data.skeleton.names

    def pieces(subject: str, action: str) -> list[MocapClip]:
        motion = data.motion(subject, action)
        p, offsets = motion.p_world_joint, motion.joint_offsets
        R = kinematics.rotations_from_positions(parents, offsets, p)
        poses = PoseSequence(np.arange(len(p)) / motion.rate_hz, p, R, names)
        return _pieces(Path(root), (subject, action), poses, offsets, parents)

    takes = [take for take in data.sequences if take[0] in human36m.SUBJECTS_TRAIN]
    validates = {(subject, name) for subject, name in takes if (subject, name.rstrip(" 0123456789")) in validation}
    clips = _clips(Path(root), takes, pieces, validates, progress)
    return join_clips(clips, parents, human36m.RATE_HZ, human36m.ACKNOWLEDGEMENT + _ON_WEIGHTS)


def _clips(
    root: Path,
    takes: list[Take],
    pieces: Callable[[str, str], list[MocapClip]],
    validation: Collection[Take],
    progress: Progress | None,
) -> Iterator[tuple[MocapClip, str]]:
    """Pieces of all takes that can be read, with their split; an error if no training take can."""
    trained, problems = 0, [""]
    for done, take in enumerate(takes, start=1):
        note, split = " ".join(take), "validation" if take in validation else "train"
        try:
            clips = pieces(*take)
        except RtofError as error:
            note += f" skipped: {error}"
            problems.append(note)
        else:
            yield from ((clip, split) for clip in clips)
            trained += split == "train"
        if progress:
            progress(done, len(takes), note)
    if not trained:
        first = "; first of all: ".join(problems[:2])
        raise FileFormatError(root, f"no take to train on could be read{first}")


def _pieces(root: Path, take: Take, poses: PoseSequence, offsets: Array, parents: tuple[int, ...]) -> list[MocapClip]:
    """Stretches of a take without gaps, on a floor at z = 0; an error if none is long enough."""
    subject, name = take
    p = poses.p_world_joint
    good = poses.valid.all(axis=1) & np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))
    runs = [(i, k) for i, k in signals.runs(good) if k - i >= MIN_SECONDS * poses.rate_hz]
    if not runs:
        raise FileFormatError(root, f"{subject} {name}: nowhere {MIN_SECONDS:g} s without a gap")
    feet = Body(poses.names, parents, ()).feet
    floor = np.percentile(p[good][:, feet, 2].min(axis=1), 5) - ANKLE_HEIGHT
    on_floor = PoseSequence(poses.times, p - np.array([0.0, 0.0, floor]), poses.R_world_bone, poses.names)
    return [MocapClip(f"{subject} {name}[{i}:{k}]", on_floor[i:k], offsets, subject) for i, k in runs]
