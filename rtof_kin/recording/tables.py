"""The tables of ``recording.toml``: fields, types, units, defaults and rules.

``recording.schema.json`` beside this file and the tables of docs/recording.md are made of them by
`python -m docs.recording_fields`. What depends on other files, on names of a skeleton or on physics is checked by the
readers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, Strict

from rtof_kin.core.files.input_table import (
    Count,
    InputTable,
    Integer,
    Matrix3,
    Names,
    Number,
    OneOf,
    Positive,
    Quaternion,
    Rule,
    Vector2,
    Vector3,
    Vector5,
    explained_by,
)
from rtof_kin.data.corrections import Correction, CorrectionKind
from rtof_kin.data.imu_stream import (
    CHOICES,
    AccelerationAxes,
    AccelerationUnit,
    AngularUnit,
    Gravity,
    InertialAxes,
    OrientationMaps,
    QuaternionOrder,
)
from rtof_kin.formats.world_axes import UP
from rtof_kin.inertial.orientation import HELD
from rtof_kin.vision.layouts import detector_table

SCHEMA: Final = Path(__file__).with_name("recording.schema.json")  #: JSON Schema 2020-12 of the file, for editors
OWN_LAYOUT: Final = "joints"
RECOGNISE: Final = "auto"  #: Layout of a detector that is to be recognised

OF_MAKERS: Final = ("first_sample_s", "map", "sensor_map", *CHOICES)
"""Fields of ``[imus]`` for the files of sensors' makers."""

Sigma = Annotated[Number, Field(ge=0), explained_by("is no standard deviation; give a number that is not negative")]
Rate = Annotated[Number, Field(gt=0), explained_by("is not a positive number of samples per second")]
_ONE = "give only one of the two"
OF_LINES: Final = (
    *("width_px", "height_px", "K", "focal_px", "principal_point_px", "position_m", "target_m", "R_camera_world"),
    *("t_camera_world_m", "distortion", "assumed", "stabilised", "heading_drift_deg_s"),
)
"""Fields of ``[camera]`` that a calibration file has too."""


class SessionTable(InputTable):
    """Labels for reports."""

    subject: str = ""
    """Name or code of the person."""
    operator: str = ""
    """Who made the recording."""
    date: Annotated[str, Field(examples=["2026-01-31"])] = ""
    """Day of the recording, in quotes: year, month and day."""
    place: str = ""
    """Where it was made."""
    protocol: str = ""
    """Task of the subject."""


class SubjectTable(InputTable):
    """The person."""

    height_m: Positive | None = None
    """Standing height, m; scales the proportions of the skeleton's table."""
    mass_kg: Positive | None = None
    """Body mass, kg."""
    sex: Literal["female", "male"] | None = None
    """For the inertia of segments."""


class BodyTable(InputTable):
    """The person's skeleton; offsets override lengths, lengths override the height."""

    table: Literal["total_capture", "human36m"] = "total_capture"
    """21 joints, or 17."""
    bone_lengths_m: Annotated[dict[str, Positive], Field(examples=["{LeftLeg = 0.41}"])] = {}
    """Measured lengths of some or all bones by their child joint, m."""
    joint_offsets_m: Annotated[dict[str, Vector3], Field(examples=["{Spine = [-0.04, 0.0, 0.07]}"])] = {}
    """Each joint but the root in its parent's link frame, m."""


class SceneTable(InputTable):
    """What surrounds the person."""

    floor_height_m: Number | None = None
    """z in world of a flat floor that the person stands on, m."""


class AccuracyTable(InputTable):
    """Standard deviations of a calibrated camera as they were measured; without them positions in the room count as
    unverified.
    """

    focal: Sigma | None = None
    """Of the focal length and the principal point, relative to the former."""
    tilt_deg: Sigma | None = None
    """Of its direction, deg."""
    roll_deg: Sigma | None = None
    """Of roll where it differs, deg."""
    height_m: Sigma | None = None
    """Of the centre's height over the floor, m."""
    k1: Sigma | None = None
    """Of the first coefficient of distortion."""


class UncertaintyTable(InputTable):
    """Standard deviations of a camera that is not calibrated; `reconstruct` estimates these (calibration.md)."""

    focal: Sigma | None = None
    """Of the focal length, relative."""
    tilt_deg: Sigma | None = None
    """Of pitch and roll, deg."""
    roll_deg: Sigma | None = None
    """Of roll where it differs, deg."""
    height_m: Sigma | None = None
    """Of the centre's z, m."""
    k1: Sigma | None = None
    """Of the first coefficient of distortion."""
    of_motion: bool = False
    """Floor and posture were used already: only walking narrows it."""


