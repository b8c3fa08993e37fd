"""Two public sets of videos beside markers: BML-MoVi and OpenCap's laboratory validation.

BML-MoVi (Ghorbani et al., PLOS ONE 16, e0253157, 2021): round F, two calibrated cameras and 67 markers.

Files are found by name at any depth::

    F_PG1_Subject_1_L.avi                 video of camera PG1 (or PG2), 800 x 600 px, 30 Hz, all motions
    F_v3d_Subject_1.mat                   struct Subject_1_F with move: markers, joint centres, 120 Hz
    cameraParams_PG1.npz, Extrinsics_PG1.npz    calibration in MATLAB's convention, mm

``move`` has ``motions_list`` and, from 1, the first and last frame of each motion in the video (``flags30``)
and in motion capture (``flags120``). Joint centres are ``virtualMarkerLocation`` (T, 20, 3) in the order of
`CENTRES`; 0 or NaN where missing. Rounds S1 and S2 have sensors but 17 markers, too few for any joint angle.

LabValidation_withVideos of OpenCap (Uhlrich, Falisse et al., PLOS Computational Biology 19, e1011462, 2023): five
cameras, Cam0 to Cam4 at -70, -45, 0, 45 and 70 degrees, 0 in front of the person, markers and OpenSim of ten people;
walking, squats, rising from a chair, drop jumps::

    subject2/sessionMetadata.yaml                             height_m
    subject2/VideoData/Session0/Cam1/cameraIntrinsicsExtrinsics.json   (examples/convert_pickles.py)
    subject2/VideoData/Session0/Cam1/STS1/STS1_syncdWithMocap.avi      cut to the reference; or STS1.avi
    subject2/OpenSimData/Mocap/IK/STS1.mot                    inverse kinematics of the markers
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.files.text import read_text
from rtof_kin.data.camera import Camera
from rtof_kin.datasets.public_sets import PublicSet, Take, TakeInputs, Truth, existing, hinge_table, kind_of, natural
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.formats.sensors.imu_mat import matlab_variables

_PAIRED: Final = ("ankle", "elbow", "hip", "hand", "knee", "shoulder", "wrist", "foot")
CENTRES: Final = (
    "head",
    "mid_hip",
    "pelvis",
    "thorax",
    *(f"{side}_{name}" for side in ("left", "right") for name in _PAIRED),
)
"""Order of the virtual markers."""
VIDEO_HZ, MARKERS_HZ = 30.0, 120.0
SIZE_PX: Final = (800, 600)
_CAMERAS: Final = ("PG1", "PG2")
_MARKERS: Final = re.compile(r"F_v3d_Subject_(\d+)\.mat", re.IGNORECASE)
_MISSING: Final = 1e-3
_MM: Final = 0.001


class Movi(PublicSet):
    """Adapter of round F of BML-MoVi."""

    name = "movi"

    def __init__(self, root: Path):
        super().__init__(root)
        self._read: dict[Path, dict[str, Any]] = {}

    def _takes(self) -> Iterator[Take]:
        files = [path for path in self.root.rglob("*.mat") if _MARKERS.fullmatch(path.name)]
        for path in sorted(files, key=lambda p: natural(p.name)):
            number = path.stem.rpartition("_")[2]
            try:
                motions = self._move(path)["motions"]
            except FileFormatError:
                motions = ["unreadable"]  # listed, so that it is counted; `inputs` says why
            for index, motion in enumerate(motions):
                plain = re.sub(r"[^A-Za-z0-9]+", "_", motion)
                for camera in _CAMERAS:
                    key = f"Subject_{number}_{index + 1:02d}_{plain}_{camera}"
                    kind = kind_of(motion, self.kinds)
                    yield Take(key, f"Subject_{number}", motion, kind, path.parent, camera)

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        number = take.subject.rpartition("_")[2]
        video = self._found(rf"F_{take.camera}_Subject_{number}(_L)?\.(avi|mp4)")
        first, last = self._of(take)["flags30"][_index(take)]
        return TakeInputs(
            video=video,
            span=((first - 1) / VIDEO_HZ, (last - 1) / VIDEO_HZ),
            size_px=None if video else SIZE_PX,
            rate_hz=VIDEO_HZ,
            camera=self._camera(take.camera),
        )

    def _camera(self, name: str) -> Camera:
        intrinsics, extrinsics = f"cameraParams_{name}.npz", f"Extrinsics_{name}.npz"
        found = {file: self._found(re.escape(file)) for file in (intrinsics, extrinsics)}
        return read_camera(
            *(
                existing(
                    path or self.root / file,
                    "the calibration of the camera",
                    "unpack 'Camera Parameters.tar', or measure without one: --uncalibrated",
                )
                for file, path in found.items()
            )
        )

    def truth(self, take: Take) -> Truth:
        """See `PublicSet.truth`."""
        move = self._of(take)
        first, last = (int(frame) for frame in move["flags120"][_index(take)])
        points = move["points"][first - 1 : last]
        points = np.where((np.abs(points) < _MISSING).all(axis=-1, keepdims=True), np.nan, points)
        centres = {name: points[:, i] for i, name in enumerate(CENTRES)}
        table = hinge_table(np.arange(len(points)) / MARKERS_HZ, centres)
        return Truth(table, table.names, "angles between joint centres of optical markers", reach=0.5)

    def _of(self, take: Take) -> dict[str, Any]:
        return self._move(take.folder / f"F_v3d_{take.subject}.mat")

    def _move(self, path: Path) -> dict[str, Any]:
        """Read one person's motions; the last person's are kept."""
        if path not in self._read:
            self._read = {path: read_motions(path)}
        return self._read[path]

    def _found(self, pattern: str) -> Path | None:
        named = re.compile(pattern, re.IGNORECASE)
        return next((path for path in sorted(self.root.rglob("*")) if named.fullmatch(path.name)), None)


def _index(take: Take) -> int:
    return int(take.key.removeprefix(take.subject + "_").partition("_")[0]) - 1


def read_camera(intrinsics: Path, extrinsics: Path) -> Camera:
    """Read a camera; MATLAB multiplies rows from the left and counts pixels from 1. `FileFormatError`: an array is
    missing, of another shape, or no camera.
    """
    shapes = {"IntrinsicMatrix": (3, 3), "RadialDistortion": (2,)}
    own = _arrays(intrinsics, shapes)
    placed = _arrays(extrinsics, {"rotationMatrix": (3, 3), "translationVector": (3,)})
    K = own["IntrinsicMatrix"].T.copy()
    K[:2, 2] -= 1.0
    distortion = np.r_[own["RadialDistortion"], np.zeros(3)]
    with reading(extrinsics):
        return Camera(K, placed["rotationMatrix"].T, placed["translationVector"] * _MM, *SIZE_PX, distortion)


def _arrays(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Array]:
    found = read_npz(path)
    for name, shape in shapes.items():
        if name not in found or np.size(found[name]) != np.prod(shape):
            raise FileFormatError(path, f"{name}: expected an array {shape}; is it of another version of the set?")
    return {name: np.asarray(found[name], dtype=float).reshape(shape) for name, shape in shapes.items()}


def read_motions(path: Path) -> dict[str, Any]:
    """Read a person's ``F_v3d_Subject_1.mat``: names of the motions, flags30 and flags120 (M, 2) from 1, and joint
    centres, points (T, 20, 3). `FileFormatError`: not that struct, a field missing or of another shape, or damaged.
    """
    variables = matlab_variables(path, simplify_cells=True)
    struct: Any = next((value for name, value in variables.items() if name.startswith("Subject_")), None)
    move = struct.get("move") if isinstance(struct, dict) else None
    if not isinstance(move, dict):
        raise FileFormatError(path, "no struct Subject_1_F with a field move in it; another version of the set?")
    found: dict[str, Array] = {}
    for field in ("flags30", "flags120", "virtualMarkerLocation"):
        if field not in move:
            raise FileFormatError(path, f"no field {field} in it; is it of another version of the set?")
        with reading(path, f"move.{field} holds no numbers", TypeError, ValueError):
            found[field] = np.asarray(move[field], dtype=np.float64)
    motions = [str(name) for name in np.atleast_1d(move.get("motions_list", ()))]
    points, count = found["virtualMarkerLocation"], len(motions)
    if points.ndim != 3 or points.shape[1:] != (len(CENTRES), 3):
        raise FileFormatError(path, f"virtualMarkerLocation: {points.shape}, not (T, {len(CENTRES)}, 3)")
    for field in ("flags30", "flags120"):
        flags = found[field].reshape(-1, 2) if found[field].size == 2 * count else np.zeros((0, 2))
        if len(flags) != count or not (flags[:, 0] >= 1).all() or not (flags[:, 1] > flags[:, 0]).all():
            raise FileFormatError(path, f"move.{field}: expected first and last frame of {count} motions")
        found[field] = flags
    if found["flags120"].max(initial=0) > len(points):
        raise FileFormatError(path, f"move.flags120 ends after the {len(points)} frames of the markers")
    return {"motions": motions, "flags30": found["flags30"], "flags120": found["flags120"], "points": points}


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

    def _takes(self) -> Iterator[Take]:
        subjects = [*self.root.glob("subject*"), *self.root.glob("*/subject*")]
        for subject in sorted((p for p in subjects if p.is_dir()), key=lambda p: natural(p.name)):
            for folder in sorted(subject.glob("VideoData/Session*/Cam*/*/"), key=lambda p: natural(str(p))):
                trial, camera, session = folder.name, folder.parent.name, folder.parent.parent.name
                if trial.lower().startswith(_NO_MOVEMENT):
                    continue
                key = f"{subject.name}_{session}_{camera}_{trial}"
                yield Take(key, subject.name, trial, kind_of(trial, self.kinds), folder, camera)

    def inputs(self, take: Take) -> TakeInputs:
        """See `PublicSet.inputs`."""
        calibration = existing(
            take.folder.parent / "cameraIntrinsicsExtrinsics.json",
            "the calibration of the camera",
            "convert the .pickle of the data set (docs/validate.md), or measure without one: --uncalibrated",
        )
        return TakeInputs(video=_video(take), rate_hz=60.0, camera=calibration, height=_height(take))

    def truth(self, take: Take) -> Truth:
        """See `PublicSet.truth`."""
        path = _subject(take) / "OpenSimData" / "Mocap" / "IK" / f"{take.movement}.mot"
        existing(path, "the inverse kinematics of the markers", "unpack OpenSimData of LabValidation")
        table = read_opensim_table(path)
        if "knee_angle_r" not in table.names:
            raise FileFormatError(path, "has no column knee_angle_r: is it another version of the set?")
        video = _video(take)
        reach = 1.0 if video is None or video.stem.endswith(_SYNCHRONISED) else 3.0
        return Truth(table, _MEASURED, "OpenSim inverse kinematics of optical markers", reach=reach)


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
