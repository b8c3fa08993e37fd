"""OpenCap's laboratory validation (Uhlrich, Falisse et al., PLOS Computational Biology 19, e1011462, 2023).

Five cameras, markers and OpenSim of ten people; walking, squats, rising from a chair, drop jumps::

    subject2/sessionMetadata.yaml                             height_m
    subject2/VideoData/Session0/Cam1/cameraIntrinsicsExtrinsics.pickle
    subject2/VideoData/Session0/Cam1/STS1/STS1_syncdWithMocap.avi      cut to the reference; or STS1.avi
    subject2/OpenSimData/Mocap/IK/STS1.mot                    inverse kinematics of the markers
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import yaml

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import read_text
from rtof_kin.datasets.public_sets import Movement, PublicSet, Take, TakeInputs, Truth, existing, kind_of, natural
from rtof_kin.formats.opensim import read_opensim_table

CAMERAS: Final = ("Cam0", "Cam1", "Cam2", "Cam3", "Cam4")
"""At -70, -45, 0, 45 and 70 degrees, 0 in front of the person."""
_KINDS: Final[dict[str, Movement]] = {"walking": "walk", "squats": "squat", "sts": "sit-to-stand"}
_NO_MOVEMENT: Final = ("static", "extrinsics", "calib", "neutral")
_VIDEOS: Final = (".avi", ".mp4", ".mov")
_SYNCHRONISED: Final = "_syncdWithMocap"
_OF_SIDES: Final = "hip_flexion hip_adduction hip_rotation knee_angle ankle_angle subtalar_angle elbow_flex pro_sup"
_MEASURED: Final = (
    *("lumbar_extension", "lumbar_bending", "lumbar_rotation"),
    *(f"{name}_{side}" for side in "rl" for name in _OF_SIDES.split()),
)


class OpenCapValidation(PublicSet):
    """Adapter of LabValidation_withVideos."""

    name = "opencap"
    archive = "LabValidation_withVideos"
    layout = "subjectN/VideoData/SessionN/CamN/TRIAL/ and subjectN/OpenSimData/Mocap/IK/TRIAL.mot"
    title = "OpenCap's laboratory validation"
    mode = "rto"

    def _takes(self) -> Iterator[Take]:
        subjects = [*self.root.glob("subject*"), *self.root.glob("*/subject*")]
        for subject in sorted((p for p in subjects if p.is_dir()), key=lambda p: natural(p.name)):
            for folder in sorted(subject.glob("VideoData/Session*/Cam*/*/"), key=lambda p: natural(str(p))):
                trial, camera, session = folder.name, folder.parent.name, folder.parent.parent.name
                if trial.lower().startswith(_NO_MOVEMENT):
                    continue
                key = f"{subject.name}_{session}_{camera}_{trial}"
                yield Take(key, subject.name, trial, kind_of(trial, _KINDS), folder, camera)

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        calibration = existing(
            take.folder.parent / "cameraIntrinsicsExtrinsics.pickle",
            "the calibration of the camera",
            "unpack it from LabValidation_withVideos, or measure without one: --uncalibrated",
        )
        return TakeInputs(video=_video(take), rate_hz=60.0, camera=calibration, height=_height(take))

    def truth(self, take: Take) -> Truth:
        """See `PublicSet.truth`."""
        path = _subject(take) / "OpenSimData" / "Mocap" / "IK" / f"{take.movement}.mot"
        existing(path, "the inverse kinematics of the markers", "unpack OpenSimData of LabValidation")
        table = read_opensim_table(path)
        if "knee_angle_r" not in table.names:
            raise FileFormatError(path, "has no column knee_angle_r: is it another version of the set?")
        return Truth(
            table,
            _MEASURED,
            "OpenSim inverse kinematics of optical markers",
            reach=1.0 if _is_synchronised(take) else 3.0,
        )


def _height(take: Take) -> float:
    path = _subject(take) / "sessionMetadata.yaml"
    existing(path, "the height of the person", "unpack it from LabValidation_withVideos")
    try:
        found: Any = yaml.safe_load(read_text(path, "YAML"))
    except yaml.YAMLError as error:
        raise FileFormatError(path, f"is no YAML ({error})".replace("\n", " ")) from error
    height = found.get("height_m") if isinstance(found, dict) else None
    if not isinstance(height, int | float) or not 0.5 < height < 2.5:
        raise FileFormatError(path, f"height_m: expected the height of the person, m, found {height!r}")
    return float(height)


def _subject(take: Take) -> Path:
    return take.folder.parents[3]


def _video(take: Take) -> Path | None:
    for stem in (take.movement + _SYNCHRONISED, take.movement):
        for suffix in _VIDEOS:
            if (path := take.folder / f"{stem}{suffix}").is_file():
                return path
    return None


def _is_synchronised(take: Take) -> bool:
    video = _video(take)
    return video is None or video.stem.endswith(_SYNCHRONISED)
