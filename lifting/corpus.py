"""Motion capture as a lifter's training needs it: many clips at 60 Hz, each in one split."""

from __future__ import annotations

import tomllib
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lifting.windows import Body
from rtof_kin import kinematics, mocap
from rtof_kin import rotations as so3
from rtof_kin.errors import FileFormatError, ShapeError

Array = NDArray[np.float32]
RATE_HZ = 60.0
BENCHMARK_SPLIT = Path(__file__).parent.parent / "benchmarks" / "split.toml"
"""The split that every table of this package uses, in a checkout of its source."""
SPLITS = ("train", "validation", "test", "excluded")


@dataclass(frozen=True)
class Corpus:
    """Many clips one after the other."""

    names: tuple[str, ...]
    """J joint names, root first."""
    parents: tuple[int, ...]
    """(J,) index of each joint's parent, -1 for the root."""
    p_world_root: Array
    """(N, 3) m, z up, floor at z = 0; N frames of all clips, at 60 Hz."""
    R_world_bone: Array
    """(N, J, 3, 3)."""
    joint_offsets: Array
    """(C, J, 3) m, of each clip."""
    start: NDArray[np.int64]
    """(C + 1,) first frame of each clip, and N."""
    subjects: tuple[str, ...]
    """C subjects."""
    split: tuple[str, ...]
    """C of `SPLITS`."""

    def __post_init__(self) -> None:
        N, J, C = len(self.p_world_root), len(self.names), len(self.subjects)
        shapes = {
            "p_world_root": (self.p_world_root.shape, (N, 3)),
            "R_world_bone": (self.R_world_bone.shape, (N, J, 3, 3)),
            "joint_offsets": (self.joint_offsets.shape, (C, J, 3)),
            "start": (self.start.shape, (C + 1,)),
            "split": ((len(self.split),), (C,)),
            "parents": ((len(self.parents),), (J,)),
        }
        for name, (have, want) in shapes.items():
            if have != want:
                raise ShapeError(f"corpus {name}: expected shape {want}, got {have}")
        if C == 0 or self.start[0] != 0 or self.start[-1] != N or np.any(np.diff(self.start) < 1):
            raise ShapeError(
                "corpus start: does not cut the frames into clips of one or more frames"
            )
        for name in ("p_world_root", "R_world_bone", "joint_offsets"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ShapeError(f"corpus {name}: not finite; leave gaps out of the clips")
        unknown = sorted(set(self.split) - set(SPLITS))
        if unknown:
            raise ShapeError(f"corpus split: no {', '.join(unknown)}; known: {', '.join(SPLITS)}")

    def frames(self, clip: int) -> slice:
        """The frames of a clip, by its number."""
        return slice(int(self.start[clip]), int(self.start[clip + 1]))

    def clips(self, split: str, required: bool = True) -> list[int]:
        """Numbers of the clips of a split.

        Raises:
            ShapeError: there is none, and one is required.
        """
        found = [c for c, s in enumerate(self.split) if s == split]
        if required and not found:
            raise ShapeError(
                f"corpus: no clip is in the split '{split}' (subjects: "
                f"{', '.join(sorted(set(self.subjects)))}); change the split"
            )
        return found

    def positions(self, clip: int, joint_offsets: Array | None = None) -> Array:
        """Joints (T, J, 3) in world, m, of a clip by its number, on its own or another skeleton."""
        frames = self.frames(clip)
        offsets = self.joint_offsets[clip] if joint_offsets is None else joint_offsets
        return kinematics.positions(
            self.parents,
            offsets.astype(np.float64),
            self.p_world_root[frames].astype(np.float64),
            self.R_world_bone[frames].astype(np.float64),
        ).astype(np.float32)

    def skeletons(self, split: str, at_most: int) -> list[Array]:
        """Joint offsets (J, 3) of different bodies in a split, those with most frames first."""
        frames: dict[bytes, int] = {}
        bodies: dict[bytes, Array] = {}
        for c in self.clips(split):
            key = np.round(self.joint_offsets[c], 3).tobytes()
            frames[key] = frames.get(key, 0) + int(self.start[c + 1] - self.start[c])
            bodies.setdefault(key, self.joint_offsets[c])
        return [bodies[key] for key in sorted(frames, key=lambda k: -frames[k])[:at_most]]

    def body(self) -> Body:
        """The joints, and the mean bones of the training clips."""
        offsets = self.joint_offsets[self.clips("train", required=False) or slice(None)]
        unknown = Body(self.names, self.parents, ())
        nominal = unknown.bones_of(torch.from_numpy(offsets.mean(axis=0)))
        return Body(self.names, self.parents, tuple(float(x) for x in nominal))

    def save(self, path: str | Path) -> Path:
        """Write an .npz file that `read_corpus` reads, orientations as quaternions."""
        path = Path(path)
        quat = so3.to_quat_wxyz(self.R_world_bone.reshape(-1, 1, 3, 3))
        np.savez_compressed(
            path, joint_names=self.names, parents=self.parents, p_world_root=self.p_world_root,
            quat_wxyz=quat.reshape(-1, len(self.names), 4).astype(np.float32),
            offsets=self.joint_offsets, start=self.start, subjects=self.subjects, split=self.split,
        )  # fmt: skip
        return path


def make_corpus(clips: Iterable[mocap.MocapClip], split_of: Mapping[str, str]) -> Corpus:
    """Put clips together.

    Args:
        clips: motion of the 21 joints at 60 Hz, z up, floor at z = 0.
        split_of: the split of each subject; those not named train.

    Raises:
        ShapeError: no clip, or one that is not at 60 Hz.
    """
    rows = list(clips)
    if not rows:
        raise ShapeError("corpus: there is no clip")
    for row in rows:
        if abs(row.poses.rate_hz / RATE_HZ - 1) > 1e-3:
            raise ShapeError(
                f"corpus: clip {row.name} is at {row.poses.rate_hz:g} Hz; resample it to {RATE_HZ:g}"
            )
    return Corpus(
        mocap.NAMES,
        mocap.PARENTS,
        np.concatenate([row.poses.p_world_joint[:, 0] for row in rows]).astype(np.float32),
        np.concatenate([row.poses.R_world_bone for row in rows]).astype(np.float32),
        np.stack([row.joint_offsets for row in rows]).astype(np.float32),
        np.concatenate([[0], np.cumsum([len(row.poses) for row in rows])]),
        tuple(row.subject for row in rows),
        tuple(split_of.get(row.subject, "train") for row in rows),
    )


def read_corpus(path: str | Path, split: str | Path | None = None) -> Corpus:
    """Read a corpus from an .npz file, or from a folder of motion capture.

    Args:
        path: written by `Corpus.save`, or a folder with an ``index.csv``.
        split: a TOML file, see `read_split`, by which a folder is split; where not given, the
            folder's ``split.toml``, else the one of the benchmarks. An .npz file carries its own.

    Raises:
        FileFormatError: the file is no corpus, or there is no split.
    """
    path = Path(path)
    if path.is_dir():
        return make_corpus(mocap.read_corpus(path), read_split(split or _find_split(path)))
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return _from_arrays(data)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(
            path, f"not a corpus of motion ({error}); make one with Corpus.save, or name a folder"
        ) from error


def _find_split(folder: Path) -> Path:
    for path in (folder / "split.toml", BENCHMARK_SPLIT):
        if path.is_file():
            return path
    raise FileFormatError(
        folder / "split.toml",
        "a folder of motion needs a split of its subjects: write lists of subjects named test and "
        "validation there",
    )


def _from_arrays(data: Mapping[str, NDArray[Any]]) -> Corpus:
    if "R_world_bone" in data:
        R, p_root = data["R_world_bone"], data["p_world_joint"][:, 0]
    else:
        R, p_root = so3.from_quat_wxyz(data["quat_wxyz"]), data["p_world_root"]
    return Corpus(
        tuple(str(name) for name in data["joint_names"]),
        tuple(int(parent) for parent in data["parents"]),
        p_root.astype(np.float32),
        R.astype(np.float32),
        data["offsets"].astype(np.float32),
        data["start"].astype(np.int64),
        tuple(str(subject) for subject in data["subjects"]),
        tuple(str(split) for split in data["split"]),
    )


def read_split(path: str | Path) -> dict[str, str]:
    """The split of each subject that a TOML file lists; subjects it does not list train.

    The file has lists of subjects named ``test``, ``validation`` and ``excluded``; its tables are not
    read.

    Raises:
        FileFormatError: not TOML, an unknown list, or a subject in two lists.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(path, f"not a readable split: {error}") from error
    split_of: dict[str, str] = {}
    for split, subjects in table.items():
        if isinstance(subjects, dict):
            continue
        if split not in SPLITS or not isinstance(subjects, list):
            raise FileFormatError(path, f"'{split}' is no list of one of: {', '.join(SPLITS)}")
        for subject in map(str, subjects):
            if subject in split_of:
                raise FileFormatError(path, f"subject {subject} stands in two lists")
            split_of[subject] = split
    return split_of