class CameraMotionTable(InputTable):
    """The camera turned: held by hand, or it panned."""

    file: Annotated[str, Field(examples=["camera_motion.npz"])]
    """An .npz of its rotations, or the log of the phone that filmed."""
    start_s: Number = 0
    """Added to its times, s."""
    sensor: str | None = None
    """Sensor of a log that has several."""
    held: Annotated[str, OneOf(lambda: HELD)] | None = None
    """How the phone was held; *left*: its top to the left of who films. By default from its accelerometer."""
    rules = (
        Rule("belongs to the log of a phone; leave it out beside an .npz", ending=".npz", excluded=("sensor", "held")),
    )


class CameraTable(InputTable):
    """A camera: its matrices, or position, target and focal length, or a calibration file."""

    width_px: Count | None = None
    """Width of the image, px."""
    height_px: Count | None = None
    """Height of the image, px."""
    K: Matrix3 | None = None
    """Intrinsic matrix, px; instead of `focal_px`."""
    focal_px: Positive | None = None
    """Focal length, px."""
    principal_point_px: Vector2 | None = None
    """Principal point, px; with `focal_px`. The image's centre by default."""
    position_m: Vector3 | None = None
    """Optical centre in world, m; with `target_m`."""
    target_m: Vector3 | None = None
    """A point in world on the optical axis, m; the image is upright."""
    R_camera_world: Matrix3 | None = None
    """Rotation from world to camera (x right, y down, z forward); with `t_camera_world_m` instead of position and
    target."""
    t_camera_world_m: Vector3 | None = None
    """Origin of the world in the camera, m: p_camera = R p_world + t."""
    distortion: Vector5 | None = None
    """k1, k2, p1, p2, k3 of OpenCV; 0 by default."""
    assumed: Annotated[Names, Field(examples=[["focal length", "pose"]])] = ()
    """Parts that were not measured; named in reports."""
    stabilised: bool = False
    """Keypoints are those of a camera that turned, as one that stands still sees them."""
    heading_drift_deg_s: Number = 0
    """Standard deviation of a drift of its heading, deg/s."""
    uncertainty: UncertaintyTable | None = None
    accuracy: AccuracyTable | None = None
    motion: CameraMotionTable | None = None
    file: Annotated[str, Field(examples=["camera.yml"])] | None = None
    """A calibration file instead of these lines: .toml (Pose2Sim, Caliscope, AniposeLib), .yml or .json (OpenCV,
    and OpenCap's once converted)."""
    name: str | None = None
    """Name of the camera in a `file` of several."""
    up: Annotated[str, OneOf(lambda: UP)] | None = None
    """The axis of the `file` that points up."""
    metres_per_unit: Positive | None = None
    """Length of the unit of the `file`, m."""
    rules = (
        Rule(f"stands beside file, which has it too; {_ONE}", given=("file",), excluded=OF_LINES),
        Rule(
            "belongs to a calibration file; name that with file, or leave this out",
            absent=("file",),
            excluded=("name", "up", "metres_per_unit"),
        ),
        Rule(absent=("file",), required=("width_px", "height_px")),
        Rule(
            f"stands beside position_m and target_m, which give it too; {_ONE}",
            given=("position_m", "target_m"),
            excluded=("R_camera_world", "t_camera_world_m"),
        ),
        Rule(given=("position_m", "target_m"), required=("position_m", "target_m")),
        Rule(absent=("file", "position_m", "target_m"), required=("R_camera_world", "t_camera_world_m")),
        Rule(f"stands beside K, which has it too; {_ONE}", given=("K",), excluded=("focal_px", "principal_point_px")),
        Rule(absent=("file", "K"), required=("focal_px",)),
    )


