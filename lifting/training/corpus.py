"""Motion capture for training: many clips at one rate, each in one split.

Training motion from datasets that users have obtained themselves. Their licences keep the data, and what is trained on
them, with the user: a corpus carries a note on that into every lifter. Test takes are never opened here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lifting.body import Body
from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, ShapeError, reading
from rtof_kin.core.files.arrays import read_npz_as_saved, write_npz
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation import mocap, mocap_families
from rtof_kin.simulation.mocap import ANKLE_HEIGHT, MocapClip

SPLITS: Final = ("train", "validation", "test", "excluded")
BENCHMARK_SPLIT: Final = Path(__file__).parents[2] / "benchmarks" / "split.toml"
"""Split of the benchmarks, in a checkout of the source."""


def read_split(path: str | Path) -> dict[str, str]:
    """Read the split of each subject listed in a TOML file; subjects that are not listed train.

    Its lists are named ``test``, ``validation`` and ``excluded``; tables are ignored. `FileFormatError`: not TOML, an
    unknown list, or a subject in two lists.
    """
    split_of: dict[str, str] = {}
    for split, subjects in load_toml(path).items():
        if isinstance(subjects, dict):
            continue
        if split not in SPLITS or not isinstance(subjects, list):
            raise FileFormatError(path, f"'{split}' is not a list of one of: {', '.join(SPLITS)}")
        for subject in map(str, subjects):
            if subject in split_of:
                raise FileFormatError(path, f"subject {subject} is in two lists")
            split_of[subject] = split
    return split_of


def find_split(folder: Path) -> Path:
    """Return the split file of a folder of motion: its ``split.toml``, else the one of the benchmarks, or raise
    `FileFormatError`.
    """
    for path in (folder / "split.toml", BENCHMARK_SPLIT):
        if path.is_file():
            return path
    raise FileFormatError(
        folder / "split.toml",
        "a folder of motion needs a split of its subjects: write lists of subjects named test and validation there",
    )


Array = NDArray[np.float32]
RATE_HZ: Final = 60.0  #: Usual rate of a corpus, Hz
RIGID_M: Final = 1e-3  #: Largest distance between recorded joints and those of rigid segments that is ignored, m
_SAME_BODY_M = 1e-3
_LARGEST_BYTES = 64 * 2**30


@dataclass(frozen=True)
class Corpus:
    """Concatenated clips."""

    names: tuple[str, ...]  #: J joint names, root first
    parents: tuple[int, ...]  #: (J,) index of each joint's parent, -1 for the root
    p_world_root: Array  #: (N, 3) m, z up, floor at z = 0; N frames of all clips
    R_world_bone: Array  #: (N, J, 3, 3)
    joint_offsets: Array  #: (C, J, 3) m, of each clip
    start: NDArray[np.int64]  #: (C + 1,) first frame of each clip, and N
    subjects: tuple[str, ...]  #: C subjects
    split: tuple[str, ...]  #: C of `SPLITS`
    rate_hz: float = RATE_HZ  #: Frames per second
    beyond_rigid: Array | None = None  #: (N, J, 3) recorded joints minus forward kinematics, m; None for zero
    acknowledgement: str = ""  #: Source of the motion as its licence asks; copied into every lifter

    def __post_init__(self) -> None:
        N, J, C = len(self.p_world_root), len(self.names), len(self.subjects)
        shapes: dict[str, tuple[int, ...]] = {
            "p_world_root": (N, 3),
            "R_world_bone": (N, J, 3, 3),
            "joint_offsets": (C, J, 3),
            "beyond_rigid": (N, J, 3),
            "start": (C + 1,),
            "split": (C,),
            "parents": (J,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise ShapeError(f"corpus {name}: expected shape {shape}, got {np.shape(value)}")
        if C == 0 or self.start[0] != 0 or self.start[-1] != N or np.any(np.diff(self.start) < 1):
            raise InvalidInputError("corpus start: must cut the frames into clips of one or more frames")
        for name in ("p_world_root", "R_world_bone", "joint_offsets", "beyond_rigid"):
            value = getattr(self, name)
            if value is not None and not np.all(np.isfinite(value)):
                raise InvalidInputError(f"corpus {name}: not finite; leave gaps out of the clips")
        if not 1 <= self.rate_hz < np.inf:
            raise InvalidInputError(f"corpus rate_hz: {self.rate_hz:g} Hz; give at least 1")
        unknown = sorted(set(self.split) - set(SPLITS))
        if unknown:
            raise InvalidInputError(f"corpus split: no {', '.join(unknown)}; known: {', '.join(SPLITS)}")

    def frames(self, clip: int) -> slice:
        """Return the frames of a clip."""
        return slice(int(self.start[clip]), int(self.start[clip + 1]))

    def clips(self, split: str, required: bool = True) -> list[int]:
        """Return the indices of the clips of a split, one of `SPLITS`. `InvalidInputError`: there is none, and one is
        required.
        """
        found = [c for c, s in enumerate(self.split) if s == split]
        if required and not found:
            raise InvalidInputError(
                f"corpus: no clip is in the split '{split}' (subjects: "
                f"{', '.join(sorted(set(self.subjects)))}); change the split"
            )
        return found

    def positions(self, clip: int, joint_offsets: Array | None = None) -> Array:
        """Return the joints (T, J, 3) of a clip in world, m, of its own or another skeleton's offsets (J, 3), m;
        `beyond_rigid` is added to both.
        """
        frames = self.frames(clip)
        offsets = self.joint_offsets[clip] if joint_offsets is None else joint_offsets
        motion = (x.astype(np.float64) for x in (offsets, self.p_world_root[frames], self.R_world_bone[frames]))
        p = kinematics.positions(self.parents, *motion)
        if self.beyond_rigid is not None:
            p += self.beyond_rigid[frames]
        return p.astype(np.float32)

    def in_shared_frames(self) -> Corpus:
        """Return the corpus with orientations and joint offsets in the frames that all rigs share."""
        R, offsets = self.R_world_bone.copy(), self.joint_offsets.copy()
        for clip, own in enumerate(self.joint_offsets):
            R_bone_shared = shared_frames(self.names, own)
            R[self.frames(clip)] = self.R_world_bone[self.frames(clip)] @ R_bone_shared
            offsets[clip] = to_shared(R_bone_shared, self.parents, own)
        return replace(self, R_world_bone=R, joint_offsets=offsets)

    def skeletons(self, split: str, at_most: int) -> list[Array]:
        """Return the joint offsets (J, 3), m, of the different bodies in a split, those with most frames first."""
        bodies: list[Array] = []
        frames: list[int] = []
        for c in self.clips(split):
            own, count = self.joint_offsets[c], int(self.start[c + 1] - self.start[c])
            same = (i for i, body in enumerate(bodies) if np.abs(body - own).max() < _SAME_BODY_M)
            if (i := next(same, -1)) >= 0:
                frames[i] += count
            else:
                bodies.append(own)
                frames.append(count)
        return [bodies[i] for i in np.argsort(-np.array(frames), kind="stable")[:at_most]]

    def body(self) -> Body:
        """Return the body with the mean bones of the training clips.

        Sensors are those of the package's 21 joints; other skeletons have no orientations of their own.
        """
        offsets = self.joint_offsets[self.clips("train", required=False) or slice(None)]
        bones = tuple(map(float, Body(self.names, self.parents, ()).bones_of(offsets.mean(axis=0))))
        table = read_skeleton_table(model_path("skeleton.toml"))
        own = (table.names, table.parents) == (self.names, self.parents)
        sensors = tuple(sensor.joint for sensor in table.sensors) if own else ()
        return Body(self.names, self.parents, bones, sensors)

    def digest(self) -> str:
        """Return the SHA-256 of motion, skeletons and split, hexadecimal."""
        texts = self.names, self.parents, self.subjects, self.split, self.rate_hz
        digest = hashlib.sha256(repr(texts).encode())
        arrays = [self.p_world_root, self.R_world_bone, self.joint_offsets, self.start]
        for array in [*arrays, *([] if self.beyond_rigid is None else [self.beyond_rigid])]:
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def save(self, path: str | Path) -> Path:
        """Write an .npz file for `read_corpus`, with orientations as quaternions."""
        path = Path(path)
        quat = so3.to_quat_wxyz(self.R_world_bone.reshape(-1, 1, 3, 3))
        arrays = {
            "joint_names": self.names,
            "parents": self.parents,
            "p_world_root": self.p_world_root,
            "quat_wxyz": quat.reshape(-1, len(self.names), 4).astype(np.float32),
            "offsets": self.joint_offsets,
            "start": self.start,
            "subjects": self.subjects,
            "split": self.split,
            "rate_hz": self.rate_hz,
            "acknowledgement": self.acknowledgement,
            "beyond_rigid": self.beyond_rigid,
        }
        known = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
        write_npz(path, known, overwrite=True)
        return path


def join_clips(
    clips: Iterable[tuple[mocap.MocapClip, str]],
    parents: tuple[int, ...] = mocap_families.PARENTS,
    rate_hz: float = RATE_HZ,
    acknowledgement: str = "",
) -> Corpus:
    """Make a corpus of clips of one skeleton. `InvalidInputError`: no clip, or clips with different joints.

    Args:
        clips: each with one of `SPLITS`; the same joints, any rate, z up, floor at z = 0, finite.
        parents: (J,) index of each joint's parent, -1 for the root.
        rate_hz: of the corpus, Hz; clips of another rate are resampled. acknowledgement: see `Corpus`.
    """
    names: tuple[str, ...] = ()
    arrays: list[tuple[Array, Array, Array]] = []
    offsets, subjects, splits = [], [], []
    for clip, split in clips:
        names = names or clip.poses.names
        if clip.poses.names != names or len(names) != len(parents):
            raise InvalidInputError(
                f"corpus: clip {clip.name} has the joints {', '.join(clip.poses.names)}, not the "
                f"{len(parents)} that the others have; make a corpus of each skeleton"
            )
        arrays.append(_at_rate(clip, parents, rate_hz))
        offsets.append(clip.joint_offsets.astype(np.float32))
        subjects.append(clip.subject)
        splits.append(split)
    if not arrays:
        raise InvalidInputError("corpus: there is no clip")
    p_root, R, beyond = (np.concatenate(parts) for parts in zip(*arrays, strict=True))
    start = np.concatenate([[0], np.cumsum([len(part[0]) for part in arrays])])
    further, bodies = beyond if np.abs(beyond).max() > RIGID_M else None, np.stack(offsets)
    return Corpus(
        names, parents, p_root, R, bodies, start, tuple(subjects), tuple(splits), rate_hz, further, acknowledgement
    )


def _at_rate(clip: mocap.MocapClip, parents: tuple[int, ...], rate_hz: float) -> tuple[Array, Array, Array]:
    """Resampled root (T, 3), orientations (T, J, 3, 3) and joints minus forward kinematics (T, J, 3); takes every
    n-th frame for an integer ratio of rates; else interpolates relative orientations on the geodesic, others linearly.
    """
    poses, offsets = clip.poses, clip.joint_offsets
    p_root, R = poses.p_world_joint[:, 0], poses.R_world_bone
    beyond = poses.p_world_joint - kinematics.positions(parents, offsets, p_root, R)
    ratio = poses.rate_hz / rate_hz
    if round(ratio) and abs(ratio / round(ratio) - 1) < 1e-3:
        p_root, R, beyond = (x[:: round(ratio)] for x in (p_root, R, beyond))
    else:
        first, last = poses.times[[0, -1]]
        steps = np.arange(int((last - first) * rate_hz * (1 + 1e-12)) + 1)
        times = np.minimum(first + steps / rate_hz, last)
        local = kinematics.local_rotations(parents, R)
        local = signals.interpolate_rotations(poses.times, local, times)
        R = kinematics.world_rotations(parents, local)
        p_root, beyond = (signals.interpolate(poses.times, x, times) for x in (p_root, beyond))
    return p_root.astype(np.float32), R.astype(np.float32), beyond.astype(np.float32)


def read_corpus(path: str | Path, split: str | Path | None = None) -> Corpus:
    """Read a corpus from an .npz file, or from a folder of motion capture. `FileFormatError`: the file is not a corpus,
    or there is no split.

    Args:
        path: written by `Corpus.save`, or a folder with an ``index.csv``.
        split: TOML file for a folder, see `read_split`; by default see `find_split`.
    """
    path = Path(path)
    if path.is_dir():
        split_of = read_split(split or find_split(path))
        return join_clips((clip, split_of.get(clip.subject, "train")) for clip in mocap.read_corpus(path))
    data = read_npz_as_saved(path, _LARGEST_BYTES, kinds="fiubU")
    problem = "not a corpus of motion ({}); make one with Corpus.save, or name a folder"
    with reading(path, problem, ValueError, LookupError, TypeError, OverflowError), np.errstate(invalid="ignore"):
        return _from_arrays(data)


def _from_arrays(data: Mapping[str, NDArray[Any]]) -> Corpus:
    if "R_world_bone" in data:
        R, p_root = data["R_world_bone"], data["p_world_joint"][:, 0]
    else:
        R, p_root = so3.from_quat_wxyz(data["quat_wxyz"]), data["p_world_root"]
    names, subjects, split = (tuple(map(str, data[key])) for key in ("joint_names", "subjects", "split"))
    p_root, R, offsets = (x.astype(np.float32) for x in (p_root, R, data["offsets"]))
    parents, start, further = tuple(map(int, data["parents"])), data["start"].astype(np.int64), data.get("beyond_rigid")
    further = None if further is None else further.astype(np.float32)
    rate_hz, note = float(data.get("rate_hz", RATE_HZ)), str(data.get("acknowledgement", ""))
    return Corpus(names, parents, p_root, R, offsets, start, subjects, split, rate_hz, further, note)


Progress = Callable[[int, int, str], None]
"""Called with the takes done, their number, and the last one's name, followed by ``skipped:`` and the
reason if it was left out."""
Take = tuple[str, str]  #: Subject and name
TOTAL_CAPTURE_VALIDATION: Final = (("S1", "walking3"), ("S2", "freestyle2"), ("S3", "acting2"))
"""Training takes of Total Capture used for validation: one of each subject, each of another kind."""
HUMAN36M_VALIDATION: Final = tuple(("S8", action) for action in ("Discussion", "Sitting", "Walking"))
"""Those of Human3.6M; an action stands for all of its numbers, such as 'Walking 1'."""
MIN_SECONDS: Final = 0.5  #: Least duration of a piece between two gaps, s
_ON_WEIGHTS = " Weights trained on it come under the same terms and stay with its licensee."


def total_capture_corpus(
    root: str | Path, progress: Progress | None = None, validation: Collection[Take] = TOTAL_CAPTURE_VALIDATION
) -> Corpus:
    """Read the paper's training takes: S1 to S3, rom1-3, walking1, walking3, freestyle1-2, acting1-2.

    They are cut where the reference jumps or lacks a joint, and moved to a floor at z = 0. `FileFormatError`: the
    folder is not the dataset, or no take to train on could be read.

    Args:
        root: folder of the dataset, see `rtof_kin.datasets.total_capture`. progress: see `Progress`.
        validation: takes for the validation curve; if empty, all takes train.
    """
    from rtof_kin.body.skeleton import SkeletonModel
    from rtof_kin.datasets import total_capture

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

    The data are positions, so orientations are computed from them with the twist of their parents; shoulders and spine
    are not rigid, so recorded joints are kept. `FileFormatError`: the archive cannot be read, or has nothing to train
    on.

    Args:
        root: folder with ``data_3d_h36m.npz``, see `rtof_kin.datasets.human36m`. progress: see `Progress`.
        validation: (subject, action without number) for the validation curve.
    """
    from rtof_kin.datasets import human36m

    data = human36m.Human36M(root)
    parents, names = data.skeleton.parents, data.skeleton.names

    def pieces(subject: str, action: str) -> list[MocapClip]:
        motion = data.motion(subject, action)
        p, offsets = motion.p_world_joint, motion.joint_offsets
        R = kinematics.rotations_from_positions(parents, offsets, p)
        poses = PoseSequence(np.arange(len(p)) / human36m.RATE_HZ, p, R, names)
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


def _pieces(
    root: Path, take: Take, poses: PoseSequence, offsets: NDArray[np.float64], parents: tuple[int, ...]
) -> list[MocapClip]:
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
