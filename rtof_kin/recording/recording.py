"""`Recording`: one take of one person, seen by cameras, by IMUs or by both; `RecordingReader`: spans of its folder.

The folder's format, ``recording.toml`` and the arrays that it names, is described in docs/recording.md.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import tomli_w
from numpy.typing import ArrayLike

from rtof_kin.body.pose_prior import NeutralPosture, PosePrior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.skeleton_table import ImageShifts
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz_blocks
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.over_time import ALL, Part, Stream
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration, ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_motion import VIDEO_CONSTANTS
from rtof_kin.formats.markers import MarkerSequence
from rtof_kin.recording.cameras import camera_and_keypoints, keypoint_file, keypoint_file_arrays
from rtof_kin.recording.index import (
    INDEX,
    SCHEMA_VERSION,
    SKELETONS,
    TRUTH,
    body_of,
    index_of,
    read_index,
    shipped,
    with_corrections,
)
from rtof_kin.recording.labels import Session
from rtof_kin.recording.sensor_files import IMUS, calibration_table, imu_arrays
from rtof_kin.recording.streams import Source, Streams, naming
from rtof_kin.vision.layouts import is_detector_point
from rtof_kin.vision.lift_points import LiftPoints

_TRUTH: Final = "truth.npz"
_LABELS: Final = ("name", "session", "notes")  #: Fields and tables of ``recording.toml`` that nothing is computed from


class RecordingSource(ABC):
    """A recording of which any span of time can be had: a `Recording` in memory, or a `RecordingReader` of its folder.

    Its time axis is that of the frames of its first camera, or of the samples of its sensors.
    """

    name: str  #: Title in reports

    @property
    @abstractmethod
    def streams(self) -> Streams:
        """All that changes over time."""

    @property
    @abstractmethod
    def facts(self) -> Recording:
        """The recording, of whose samples some may be left out."""

    @abstractmethod
    def whole(self) -> Recording:
        """Return all of it in memory."""

    @abstractmethod
    def with_facts(self, **facts: Any) -> Self:
        """Return it with other values of fields of `facts`."""

    @property
    def frame_times(self) -> Array | None:
        """(T,) s of the frames of the first camera; None without one."""
        return None if self.streams.keypoints is None else self.streams.keypoints.times

    @property
    def times(self) -> Array:
        """(T,) s of the frames of the first camera, without one of the sensors' samples."""
        first = self.streams.keypoints or self.streams.imus
        assert first is not None  # a recording has either
        return first.times

    @property
    def usual_mode(self) -> Mode:
        """Mode that uses all that was recorded: rtof, rto without IMUs, imu without a camera."""
        if self.frame_times is None:
            return "imu"
        return "rtof" if self.streams.imus is not None else "rto"

    @property
    def start_s(self) -> float:
        """First instant, s."""
        return float(self.times[0])

    @property
    def stop_s(self) -> float:
        """Last instant, s."""
        return float(self.times[-1])

    @property
    def rate_hz(self) -> float:
        """Rate, Hz, from the median step; 60 for a single sample."""
        return float(1 / np.median(np.diff(self.times))) if len(self.times) > 1 else 60.0

    def between(self, start_s: float, stop_s: float) -> Recording:
        """Return what was recorded in a closed interval, s; samples at its ends belong to it. `InvalidInputError`:
        neither a camera nor a sensor has a sample in it.

        Where a stream has no sample in it, it is None; views are left out, and all of them where the first
        camera saw nothing. All else is as in the whole recording, so that no check is repeated which needs
        the whole: of clocks, and of the sensors' unit.
        """
        parts = self.streams.parts(lambda stream: stream.between(start_s, stop_s))
        if parts["keypoints"] is None and parts["imus"] is None:
            raise InvalidInputError(f"recording {self.name}: no samples from {start_s:g} to {stop_s:g} s")
        before = 0
        if parts["keypoints"] is not None and self.frame_times is not None:
            before = signals.within(self.frame_times, start_s, stop_s).start
        return replace(self.facts, **parts, first_frame=self.facts.first_frame + before, is_part=True)

    def digest(self) -> str:
        """Return the SHA-256 of all that is computed from: the samples and facts, not the labels, nor how files hold
        them.
        """
        facts = {name: value for name, value in tomllib.loads(self.facts.index()).items() if name not in _LABELS}
        lines = [json.dumps(facts, sort_keys=True)]
        for kind, _, stream, arrays in self._files():
            lines += _of_stream(kind, stream, arrays)
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    def _files(self) -> Iterator[tuple[str, str, Stream[Any], Callable[[Any], dict[str, Any]]]]:
        """Yield a name, the file in the folder, the samples and what makes their arrays, of each kind of sample."""
        streams = self.streams
        for number, view in enumerate((streams.keypoints, *streams.views)):
            if view is not None:
                yield f"keypoints {number}", keypoint_file(number), view, keypoint_file_arrays
        if streams.imus is not None:
            yield "imus", IMUS, streams.imus, imu_arrays
        for number, name in enumerate(_lift_files(self.facts.lifts)):
            yield f"lift {number}", name, Stream.of(self.facts.lifts[number].points), _lift_arrays
        if streams.truth is not None:
            yield "truth", _TRUTH, streams.truth, lambda part: {name: getattr(part, name) for name in TRUTH}

    def save(self, folder: str | Path, overwrite: bool = False, inputs: Mapping[str, str] | None = None) -> None:
        """Write the folder that `Recording.load` reads back exactly, or nothing at all. `OutputExistsError`: the folder
        exists and may not be replaced; `RtofError`: it cannot be written.

        Args:
            overwrite: replace a recording that was saved here and not changed since.
            inputs: fingerprints of what it is made from, for its manifest.
        """
        with new_folder(Path(folder).resolve(), INDEX, overwrite, inputs) as fresh:
            for _, name, stream, arrays in self._files():
                write_npz_blocks(fresh / name, _by_blocks(stream, arrays))
            (fresh / INDEX).write_text(self.facts.index(), encoding="utf-8")