class KeypointsTable(InputTable):
    """2D points over time."""

    file: Annotated[str, Field(examples=["keypoints.npz"])]
    """An .npz or .csv inside the folder, or a file or folder of a detector."""
    rate_hz: Rate | None = None
    """Frames per second, where the file has no times."""
    start_s: Number = 0
    """Added to all times, s."""
    landmarks: Annotated[Names, Field(examples=[["LeftArm", "Nose", ""]])] | None = None
    """Joints or landmarks of the skeleton in the order of an .npz; "" leaves a point out."""
    layout: (
        Annotated[str, OneOf(lambda: dict.fromkeys((OWN_LAYOUT, RECOGNISE, *detector_table().layouts)), file=".toml")]
        | None
    ) = None
    """Instead of landmarks: all joints of the skeleton in their order, the layout of a detector, by name or as a file
    in the folder (docs/layouts.md), or `auto` to recognise it."""
    person_number: Count | None = None
    """Which person of a detector's file is followed, from 1, as in frames.png; the likely one by default."""
    person: Integer | None = None
    """The same counted from 0, as older recordings have it."""
    frame: Integer | None = None
    """Frame in which the people are counted, from 0."""
    rules = (
        Rule(f"stands beside person_number; {_ONE}", given=("person_number",), excluded=("person",)),
        Rule(given=("person_number", "person"), required=("layout",)),
        Rule(f"stands beside landmarks; {_ONE}", given=("landmarks",), excluded=("layout",)),
        Rule("belongs to a detector's file; give its layout, or auto", absent=("layout",), excluded=("frame",)),
        Rule(
            "a .csv names its points itself; leave the landmarks out",
            absent=("layout",),
            ending=".csv",
            excluded=("landmarks",),
        ),
    )

    @property
    def is_detected(self) -> bool:
        """Whether the file is a detector's own, in its layout."""
        return self.layout not in (None, OWN_LAYOUT) or self.has("person") or self.has("person_number")


class ViewTable(InputTable):
    """A further camera of the same take."""

    camera: CameraTable
    """As the first camera."""
    keypoints: KeypointsTable
    """As those of the first camera, in another file."""


def _one_rotation(frames: str) -> tuple[Rule, Rule]:
    """Return the rules that a rotation is given once, as a matrix or as a quaternion."""
    matrix, quat = f"R_{frames}", f"quat_wxyz_{frames}"
    one = f"give one of {matrix} (3 x 3) and {quat} (4 numbers)"
    return (
        Rule(f"stands beside {matrix}; {one}", given=(matrix,), excluded=(quat,)),
        Rule(f"missing; {one}", absent=(matrix, quat), required=(matrix,)),
    )


class SensorTable(InputTable):
    """Calibration of a sensor on its segment."""

    joint: Annotated[str, Field(examples=["LeftArm"])] | None = None
    """Proximal joint of its segment; may be left out for sensors of the skeleton's table."""
    lever_arm_m: Vector3 | None = None
    """Sensor in the bone's frame, m; may be left out as `joint`."""
    R_world_inertial: Matrix3 | None = None
    """Rotation from the sensor's own reference to world."""
    quat_wxyz_world_inertial: Quaternion | None = None
    """The same as a unit quaternion."""
    R_sensor_bone: Matrix3 | None = None
    """Rotation from the bone to the sensor."""
    quat_wxyz_sensor_bone: Quaternion | None = None
    """The same as a unit quaternion."""
    mounting_sd_deg: (
        Annotated[
            float,
            Field(ge=0, le=180),
            explained_by("is no standard deviation of an angle; give degrees, or leave it out"),
        ]
        | None
    ) = None
    """Standard deviation of the rotation from the bone to the sensor about each axis, deg; angles carry it. Left out
    where not known."""
    rules = (*_one_rotation("world_inertial"), *_one_rotation("sensor_bone"))


class ImusTable(InputTable):
    """Samples of IMUs and their calibration."""

    file: Annotated[str, Field(examples=["imus.npz"])] | None = None
    """An .npz or .csv inside the folder, or any file or folder of sensors (sensors.md)."""
    rate_hz: Rate | None = None
    """Samples per second, where the file has no times."""
    start_s: Number = 0
    """Added to all times, s; all times are on one clock."""
    clock_drift: Annotated[Number, Field(ge=-0.01, le=0.01), explained_by("s/s is no clock's; 0.00002 is 20 ppm")] = 0
    """s/s: times are t + start_s + clock_drift t."""
    names: Annotated[Names, Field(examples=[["L_UpArm"]])] | None = None
    """Sensors in the order of an .npz, by default that of `sensors`; those that are used of a maker's file."""
    sensors: dict[str, SensorTable] = {}
    """One table for each sensor: its calibration."""
    first_sample_s: Number | None = None
    """Time of a maker's first sample, s; instead of `start_s`."""
    map: Annotated[dict[str, str], Field(examples=['{00B42279 = "pelvis"}'])] = {}
    """Place of each sensor of a maker's file by its serial number; others are left out."""
    sensor_map: Annotated[str, Field(examples=["places.csv"])] | None = None
    """A file with that map."""
    acceleration_unit: AccelerationUnit | None = None
    """Of a maker's file, where it differs from its format's."""
    gravity: Gravity | None = None
    """Whether accelerations at rest are 9.81 upwards, or 0."""
    acceleration_axes: AccelerationAxes | None = None
    """Axes of the accelerations."""
    angular_unit: AngularUnit | None = None
    """Of gyroscopes."""
    quaternion_order: QuaternionOrder | None = None
    """Order of quaternions."""
    orientation_maps: OrientationMaps | None = None
    """Direction of orientations."""
    inertial_axes: InertialAxes | None = None
    """Reference of orientations: ENU or NWU, NED, as in computer graphics."""
    rules = (
        Rule(
            "is for the files of sensors' makers; leave it out, or name such a file", ending=".npz", excluded=OF_MAKERS
        ),
        Rule(f"stands beside start_s; {_ONE}", given=("start_s",), excluded=("first_sample_s",)),
        Rule(
            "is for a file of samples, but there is none; name it with file",
            absent=("file",),
            excluded=("names", "rate_hz", "start_s", "clock_drift", *OF_MAKERS),
        ),
    )


