"""`Recording`: one take of one person, seen by cameras, by IMUs or by both, and its folder.

The folder's format, ``recording.toml`` and the arrays that it names, is described in docs/recording.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import tomli_w
from numpy.typing import ArrayLike

from rtof_kin.body.neutral_posture import NeutralPosture
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import CalibrationError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.section import Section
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.imu_calibration_toml import calibration_table
from rtof_kin.formats.video_arrays import video_arrays
from rtof_kin.recording import files
from rtof_kin.recording.camera_motion_files import read_filmed
from rtof_kin.recording.sensor_files import IMUS, read_imus, write_imus
from rtof_kin.recording.session import Session, read_session
from rtof_kin.recording.views import camera_and_keypoints, keypoint_file, read_views
from rtof_kin.vision.layouts import is_detector_point

SCHEMA_VERSION: Final = 1
INDEX: Final = "recording.toml"
_SKELETONS: Final = ("total_capture", "human36m")
_shipped = cache(SkeletonModel.named)


@dataclass(frozen=True)
class Recording:
    """All inputs of one take: what the pipeline starts from."""

    name: str
    """Title in reports."""
    keypoints: KeypointSequence | None = None
    """2D landmarks of the skeleton and their camera; None without a camera, then there are IMUs."""
    imus: ImuSequence | None = None
    """Sensor data on the keypoints' clock, at their own times; `ImuSequence.joined` joins several."""
    calibration: ImuCalibration | None = None
    """Mounting and heading of each of those sensors."""
    skeleton_table: str = "total_capture"
    """Table of the subject's skeleton: 'total_capture' or 'human36m'."""
    joint_offsets: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(J, 3) each joint in its parent's link frame, m. By default the table's, scaled to the height and
    then to the bone lengths."""
    bone_lengths: Mapping[str, float] | None = None
    """Child joint -> measured distance from its parent, m, for some or all bones."""
    height: float | None = None
    """Standing height, m."""
    mass_kg: float | None = None
    """Body mass, kg."""
    sex: str | None = None
    """'male', 'female' or None where unknown."""
    floor_height: float | None = None
    """z of a flat floor in world, m; None where there is none or it is unknown."""
    posture: NeutralPosture | None = None
    """The person's T-pose in the skeleton's link frames, where a reference shows it."""
    model_prior: PosePrior | None = None
    """Pose prior of the model in use, which is no part of the folder; None for the shipped one."""
    truth: PoseSequence | None = None
    """Known poses in world at their own times, joints in the skeleton's order."""
    first_frame: int = 0
    """Index of the first video frame in the take that this was cut from; a label only."""
    acknowledgement: str = ""
    """Text that the data's owner asks to be printed with the results."""
    notes: str = ""
    """Free text."""
    session: Session = field(default_factory=Session)
    """Labels of the session."""
    views: tuple[KeypointSequence, ...] = ()
    """Further cameras of the same person on the same clock, at times of their own; the first camera is that
    of `keypoints`."""

    def __post_init__(self) -> None:
        if self.keypoints is None and self.imus is None:
            raise InvalidInputError(f"recording {self.name}: has neither keypoints nor IMUs; give either")
        if self.floor_height is not None and not np.isfinite(self.floor_height):
            raise InvalidInputError("floor_height: not finite; leave it out where there is no floor")
        if self.skeleton_table not in _SKELETONS:
            raise UnknownNameError("skeleton table", [self.skeleton_table], _SKELETONS)
        set_ = object.__setattr__
        set_(self, "views", tuple(self.views))
        if self.views and self.keypoints is None:
            raise InvalidInputError("views: are further cameras; give the first one as keypoints")
        if self.bone_lengths is not None:
            lengths = {str(name): float(length) for name, length in self.bone_lengths.items()}
            set_(self, "bone_lengths", lengths)
        offsets = self.joint_offsets
        if offsets is None or len(offsets) == 0:  # callers may say None
            body = _body(self.skeleton_table, height=self.height, bone_lengths=self.bone_lengths)
            offsets = body.joint_offsets
        J = len(_shipped(self.skeleton_table).names)
        set_(self, "joint_offsets", readonly("joint_offsets", offsets, (J, 3)))
        self._check_body()
        self._check_names()
        self._check_clocks()

    def _check_body(self) -> None:
        """Check that the offsets agree with the lengths and the height given beside them."""
        lengths = self.skeleton.bone_lengths
        for name, length in (self.bone_lengths or {}).items():
            if name not in lengths:
                raise UnknownNameError("bone in bone_lengths", [name], list(lengths))
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
        named = {
            "landmark": (own, list(skeleton.landmarks)),
            "joint in the calibration": (self.calibration.joints if self.calibration else (), skeleton.names),
        }
        for kind, (names, known) in named.items():
            unknown = [name for name in names if name not in known]
            if unknown:
                raise UnknownNameError(kind, unknown, known)
        if self.truth is not None and self.truth.names != skeleton.names:
            raise InvalidInputError(
                f"truth: its joints are not those of the skeleton {skeleton.name} in their order; "
                f"expected {', '.join(skeleton.names)}"
            )

    def _check_clocks(self) -> None:
        parts = {"keypoints": self.keypoints, "IMU": self.imus, "truth": self.truth}
        parts |= {f"view {i}": view for i, view in enumerate(self.views, start=1)}
        (first, times), *others = ((what, part.times) for what, part in parts.items() if part is not None)
        for what, other in others:
            if not (other[0] <= times[-1] and times[0] <= other[-1]):
                raise InvalidInputError(
                    f"{what} times run from {other[0]:g} to {other[-1]:g} s, those of the "
                    f"{first} from {times[0]:g} to {times[-1]:g} s; shift them to one clock"
                )

    @cached_property
    def skeleton(self) -> SkeletonModel:
        """Subject's body: the table with these offsets, mass, sex, neutral posture and pose prior."""
        body = _body(self.skeleton_table, self.joint_offsets, mass_kg=self.mass_kg, sex=self.sex)
        body = body if self.posture is None else body.with_posture(self.posture)
        return body if self.model_prior is None else body.with_prior(self.model_prior)

    @property
    def video(self) -> KeypointSequence:
        """Keypoints; raises `InvalidInputError` where there are none."""
        if self.keypoints is None:
            raise InvalidInputError(f"recording {self.name}: has no keypoints, as there was no camera")
        return self.keypoints

    def bone_imus(self, max_gap: float = 0.1, times: ArrayLike | None = None) -> BoneImuSequence | None:
        """Return the calibrated, resampled IMUs; None where there are none.

        Args:
            max_gap: longest gap that is interpolated, s; longer ones become NaN.
            times: (T,) s; by default those of the keypoints, or else the sensors' own.

        Raises:
            CalibrationError: a sensor has no calibration.
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

    # --- files -----------------------------------------------------------------------------------

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read a recording folder.

        Args:
            folder: that has a file ``recording.toml``.

        Raises:
            FileFormatError, UnknownNameError, UnitError: the message names file, field and remedy.
        """
        index = Section.of_file(Path(folder) / INDEX)
        version = index.integer("schema_version")
        if version != SCHEMA_VERSION:
            raise index.error(
                "schema_version", f"{version} is not {SCHEMA_VERSION}, which this version of the "
                "package reads; use the version that wrote it, or a newer one"
            )  # fmt: skip
        with files.naming(index.path):
            return cls._from_index(index)

    @classmethod
    def _from_index(cls, index: Section) -> Self:
        subject, skeleton, scene, notes = (index.table(n) for n in ("subject", "skeleton", "scene", "notes"))
        fields: dict[str, Any] = {
            "name": index.text("name", index.path.absolute().parent.name),
            "first_frame": index.integer("first_frame", 0),
            "height": subject.optional_number("height_m"),
            "mass_kg": subject.optional_number("mass_kg"),
            "sex": subject.optional_text("sex"),
            "floor_height": scene.optional_number("floor_height_m"),
            "acknowledgement": notes.text("acknowledgement", ""),
            "notes": notes.text("text", ""),
            "session": read_session(index.table("session")),
            **_read_skeleton(skeleton),
        }
        if index.has("camera") or index.has("keypoints") or not index.has("imus"):
            body = _shipped(fields["skeleton_table"])
            fields["keypoints"], note = read_filmed(index.table("camera"), index.table("keypoints"), body)
            fields["notes"] = "\n".join(filter(None, (fields["notes"], note)))
        fields["views"] = read_views(index.tables("views"), _shipped(fields["skeleton_table"]))
        facts = ("skeleton_table", "joint_offsets", "bone_lengths", "height", "mass_kg", "sex")
        body = _body(**{name: fields[name] for name in facts if name in fields})
        if index.has("imus"):
            fields["imus"], fields["calibration"] = read_imus(index.table("imus"), body)
        if index.has("posture"):
            fields["posture"] = _read_posture(index.table("posture"), body.names)
        if index.has("truth"):
            fields["truth"] = files.read_truth(index.table("truth"), body)
        for section in (index, subject, skeleton, scene, notes):
            section.close()
        return cls(**fields)

    def save(
        self, folder: str | Path, overwrite: bool = False, inputs: Mapping[str, str] | None = None
    ) -> None:
        """Write the folder that `load` reads back exactly, or nothing at all.

        Args:
            folder: to write. overwrite: replace a recording that was saved here and not changed since.
            inputs: fingerprints of what it is made from, for its manifest.

        Raises:
            OutputExistsError: the folder exists and may not be replaced. RtofError: it cannot be written.
        """
        keypoints, imus = self.keypoints, self.imus
        with new_folder(Path(folder).resolve(), INDEX, overwrite, inputs) as fresh:
            for i, seen in enumerate((keypoints, *self.views) if keypoints is not None else ()):
                arrays = {"uv_px": seen.uv_px, "confidence": seen.confidence, "times": seen.times}
                write_npz(fresh / keypoint_file(i), arrays | video_arrays(seen))
            if imus is not None:
                write_imus(fresh / IMUS, imus)
            if self.truth is not None:
                write_npz(fresh / "truth.npz", {name: getattr(self.truth, name) for name in files.TRUTH})
            (fresh / INDEX).write_text(tomli_w.dumps(self._index()), encoding="utf-8")

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
        if self.posture is not None:
            pairs = zip(self.posture.joints, self.posture.quat_wxyz.tolist(), strict=True)
            index["posture"] = {"quat_wxyz": dict(pairs)}
        if self.truth is not None:
            index["truth"] = {"file": "truth.npz"}
        return index