def _by_blocks(
    stream: Stream[Any], arrays: Callable[[Any], dict[str, Any]]
) -> dict[str, tuple[tuple[int, ...], Iterator[Any]]]:
    """Return the shape and the blocks of each array of a stream."""
    first = arrays(stream.part(slice(0, 1)))
    constant = {name: np.asarray(first[name]) for name in first if name in (*VIDEO_CONSTANTS, "names")}
    rows = {name: (len(stream), *np.shape(first[name])[1:]) for name in first if name not in constant}

    def blocks(name: str) -> Iterator[Any]:
        return iter([constant[name]]) if name in constant else (arrays(part)[name] for part in stream.blocks())

    return {name: (constant[name].shape if name in constant else rows[name], blocks(name)) for name in first}


@dataclass(frozen=True)
class Recording(RecordingSource):
    """All inputs of one take: what the pipeline starts from."""

    name: str  #: Title in reports
    keypoints: KeypointSequence | None = None
    """2D landmarks of the skeleton and their camera; None without a camera, then there are IMUs."""
    imus: ImuSequence | None = None
    """Sensor data on the keypoints' clock, at their own times; `ImuSequence.joined` joins several."""
    calibration: ImuCalibration | None = None  #: Mounting and heading of each of those sensors
    skeleton_table: str = "total_capture"  #: Table of the subject's skeleton: 'total_capture' or 'human36m'
    joint_offsets: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(J, 3) each joint in its parent's link frame, m. By default the table's, scaled to the height and
    then to the bone lengths."""
    bone_lengths: Mapping[str, float] | None = None
    """Child joint -> measured distance from its parent, m, for some or all bones."""
    height: float | None = None  #: Standing height, m
    mass_kg: float | None = None  #: Body mass, kg
    sex: str | None = None  #: 'male', 'female' or None where unknown
    floor_height: float | None = None  #: z of a flat floor in world, m; None where there is none or it is unknown
    posture: NeutralPosture | None = None
    """The person's T-pose in the skeleton's link frames, where a reference shows it."""
    model_prior: PosePrior | None = None
    """Pose prior of the model in use, which is no part of the folder; None for the shipped one."""
    sigma_bones: float | None = None
    """Standard deviation of bones of the person's file, relative to their length, which is no part of the folder; None
    where they are those of the folder."""
    image_points: ImageShifts = field(default_factory=dict)
    """Where the detector sees this person's points, of the person's file, which is no part of the folder."""
    truth: PoseSequence | None = None  #: Known poses in world at their own times, joints in the skeleton's order
    first_frame: int = 0  #: Index of the first video frame in the take that this was cut from; a label only
    acknowledgement: str = ""  #: Text that the data's owner asks to be printed with the results
    notes: str = ""  #: Free text
    session: Session = field(default_factory=Session)  #: Labels of the session
    views: tuple[KeypointSequence, ...] = ()
    """Further cameras of the same person on the same clock, at times of their own; the first camera is that
    of `keypoints`."""
    lifts: tuple[LiftPoints, ...] = ()
    """3D points that other models see in the video of the first camera, or beside the sensors in mode imu."""
    corrections: tuple[Correction, ...] = ()  #: By hand; the samples have them
    is_part: bool = False  #: Whether it was cut from a longer recording, on which the clocks were checked

    def __post_init__(self) -> None:
        if self.keypoints is None and self.imus is None:
            raise InvalidInputError(f"recording {self.name}: has neither keypoints nor IMUs; give either")
        if self.floor_height is not None and not np.isfinite(self.floor_height):
            raise InvalidInputError("floor_height: not finite; leave it out where there is no floor")
        if self.skeleton_table not in SKELETONS:
            raise UnknownNameError("skeleton table", [self.skeleton_table], SKELETONS)
        set_ = object.__setattr__
        set_(self, "views", tuple(self.views))
        if self.views and self.keypoints is None:
            raise InvalidInputError("views: are further cameras; give the first one as keypoints")
        if self.bone_lengths is not None:
            lengths = {str(name): float(length) for name, length in self.bone_lengths.items()}
            set_(self, "bone_lengths", lengths)
        offsets = self.joint_offsets
        if offsets is None or len(offsets) == 0:  # callers may say None
            body = body_of(self.skeleton_table, height=self.height, bone_lengths=self.bone_lengths)
            offsets = body.joint_offsets
        J = len(shipped(self.skeleton_table).names)
        set_(self, "joint_offsets", readonly("joint_offsets", offsets, (J, 3)))
        self._check_body()
        self._check_names()
        if not self.is_part:
            self.streams.check_clocks()

    def _check_body(self) -> None:
        """Check that the offsets agree with the lengths and the height given beside them."""
        lengths = self.skeleton.bone_lengths
        indices_of("bone in bone_lengths", [*(self.bone_lengths or ())], list(lengths))
        for name, length in (self.bone_lengths or {}).items():
            if abs(lengths[name] - length) > 1e-6:
                raise InvalidInputError(
                    f"bone_lengths: {name} is {length:g} m, but joint_offsets make it "
                    f"{lengths[name]:g} m; give only one of the two"
                )
        if self.height is not None and not 0.7 < self.skeleton.height / self.height < 1.4:
            raise InvalidInputError(
                f"height: {self.height:g} m, but the skeleton stands {self.skeleton.height:.3g} m "
                "tall; give the height and the offsets in metres"
            )

    def _check_names(self) -> None:
        skeleton = self.skeleton
        seen = (self.keypoints, *self.views) if self.keypoints else ()
        own = [name for view in seen for name in view.names if not is_detector_point(name)]
        indices_of("landmark", own, list(skeleton.landmarks))
        indices_of("joint in the calibration", self.calibration.joints if self.calibration else (), skeleton.names)
        if self.truth is not None and self.truth.names != skeleton.names:
            raise InvalidInputError(
                f"truth: its joints are not those of the skeleton {skeleton.name} in their order; "
                f"expected {', '.join(skeleton.names)}"
            )

    @cached_property
    def skeleton(self) -> SkeletonModel:
        """Subject's body: the table with these offsets, mass, sex, neutral posture, image points and pose prior."""
        body = body_of(self.skeleton_table, self.joint_offsets, mass_kg=self.mass_kg, sex=self.sex)
        body = body if self.posture is None else body.with_posture(self.posture)
        body = body.with_image_points(self.image_points) if self.image_points else body
        return body if self.model_prior is None else body.with_prior(self.model_prior)

    @property
    def video(self) -> KeypointSequence:
        """Keypoints; raises `InvalidInputError` where there are none."""
        if self.keypoints is None:
            raise InvalidInputError(f"recording {self.name}: has no keypoints, as there was no camera")
        return self.keypoints

    def bone_imus(self, max_gap: float = 0.1, times: ArrayLike | None = None) -> BoneImuSequence | None:
        """Return the calibrated, resampled IMUs; None where there are none. `CalibrationError`: a sensor has no
        calibration.

        Args:
            max_gap: longest gap that is interpolated, s; longer ones become NaN.
            times: (T,) s; by default those of the keypoints, or else the sensors' own.
        """
        if self.imus is None:
            return None
        if self.calibration is None:
            raise CalibrationError(
                f"recording {self.name}: its IMUs have no calibration; add a table [imus.sensors.*] "
                "for each, or calibrate them on a known pose first"
            )
        applied = self.calibration.apply(self.imus)
        if times is None:
            times = self.imus.times if self.keypoints is None else self.keypoints.times
        return applied.resample(times, max_gap)

    # --- time ------------------------------------------------------------------------------------

    @property
    def streams(self) -> Streams:
        """All that changes over time."""

        def stream(part: Part | None) -> Stream[Part] | None:
            return None if part is None else Stream.of(part)

        views = tuple(Stream.of(view) for view in self.views)
        return Streams(stream(self.keypoints), views, stream(self.imus), stream(self.truth))

    @property
    def facts(self) -> Self:
        """The recording itself."""
        return self

    def whole(self) -> Self:
        """Return the recording itself."""
        return self

    def with_facts(self, **facts: Any) -> Self:
        """Return it with other values of some fields."""
        return replace(self, **facts)

    @property
    def bones_given(self) -> bool:
        """Whether bones were measured: the offsets are not those of the table, scaled to the height."""
        usual = body_of(self.skeleton_table, height=self.height).joint_offsets
        return bool(self.bone_lengths) or not np.allclose(self.joint_offsets, usual)

    # --- files -----------------------------------------------------------------------------------

    @classmethod
    def load(cls, folder: str | Path) -> Recording:
        """Read a recording folder, which has a file ``recording.toml``; `FileFormatError`, `UnknownNameError` and
        `UnitError` name file, field and remedy.
        """
        with RecordingReader.open(folder) as reader:
            return reader.whole()

    def index(self) -> str:
        """Return the text of ``recording.toml``."""
        made = (replace(one, applied=True) for one in self.corrections)
        return with_corrections(tomli_w.dumps(self._index()), made)

    def _index(self) -> dict[str, Any]:
        joints = self.skeleton.names
        offsets = dict(zip(joints[1:], self.joint_offsets[1:].tolist(), strict=True))
        subject = {"height_m": self.height, "mass_kg": self.mass_kg, "sex": self.sex}
        body: dict[str, Any] = {"table": self.skeleton_table, "joint_offsets_m": offsets}
        if self.bone_lengths is not None:
            body["bone_lengths_m"] = dict(self.bone_lengths)
        index: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "name": self.name,
            "first_frame": int(self.first_frame),
            "session": self.session.plain(),
            "subject": {k: v for k, v in subject.items() if v is not None},
            "skeleton": body,
            "notes": {"acknowledgement": self.acknowledgement, "text": self.notes},
        }
        if self.keypoints is not None:
            index |= camera_and_keypoints(self.keypoints, 0)
        if self.views:
            index["views"] = [camera_and_keypoints(v, i) for i, v in enumerate(self.views, start=1)]
        if self.floor_height is not None:
            index["scene"] = {"floor_height_m": float(self.floor_height)}
        if self.imus is not None or self.calibration is not None:
            index["imus"] = {"sensors": calibration_table(self.calibration) if self.calibration else {}}
        if self.imus is not None:
            index["imus"] |= {"file": IMUS, "names": list(self.imus.names)}
        if self.lifts:
            own = zip(_lift_files(self.lifts), self.lifts, strict=True)
            index["lift"] = {"files": [f"{file}:{one.convention}".rstrip(":") for file, one in own]}
        if self.posture is not None:
            pairs = zip(self.posture.joints, self.posture.quat_wxyz.tolist(), strict=True)
            index["posture"] = {"quat_wxyz": dict(pairs)}
        if self.truth is not None:
            index["truth"] = {"file": _TRUTH}
        return index


