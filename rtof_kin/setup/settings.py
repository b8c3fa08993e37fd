"""Settings of a recording that is set up and of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rtof_kin.core.choices import Mode, Provider
from rtof_kin.core.errors import InvalidInputError

if TYPE_CHECKING:
    from rtof_kin.reconstruction.lift import LifterLike
    from rtof_kin.recording.recording import RecordingSource
    from rtof_kin.recording.subject import Subject


@dataclass(frozen=True)
class SetupSettings:
    """What the user says about a take."""

    height: float | None = None
    """Standing height of the person, m; every length follows it."""
    pose: Literal["N", "T", "seated"] = "N"
    """How the person stood still at first, of sensors without a video."""
    person: int | None = None
    """Number of the person in frames.png; default: the only prominent one."""
    camera_name: str | None = None
    """Of the camera, in a calibration file of several."""
    phone_log: Path | None = None
    """Gyroscope and accelerometer of the phone that filmed by hand, from which its tilt is known."""
    rate_hz: float | None = None
    """Frames per second of keypoints without times."""
    layout: str | None = None
    """Which points the detector finds: a layout by name, or a file (.toml) with a layout and places of its points
    (docs/layouts.md); default: recognised."""
    size_px: tuple[int, int] | None = None
    """Width and height of the image, px, for keypoints without a video, as 1920x1080."""
    keep_video: bool = True
    """Whether the folder may show and name the video; otherwise the keypoints alone are kept."""
    model_dir: Path | None = None
    """Folder of .onnx files (RTMPose, ViTPose or RTMO, and YOLOX, RTMDet or RF-DETR to find people), or with
    MediaPipe's .task; default: what is at hand, downloaded models, else MediaPipe."""
    provider: Provider = field(default="cpu", compare=False)
    """What runs .onnx models: cpu, or cuda (NVIDIA), coreml (Mac), openvino (Intel), each by its own ONNX Runtime."""
    every: int = 1
    """Detect the person in every so many frames of a video only, where the detector is slow: the motion has the rate of
    these frames."""
    people_every: int = 1
    """Find people in every so many images of a video only, and look for them around their last points between: much
    faster with .onnx models that find people and points in turn, as RTMPose with YOLOX. MediaPipe always does so."""
    lifter: LifterLike | None = field(default=None, compare=False)
    """Default: the shipped one."""

    def __post_init__(self) -> None:
        if self.height is not None and not 0.4 < self.height < 2.6:
            raise InvalidInputError(f"--height {self.height:g}: is no human height in metres; give e.g. --height 1.72")


@dataclass(frozen=True)
class ReconstructionTask:
    """How the recording of a folder is reconstructed, beside the settings of its stages."""

    mode: Mode | None = None
    """lift: network only; sf2: + IMU orientations, frame by frame; rto: optimised, vision only; rtof: everything;
    imu: sensors only, without a camera; default: the one that uses all that was recorded."""
    model: Path | None = None
    """Lifter and pose prior: a file written by rtof-kin train, or a shipped one by name: detections (the default),
    live (of the live commands)."""
    lift: tuple[Path, ...] = ()
    """3D points of another model on the video's clock (.trc, .c3d, .npz, .json, .csv), weighed beside the own lift, or
    beside sensors in mode imu; FILE:CONVENTION where names or number of its joints do not say which they are. May be
    given more than once."""
    layout: Path | None = None
    """A file (.toml) with the layout of points that the recording names (docs/layouts.md)."""
    calibrate: bool = False
    """Calibrate the recording from its own motion first, against gross errors of delay, mounting and bones."""
    calibration: Path | None = None
    """Calibration of another recording of the same person: bones, ankles and landmark offsets are taken from it; with
    calibrate delay, mounting and biases are estimated for this one."""
    subject: Path | None = None
    """The person's file: height, mass, bones and posture where the recording does not give them (docs/subject.md)."""
    update_subject: bool = False
    """Merge what the recording says of the person into the file of --subject, which is made if there is none."""
    events: Path | None = None
    """Foot strikes and foot offs on the recording's clock, of a .c3d or a table of Visual3D (.txt, .tsv), that replace
    those that are found."""
    threads: int | None = field(default=None, compare=False, repr=False)
    """Processor cores that are used: parts of a recording of more than two minutes are solved side by side, of all
    what its checks and an uncalibrated camera need; default: all that this process may use."""

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise InvalidInputError(f"threads: {self.threads}; give 1 or more")
        if self.update_subject and self.subject is None:
            raise InvalidInputError("--update-subject needs the person's file; add --subject FILE")
        if self.subject is not None and self.calibration is not None:
            raise InvalidInputError("--subject and --calibration both say what the bones are; give only one of the two")

    def person(self) -> Subject | None:
        """Read the person's file; None without one, or where it is yet to be made."""
        if self.subject is None or (self.update_subject and not self.subject.exists()):
            return None
        from rtof_kin.recording.subject import read_subject

        return read_subject(self.subject)

    def lifter(self) -> LifterLike | None:
        """Load the model that is named; None for the shipped one."""
        if self.model is None:
            return None
        from lifting.predict import Lifter

        return Lifter.load(self.model)

    def with_lifts(self, source: RecordingSource) -> RecordingSource:
        """Return a recording with the points of other models beside its own ones; errors as `read_lift_points`."""
        if not self.lift:
            return source
        from rtof_kin.vision.lift_points import read_lift_points, split_convention

        first, times = source.facts.keypoints, source.frame_times
        if times is not None and first is not None:
            times = times - first.times[0] + first.video_times[0]
        read = (read_lift_points(*split_convention(file), times) for file in self.lift)
        return source.with_facts(lifts=(*source.facts.lifts, *read))


@dataclass(frozen=True)
class SecondCamera:
    """Files of a second camera that saw the same."""

    second: tuple[Path, ...] = ()
    """Video or keypoints of a second camera (or both) that saw the same; its location is found."""
    second_person: int | None = None  #: Number of the person in second/frames.png
    second_camera: str | None = None  #: Name of the second camera, in the calibration among the files
    synchronised: bool = False  #: Both cameras have one clock; default: it is found