def _body(
    skeleton_table: str,
    joint_offsets: Array | None = None,
    bone_lengths: Mapping[str, float] | None = None,
    height: float | None = None,
    mass_kg: float | None = None,
    sex: str | None = None,
) -> SkeletonModel:
    """Return a table's skeleton with these offsets, or else this height and then these lengths."""
    skeleton = _shipped(skeleton_table)
    if joint_offsets is None:
        skeleton = skeleton if height is None else skeleton.with_height(height)
        skeleton = skeleton.with_bone_lengths(bone_lengths) if bone_lengths else skeleton
    elif not np.array_equal(joint_offsets, skeleton.joint_offsets):
        skeleton = skeleton.with_offsets(joint_offsets)
    if mass_kg is None and sex is None:
        return skeleton
    return skeleton.with_mass(skeleton.table.mass_kg if mass_kg is None else mass_kg, sex)


def _read_posture(section: Section, joints: tuple[str, ...]) -> NeutralPosture:
    """Read the quaternions of ``[posture.quat_wxyz]`` by joint."""
    quats = section.table("quat_wxyz")
    named = tuple(quats.keys())
    unknown = [name for name in named if name not in joints[1:]]
    if unknown:
        raise UnknownNameError(f"joint in {section.path}, {section.where('quat_wxyz')}", unknown, joints[1:])
    section.close()
    return NeutralPosture(named, np.array([quats.array(name, (4,)) for name in named]).reshape(-1, 4))


def _read_skeleton(section: Section) -> dict[str, Any]:
    """Read the fields of `Recording` that describe the skeleton."""
    table = section.text("table", "total_capture")
    if table not in _SKELETONS:
        where = f"skeleton in {section.path}, {section.where('table')}"
        raise UnknownNameError(where, [table], _SKELETONS)
    joints = _shipped(table).names
    fields: dict[str, Any] = {"skeleton_table": table}
    for name in ("bone_lengths_m", "joint_offsets_m"):
        unknown = [n for n in section.table(name).keys() if n not in joints[1:]]  # noqa: SIM118
        if unknown:
            where = f"joint in {section.path}, {section.where(name)}"
            raise UnknownNameError(where, unknown, joints[1:])
    lengths, offsets = section.table("bone_lengths_m"), section.table("joint_offsets_m")
    if len(lengths):
        fields["bone_lengths"] = {name: lengths.number(name) for name in lengths.keys()}  # noqa: SIM118
    if len(offsets):
        given = [offsets.array(name, (3,)) for name in joints[1:]]
        fields["joint_offsets"] = np.array([np.zeros(3), *given])
    return fields