def _lift_files(lifts: Sequence[LiftPoints]) -> list[str]:
    """Return the names of the files that the points of other models are saved in."""
    return [f"lift_{number}.npz" for number in range(1, len(lifts) + 1)]


def _lift_arrays(points: MarkerSequence) -> dict[str, Any]:
    return {"times": points.times, "names": np.array(points.names), "p_world": points.p_world}


def _of_stream(kind: str, stream: Stream[Any], arrays: Callable[[Any], Mapping[str, Any]]) -> list[str]:
    """Return a line with the digest of each array of a stream, whatever the blocks it is read in."""
    digests: dict[str, Any] = {}
    for block in stream.blocks():
        for name, values in arrays(block).items():
            array, constant = np.ascontiguousarray(values), name in VIDEO_CONSTANTS
            if name not in digests:
                shape = array.shape if constant else array.shape[1:]
                digests[name] = hashlib.sha256(f"{array.dtype.str} {shape}".encode())
            elif constant:
                continue
            digests[name].update(array.tobytes())
    return [f"{kind} {name} {digest.hexdigest()}" for name, digest in sorted(digests.items())]


class RecordingReader(RecordingSource, AbstractContextManager["RecordingReader"]):
    """A recording's folder of which spans of time are read when needed.

    It is checked as a whole when it is opened, by blocks; its samples are kept in temporary files.
    """

    def __init__(self, first: Recording, streams: Streams, closing: ExitStack):
        """Take a recording with everything but its samples, these, and what closes the files; see `open`."""
        self._first, self._streams, self._closing = first, streams, closing
        self.name = first.name

    @classmethod
    def open(cls, folder: str | Path) -> Self:
        """Open a recording's folder, to be closed after use; errors as `Recording.load`."""
        index = index_of(Path(folder))
        with ExitStack() as closing, naming(index.path):
            fields, streams = read_index(index, Source(closing))
            first = Recording(**fields, **streams.parts(lambda stream: stream.part(slice(0, 1))), is_part=True)
            streams.check_clocks()
            return cls(first, streams, closing.pop_all())

    def __exit__(self, *_: object) -> None:
        """Close the files and remove the temporary ones."""
        self._closing.close()

    @property
    def streams(self) -> Streams:
        """All that changes over time."""
        return self._streams

    @property
    def facts(self) -> Recording:
        """Everything but the samples, of which it has the first."""
        return self._first

    def whole(self) -> Recording:
        """Return all of it, as `Recording.load` does."""
        return replace(self._first, **self._streams.parts(lambda stream: stream.part(ALL)), is_part=False)

    def with_facts(self, **facts: Any) -> Self:
        """Return it with other values of some fields; the files belong to both, and close with either."""
        return type(self)(replace(self._first, **facts), self._streams, self._closing)