class PostureTable(InputTable):
    """The person's T-pose, where a reference shows it."""

    quat_wxyz: Annotated[dict[str, Quaternion], Field(examples=["{Spine1 = [0.9962, 0, 0.0872, 0]}"])] = {}
    """Unit quaternion by joint (spine, LeftShoulder, RightShoulder, LeftUpLeg, RightUpLeg): its rotation relative to
    the parent, in link frames."""


class TruthTable(InputTable):
    """Known poses, to compare with."""

    file: Annotated[str, Field(examples=["truth.npz"])]
    """An .npz inside the folder."""


class LiftTable(InputTable):
    """3D points that other models see in the video of the first camera, or beside sensors without one."""

    files: Annotated[Names, Field(examples=[["points.trc", "joints.npz:smpl24"]])]
    """Each a .trc, .c3d, .npz, .json or .csv inside the folder (lift.md), at times of the video's own clock, or
    of the sensors' without a video; after a colon the convention of its joints, where their names or number do not
    say it."""


class CorrectionTable(InputTable):
    """A correction by hand. The files stay as they are."""

    kind: CorrectionKind
    """What is corrected: measurements that are left out; sides of the image exchanged; a foot that stands; gait events
    and strides that replace those found nearby, or events that are none; repetitions."""
    what: Annotated[str, Field(examples=["image", "left", "L_UpArm"])] = ""
    """Of leave_out: all, image, sensors, or the name of a sensor; of feet: left, right; of repetition: squat,
    sit_to_stand."""
    start_s: Number | None = None
    """Where it begins, or the instant of an event, s on the recording's clock; default: its start."""
    stop_s: Number | None = None
    """Where it ends, s; default: the recording's end."""
    who: str = ""
    """Who made it."""
    when: Annotated[str, Field(examples=["2026-01-31T10:15"])] = ""
    """Day and time."""
    why: str = ""
    """Reason."""
    applied: bool = False
    """Whether the files have it already."""

    def correction(self) -> Correction:
        """Return it; `FileFormatError` where it says nothing sensible."""
        own = {name: value for name in type(self).model_fields if (value := getattr(self, name)) is not None}
        found = Correction(**own)
        if found.problem:
            raise self.error("kind", f"{self.kind}: {found.problem}")
        return found


class NotesTable(InputTable):
    """Free text."""

    acknowledgement: str = ""
    """Printed with everything that is made of the data."""
    text: str = ""
    """Remarks."""


class RecordingTable(InputTable):
    """Index of a recording's folder, read by rtof_kin.Recording.load. R_a_b maps vectors from frame b to frame a; the
    world has z up.
    """

    schema_version: Literal[1]
    """Version of this format."""
    name: str = ""
    """Title in reports; the folder's name by default."""
    first_frame: Integer = 0
    """Index of the first frame in the take that this was cut from; a label."""
    session: SessionTable = SessionTable()
    subject: SubjectTable = SubjectTable()
    skeleton: BodyTable = BodyTable()
    scene: SceneTable = SceneTable()
    camera: CameraTable | None = None
    """The camera that the keypoints are of; together with them."""
    keypoints: KeypointsTable | None = None
    """2D points over time; together with the camera."""
    views: Annotated[tuple[ViewTable, ...], Strict(False)] = ()
    """Further cameras of the same take."""
    imus: ImusTable | None = None
    lift: LiftTable | None = None
    posture: PostureTable | None = None
    truth: TruthTable | None = None
    corrections: Annotated[tuple[CorrectionTable, ...], Strict(False)] = ()
    """What was corrected by hand."""
    notes: NotesTable = NotesTable()
    rules = (
        Rule(
            "is missing; a camera and its keypoints go together: write both [camera] and [keypoints]",
            given=("camera", "keypoints", "views"),
            required=("camera", "keypoints"),
        ),
        Rule(
            "is missing; a recording has [camera] and [keypoints], or [imus], or all of them",
            absent=("camera", "keypoints", "views"),
            required=("imus",),
        ),
    )
