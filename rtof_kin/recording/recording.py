"""`Recording`: one take of one person, seen by one camera, by IMUs or by both, as a folder of inputs.

A folder holds ``recording.toml`` and the arrays that it names. From arrays in memory to a recording::

    folder = Path("walk"); folder.mkdir()
    np.savez(folder / "keypoints.npz", uv_px=uv_px, confidence=confidence)  # (T, L, 2), (T, L)
    np.savez(folder / "imus.npz", quat_wxyz=quat_wxyz, f_sensor=f_sensor)   # (T', S, 4), (T', S, 3)
    (folder / "recording.toml").write_text(text_as_below)
    recording = Recording.load(folder)

``recording.toml``, where lines and tables marked - may be left out::

    schema_version = 1
    name = "walk"                        # - the folder's name where absent
    first_frame = 0                      # - index of the first frame in the take this was cut from
    [session]                            # - labels for reports, as are all of its fields
    subject = "P07"                      # - also operator, date = "2026-01-31", place, protocol
    [subject]                            # -
    height_m = 1.78                      # - standing height: scales the table's proportions
    mass_kg = 70.0                       # -
    sex = "female"                       # - "female" or "male"
    [skeleton]                           # -
    table = "total_capture"              # - 21 joints, or "human36m" with 17
    bone_lengths_m = {LeftLeg = 0.41}    # - some or all, by the child joint; over the height
    # joint_offsets_m = {Spine = [-0.04, 0.0, 0.07], ...}  # - all but the root, in the parent's frame
    [scene]                              # -
    floor_height_m = 0.0                 # - z of a flat floor that the subject stands on
    [camera]                             # - with the keypoints, where there are IMUs
    width_px = 1920
    height_px = 1080
    focal_px = 1250.0                    # with - principal_point_px = [960.0, 540.0], or K (3 x 3)
    position_m = [4.0, 0.0, 1.5]         # with target_m, or R_camera_world (3 x 3) and
    target_m = [0.0, 0.0, 1.0]           # t_camera_world_m (3): p_camera = R p_world + t
    distortion = [0.0, 0.0, 0.0, 0.0, 0.0]  # - k1, k2, p1, p2, k3
    assumed = ["focal length", "pose"]   # - what of it nobody measured; reports then say so
    # file = "camera.yml"                # instead of these: a calibration, .toml (Pose2Sim), .yml or .json
    #                                    # (OpenCV); - name, - up = "z", - metres_per_unit = 1.0
    [keypoints]                          # - with the camera
    file = "keypoints.npz"               # uv_px, - confidence, - times; or .csv
    rate_hz = 60.0                       # where the file has no times
    start_s = 0.0                        # - added to all times
    landmarks = ["LeftArm", "Nose", ""]  # joints or landmarks of the skeleton, "" to leave one out
    # layout = "joints"                  # instead of landmarks: all joints of the skeleton; or a
    #                                    # detector's layout, see below
    [imus]                               # -
    file = "imus.npz"                    # quat_wxyz or R_inertial_sensor, f_sensor, - times; or .csv
    rate_hz = 60.0                       # as for the keypoints; all times are on one clock
    names = ["L_UpArm"]                  # - the order in the file; that of the tables where absent
    [imus.sensors.L_UpArm]               # one per sensor: its calibration
    joint = "LeftArm"                    # - for the table's sensors: the segment's proximal joint
    lever_arm_m = [0.03, 0.225, 0.012]   # - for the table's sensors: the sensor in the bone's frame
    R_world_inertial = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]  # or quat_wxyz_world_inertial
    quat_wxyz_sensor_bone = [1, 0, 0, 0]                  # or R_sensor_bone
    [truth]                              # -
    file = "truth.npz"                   # times (T), p_world_joint (T, J, 3), R_world_bone
    [notes]                              # -
    acknowledgement = "Data by ..."      # - goes wherever the data go
    text = ""                            # -

Missing is NaN (or an empty cell). ``f_sensor`` is raw specific force in m/s^2, +9.81 upwards at rest.
With ``layout`` one of body25, body25b, coco17, halpe26, mediapipe33, human36m17, landmarks, or auto to
recognise it, ``file`` is a detector's own output (`rtof_kin.vision.keypoint_files`: a folder or .json, .csv,
.npz, .npy); its points become landmarks of the skeleton. Of several people one is followed; ``person``
(- and ``frame``) say which, by number in that frame.
A .csv has a header line: ``time``, then for each keypoint ``<name>_u_px``, ``<name>_v_px``,
- ``<name>_confidence``, or for each sensor ``<name>_qw``, ``_qx``, ``_qy``, ``_qz``, ``_fx``, ``_fy``,
``_fz``; its names are the landmarks or sensors. Fields not listed here are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.section import Section
from rtof_kin.data.imu import BoneImuSequence, ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording import files
from rtof_kin.recording import imus as recording_imus
from rtof_kin.recording.session import Session, read_session

Array = NDArray[np.float64]
SCHEMA_VERSION = 1
INDEX = "recording.toml"
_SKELETONS = ("total_capture", "human36m")
_shipped = cache(SkeletonModel.named)


@dataclass(frozen=True)
class Recording:
    """Everything known about one take: what the pipeline starts from."""

    name: str
    """What to call it in reports."""
    keypoints: KeypointSequence | None = None
    """2D landmarks, and the camera that saw them. Their names are landmarks of the skeleton. None where
    there was no camera; then there are IMUs."""
    imus: ImuSequence | None = None
    """Sensor data on the keypoints' clock, at times of their own; `ImuSequence.joined` makes one of
    several."""
    calibration: ImuCalibration | None = None
    """How each of those sensors is mounted and oriented."""
    skeleton_table: str = "total_capture"
    """Which table the subject's skeleton is a variant of: 'total_capture' or 'human36m'."""
    joint_offsets: Array = None  # type: ignore[assignment]
    """(J, 3) each joint in its parent's link frame, m. Where not given: the table's, with the height
    and then the bone lengths applied."""
    bone_lengths: Mapping[str, float] | None = None
    """Child joint -> measured distance from its parent, m, for some or all bones."""
    height: float | None = None
    """Standing height, m."""
    mass_kg: float | None = None
    """Body mass, kg."""
    sex: str | None = None
    """'male', 'female' or None where it is not known."""
    floor_height: float | None = None
    """z of a flat floor in world, m; None where there is none or it is not known."""
    truth: PoseSequence | None = None
    """Known poses in world at times of their own, joints in the skeleton's order."""
    first_frame: int = 0
    """Index of the first video frame in the take that this was cut from; a label, nothing more."""
    acknowledgement: str = ""
    """What the data's owner asks to be printed with it."""
    notes: str = ""
    """Anything else."""
    session: Session = field(default_factory=Session)
    """Who was recorded, by whom, when and where."""

    def __post_init__(self) -> None:
        if self.keypoints is None and self.imus is None:
            raise ShapeError(f"recording {self.name}: has neither keypoints nor IMUs; give either")
        if self.floor_height is not None and not np.isfinite(self.floor_height):
            raise ShapeError("floor_height: not finite; leave it out where there is no floor")
        if self.skeleton_table not in _SKELETONS:
            raise UnknownNameError("skeleton table", [self.skeleton_table], _SKELETONS)
        set_ = object.__setattr__
        if self.bone_lengths is not None:
            lengths = {str(name): float(length) for name, length in self.bone_lengths.items()}
            set_(self, "bone_lengths", lengths)
        offsets = self.joint_offsets
        if offsets is None:
            body = _body(self.skeleton_table, height=self.height, bone_lengths=self.bone_lengths)
            offsets = body.joint_offsets
        J = len(_shipped(self.skeleton_table).names)
        set_(self, "joint_offsets", readonly("joint_offsets", offsets, (J, 3)))
        self._check_body()
        self._check_names()
        self._check_clocks()

    def _check_body(self) -> None:
        """The offsets make a body, and one that agrees with the lengths given beside them."""
        lengths = self.skeleton.bone_lengths
        for name, length in (self.bone_lengths or {}).items():
            if name not in lengths:
                raise UnknownNameError("bone in bone_lengths", [name], list(lengths))
            if abs(lengths[name] - length) > 1e-6:
                raise ShapeError(
                    f"bone_lengths: {name} is {length:g} m, but joint_offsets make it "
                    f"{lengths[name]:g} m; give only one of the two"
                )
        if self.height is not None and not 0.7 < self.skeleton.height / self.height < 1.4:
            raise ShapeError(
                f"height: {self.height:g} m, but the skeleton stands {self.skeleton.height:.3g} m "
                "tall; give the height and the offsets in metres"
            )

    def _check_names(self) -> None:
        skeleton = self.skeleton
        seen = () if self.keypoints is None else self.keypoints.names
        unknown = [name for name in seen if name not in skeleton.landmarks]
        if unknown:
            raise UnknownNameError("landmark", unknown, list(skeleton.landmarks))
        if self.calibration is not None:
            unknown = [joint for joint in self.calibration.joints if joint not in skeleton.names]
            if unknown:
                raise UnknownNameError("joint in the calibration", unknown, skeleton.names)
        if self.truth is not None and self.truth.names != skeleton.names:
            raise ShapeError(
                f"truth: its joints are not those of the skeleton {skeleton.name} in their order; "
                f"expected {', '.join(skeleton.names)}"
            )

    def _check_clocks(self) -> None:
        parts = {"keypoints": self.keypoints, "IMU": self.imus, "truth": self.truth}
        (first, times), *others = ((what, part.times) for what, part in parts.items() if part is not None)
        for what, other in others:
            if not (other[0] <= times[-1] and times[0] <= other[-1]):
                raise ShapeError(
                    f"{what} times run from {other[0]:g} to {other[-1]:g} s, those of the "
                    f"{first} from {times[0]:g} to {times[-1]:g} s; shift them to one clock"
                )

    @cached_property
    def skeleton(self) -> SkeletonModel:
        """The subject's body: the table with these offsets, mass and sex."""
        return _body(self.skeleton_table, self.joint_offsets, mass_kg=self.mass_kg, sex=self.sex)

    @property
    def video(self) -> KeypointSequence:
        """The keypoints, for what cannot do without.

        Raises:
            ShapeError: there are none.
        """
        if self.keypoints is None:
            raise ShapeError(f"recording {self.name}: has no keypoints, as nobody filmed it")
        return self.keypoints

    def bone_imus(self, max_gap: float = 0.1, times: ArrayLike | None = None) -> BoneImuSequence | None:
        """The IMUs in terms of the body; None where there are none.

        Args:
            max_gap: no value is interpolated across a gap longer than this, s; it becomes NaN.
            times: (T,) seconds; those of the keypoints where not given, else the sensors' own.

        Raises:
            CalibrationError: there are IMUs but no calibration of all of them.
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
        """Read a folder of the format that this module's docstring describes.

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
            camera = files.read_camera(index.table("camera"))
            body = _shipped(fields["skeleton_table"])
            fields["keypoints"] = files.read_keypoints(index.table("keypoints"), camera, body)
        facts = ("skeleton_table", "joint_offsets", "bone_lengths", "height", "mass_kg", "sex")
        body = _body(**{name: fields[name] for name in facts if name in fields})
        if index.has("imus"):
            fields["imus"], fields["calibration"] = recording_imus.read_imus(index.table("imus"), body)
        if index.has("truth"):
            fields["truth"] = files.read_truth(index.table("truth"), body)
        for section in (index, subject, skeleton, scene, notes):
            section.close()
        return cls(**fields)

    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write the folder that `load` reads back to the same bits, or nothing at all.

        Args:
            overwrite: replace a recording that was written here before, if nobody changed anything in it.

        Raises:
            OutputExistsError: something stands there that may not be replaced.
            RtofError: it cannot be written.
        """
        target = Path(folder).resolve()
        with new_folder(target, INDEX, overwrite) as fresh:
            self._write(fresh)

    def _write(self, folder: Path) -> None:
        keypoints, imus = self.keypoints, self.imus
        index = self._index()
        if keypoints is not None:
            arrays = {"uv_px": keypoints.uv_px, "confidence": keypoints.confidence}
            write_npz(folder / "keypoints.npz", {**arrays, "times": keypoints.times})
        if imus is not None:
            arrays = {"R_inertial_sensor": imus.R_inertial_sensor, "f_sensor": imus.f_sensor}
            write_npz(folder / "imus.npz", {**arrays, "times": imus.times})
        if self.truth is not None:
            write_npz(folder / "truth.npz", files.truth_arrays(self.truth))
        (folder / INDEX).write_text(tomli_w.dumps(index), encoding="utf-8")

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
            index["camera"] = files.camera_table(self.keypoints.camera)
            index["keypoints"] = {"file": "keypoints.npz", "landmarks": list(self.keypoints.names)}
        if self.floor_height is not None:
            index["scene"] = {"floor_height_m": float(self.floor_height)}
        imus: dict[str, Any] = {"sensors": recording_imus.imu_table(self.calibration)}
        if self.imus is not None:
            imus |= {"file": "imus.npz", "names": list(self.imus.names)}
        if self.imus is not None or self.calibration is not None:
            index["imus"] = imus
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
    """A table's skeleton with these offsets, or else this height and then these lengths; mass and sex."""
    skeleton = _shipped(skeleton_table)
    if joint_offsets is None:
        skeleton = skeleton if height is None else skeleton.with_height(height)
        skeleton = skeleton.with_bone_lengths(bone_lengths) if bone_lengths else skeleton
    elif not np.array_equal(joint_offsets, skeleton.joint_offsets):
        skeleton = skeleton.with_offsets(joint_offsets)
    if mass_kg is None and sex is None:
        return skeleton
    return skeleton.with_mass(skeleton.table.mass_kg if mass_kg is None else mass_kg, sex)


def _read_skeleton(section: Section) -> dict[str, Any]:
    """The fields of `Recording` that describe the skeleton."""
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
        names = lengths.keys()
        fields["bone_lengths"] = {name: lengths.number(name) for name in names}
    if len(offsets):
        given = [offsets.array(name, (3,)) for name in joints[1:]]
        fields["joint_offsets"] = np.array([np.zeros(3), *given])
    return fields
