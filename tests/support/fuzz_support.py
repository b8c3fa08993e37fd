"""Every reader of the package with a small valid example.

To add a reader, add a line to `READERS`: a name, the example's files by their names in a folder, and how
to read that folder. `test_fuzz_readers` damages each file of it in turn.
"""

from __future__ import annotations

import functools
import importlib.util
import io
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import gait_support
import human36m_files
import numpy as np
import planted
import sensor_files
import total_capture_support
import xdf_file

from rtof_kin.body.motion_file import write_motion
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.core.files.arrays import read_csv, read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.datasets.human36m import Human36M
from rtof_kin.datasets.human36m_files import read_cameras as read_human36m_cameras
from rtof_kin.datasets.total_capture_files import read_detections
from rtof_kin.formats import total_capture
from rtof_kin.formats.asf_amc import read_asf_amc
from rtof_kin.formats.bvh import read_bvh
from rtof_kin.formats.camera_motion import read_camera_motion, write_camera_motion
from rtof_kin.formats.camera_toml import read_camera_toml, write_camera_toml
from rtof_kin.formats.cameras import read_opencv_yaml
from rtof_kin.formats.gait_events import read_event_corrections
from rtof_kin.formats.gait_reference import read_gait_reference, write_gait_reference
from rtof_kin.formats.markers import MarkerSequence, read_c3d, read_trc, write_c3d, write_trc
from rtof_kin.formats.opensim import read_opensim_table, write_mot
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.mvnx import read_mvnx
from rtof_kin.formats.sensors.sensor_map import read_sensor_map
from rtof_kin.formats.trial_results import TrialResults
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.inspection import inspect
from rtof_kin.setup.sources import Sources
from rtof_kin.simulation.mocap import read_corpus as read_mocap_corpus
from rtof_kin.simulation.mocap import read_mocap
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.layouts import detector_table, read_layout

DATA = Path(__file__).parents[1] / "fixtures"
Files = Mapping[str, bytes]


@dataclass(frozen=True)
class Reader:
    """A reader and what it reads."""

    name: str
    example: Callable[[], Files]
    """Makes contents by name in a folder."""
    read: Callable[[Path], Any]
    """From that folder."""

    @cached_property
    def files(self) -> Files:
        """The example, made once."""
        return self.example()

    def __str__(self) -> str:
        return self.name


def made_by(write: Callable[[Path], object]) -> Files:
    """The files that a function writes into a folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        paths = sorted(filter(Path.is_file, folder.rglob("*")))
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def real(*parts: str) -> bytes:
    return DATA.joinpath(*parts).read_bytes()


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


@cache
def motion() -> Any:
    return planted.moving(SKELETON, 4)


def _markers() -> MarkerSequence:
    p = np.random.default_rng(0).normal(size=(4, 3, 3))
    p[1, 1] = np.nan
    return MarkerSequence(np.arange(4) / 50, ("LASI", "RASI", "C7"), p)


def _human36m() -> Files:
    return made_by(lambda folder: human36m_files.write_dataset(folder, ("S9",), 1, 4))


def _read_human36m(folder: Path) -> Any:
    both = [Human36M(folder, keypoints=kind) for kind in ("gt", "cpn_ft_h36m_dbb")]
    take = "S9", "Action 0"
    seen = [data.keypoints(*take, 0) for data in both]
    return both[0].all_cameras, both[0].positions(*take), seen


@cache
def _total_capture() -> Files:
    take = total_capture_support.take(frames=30)
    return made_by(lambda folder: total_capture_support.dataset(folder, take))


def total_capture_file(ending: str) -> bytes:
    return next(v for name, v in _total_capture().items() if name.lower().endswith(ending))


OPENPOSE = b'{"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": [%s]}]}' % b", ".join(
    b"%d.5, %d.25, 0.5" % (100 + 10 * i, 200 + 20 * i) for i in range(25)
)
OPENCV = b"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]
distortion_coefficients: [ 0.1, -0.05, 0., 0., 1.0e-03 ]
R: [ 0.1, 0.2, 0.3 ]
T: [ 0.5, 1.5, 4. ]
"""


LAYOUT = b"""[[point]]
name = "RightCoin"
joint = "RightUpLeg"
offset_mm = [70, -80, -200]
spread_mm = [10, 20, 30]

[[layout]]
name = "pockets"
names = ["nose", "coin_R", "tape"]
points = { tape = "LeftAsis" }
whole = { 9 = [0, 4, 8] }
"""
_HALPE = detector_table().layout("halpe26").names[5:19]
PIXEL_TRC = "\n".join(
    [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "DataRate\tNumFrames\tNumMarkers\tUnits",
        "30\t1\t14\tm",
        "Frame#\tTime\t" + "\t\t\t".join(_HALPE) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, 15)),
        "0\t0.0" + "\t151.5\t212.5\t0" * 14,
        "",
    ]
).encode()


def sensor_file(title: str) -> Files:
    """Six samples of a sensor or two in a format of `sensor_files.WRITERS`."""
    truths = [sensor_files.truth(seed, T=6) for seed in (0, 1)]
    files = made_by(lambda folder: sensor_files.WRITERS[title](folder, truths))
    return {name: files[name] for name in files if sensor_files.SERIALS[1] not in name}


def sensors(title: str) -> Reader:
    """A sensor format, read as a folder and recognised by its content."""
    return Reader(f"sensors {title}", functools.partial(sensor_file, title), read_sensor_log)


def _corpus_index() -> Files:
    rows = b"file,subject,tc_like,fps,quality\nwalk.bvh,CMU002,walking,30,ok\n"
    return {"index.csv": rows, "walk.bvh": real("mocap", "02_01_excerpt.bvh")}


def _lifter() -> Files:
    import lifting_support

    from lifting.checkpoint import save_checkpoint

    lifter = lifting_support.untrained_lifter(channels=4)
    return made_by(lambda d: save_checkpoint(d / "a.npz", lifter.weights, lifter.description))


def _learning() -> tuple[Reader, ...]:
    """The readers of `lifting`, none without torch."""
    if importlib.util.find_spec("torch") is None:
        return ()
    import lifting_support

    from lifting.checkpoint import load_checkpoint
    from lifting.training.corpus import read_corpus, read_split

    return (
        Reader("lifter", _lifter, lambda d: load_checkpoint(d / "a.npz")),
        written("corpus", "a.npz", lambda p: lifting_support.tiny_corpus(4, 3).save(p), read_corpus),
        given("split", "a.toml", b'test = ["S9"]\nvalidation = ["S8", "S7"]\n', read_split),
    )


def one(name: str, content: Callable[[], bytes] | bytes) -> Callable[[], Files]:
    """The example of a reader of one file."""
    return lambda: {name: content() if callable(content) else content}


def given(title: str, name: str, content: Callable[[], bytes] | bytes, read: Callable[[Path], Any]) -> Reader:
    """A reader of one file with given contents."""
    return Reader(title, one(name, content), lambda folder: read(folder / name))


def written(title: str, name: str, write: Callable[[Path], object], read: Callable[[Path], Any]) -> Reader:
    """A reader of one file (or folder) made by a writer."""
    example = functools.partial(made_by, lambda folder: write(folder / name))
    return Reader(title, example, lambda folder: read(folder / name))


def _points_xdf() -> bytes:
    labels = ("nose_x", "nose_y", "nose_confidence", "left_hip_x", "left_hip_y")
    values = np.random.default_rng(0).uniform(0.1, 1, (4, 5)) * [640, 480, 1, 640, 480]
    return xdf_file.content(xdf_file.Stream(1, "points", labels, np.arange(4.0), values, type="MoCap"))


def _with_sensor_files() -> Files:
    index = b'schema_version = 1\n[imus]\nfile = "dot"\nsensor_map = "map.csv"\nstart_s = -5.0\n'
    files = {f"dot/{name}": content for name, content in sensor_file("Movella DOT CSV").items()}
    return {"recording.toml": index, "map.csv": b"serial,segment\n00B40001,left shank\n", **files}


def recording(folder: Path) -> None:
    """Save a recording in ``folder/take``."""
    _take(folder / "take")


def _take(path: Path) -> object:
    return planted.recording(planted.moving(SKELETON, 12)).save(path)


def _model(name: str) -> Callable[[], bytes]:
    return model_path(name).read_bytes


def _strikes(path: Path) -> object:
    return read_event_corrections(path, np.arange(4.0))


STRIKES = TrialResults(((0.1, "left", "foot_strike"), (0.2, "right", "foot_off")))
UV = np.random.default_rng(1).uniform(100, 900, (4, 21, 2))
CAMERA, SKELETON = planted.camera(), SkeletonModel.default()
TURNING = CameraMotion(np.arange(5) / 30, np.tile(np.eye(3), (5, 1, 1)))
TC = functools.partial(functools.partial, total_capture_file)
READERS = (
    given("npz", "a.npz", lambda: npz(a=UV, b=np.eye(3)), read_npz),
    given("csv", "a.csv", b"time,b\n0.0,1e3\n0.1,\n0.2,-3\n", read_csv),
    written("motion.h5", "motion.h5", lambda p: write_motion(p, motion()), Motion.load),
    # --- motion capture
    given("BVH", "a.bvh", lambda: real("mocap", "10_01_excerpt.bvh"), read_bvh),
    Reader(
        "ASF and AMC",
        lambda: {"a.asf": real("mocap", "16.asf"), "a.amc": real("mocap", "16_15.amc")},
        lambda d: read_asf_amc(d / "a.asf", d / "a.amc"),
    ),
    given("motion capture", "a.bvh", lambda: real("mocap", "02_01_excerpt.bvh"), read_mocap),
    Reader("motion capture corpus", _corpus_index, lambda d: list(read_mocap_corpus(d))),
    written("TRC", "a.trc", lambda p: write_trc(p, _markers()), read_trc),
    written("OpenSim coordinates", "a.mot", lambda p: write_mot(p, motion()), read_opensim_table),
    written("C3D", "a.c3d", lambda p: write_c3d(p, _markers()), read_c3d),
    written("C3D events", "a.c3d", lambda p: write_c3d(p, _markers(), results=STRIKES), _strikes),
    given("table of events", "a.txt", b"\tLHS\tRTO\nITEM\tX\tX\n1\t1.25\t1.5\n2\t2.5\t\n", _strikes),
    # --- cameras
    written("camera TOML", "a.toml", lambda p: write_camera_toml(p, {"left": CAMERA}), read_camera_toml),
    written("camera motion", "a.npz", lambda p: write_camera_motion(p, TURNING), read_camera_motion),
    given("OpenCV YAML", "a.yml", OPENCV, read_opencv_yaml),
    given(
        "OpenCV JSON",
        "a.json",
        b'{"width": 64, "height": 48, "K": [[9, 0, 3], [0, 9, 2], [0, 0, 1]],\n'
        b'"rvec": [0.1, 0, 0], "tvec": [0, 0, 4], "D": {"rows": 1, "data": [0.1, 0, 0, 0]}}',
        read_opencv_yaml,
    ),
    # --- datasets
    given("Total Capture positions", "a.txt", TC("gt_skel_gbl_pos.txt"), lambda p: total_capture.read_joints(p, 3)),
    given("Total Capture sensors", "a.sensors", TC("_xsens.sensors"), total_capture.read_sensors),
    given("Total Capture IMU calibration", "a.txt", TC("calib_imu_bone.txt"), total_capture.read_imu_calibration),
    given("Total Capture cameras", "a.cal", TC("calibration.cal"), total_capture.read_cameras),
    Reader("Human3.6M archives", _human36m, _read_human36m),
    Reader(
        "Human3.6M cameras in JSON",
        lambda: made_by(lambda d: human36m_files.write_camera_json(d, ("S9",))),
        lambda d: read_human36m_cameras(d / "camera-parameters.json"),
    ),
    Reader(
        "Human3.6M cameras in Python",
        lambda: made_by(lambda d: human36m_files.write_camera_source(d, ("S9",))),
        lambda d: read_human36m_cameras(d / "h36m_dataset.py"),
    ),
    Reader(
        "dataset detections",
        lambda: {"S5_acting3_cam1.npz": npz(uv_px=UV[:, :2]), "landmarks.txt": b"Hips\nLeftArm\n"},
        lambda d: read_detections(d, "S5", "acting3", 1, CAMERA),
    ),
    # --- detectors
    Reader("OpenPose", one("p_0_keypoints.json", OPENPOSE), read_detector_file),
    given(
        "COCO results",
        "a.json",
        b'[{"image_id": 0, "keypoints": [1.5, 2.5, 0.5, 3, 4, 1], "idx": 1},\n'
        b'{"image_id": "1.jpg", "keypoints": [1.5, 2.5, 0.5, 3, 4, 1], "idx": 1}]',
        read_detector_file,
    ),
    given(
        "MediaPipe",
        "a.json",
        b'{"frames": [{"time": 0.1, "landmarks": [{"x": 0.5, "y": 0.25, "visibility": 1},\n'
        b'{"x": 0.75, "y": 0.25, "visibility": 0.5}]}]}',
        lambda p: read_detector_file(p, 640, 480),
    ),
    given("detector npz", "a.npz", lambda: npz(uv_px=UV), read_detector_file),
    written("detector npy", "a.npy", lambda p: np.save(p, UV), read_detector_file),
    given(
        "detector csv", "a.csv", b"time,nose_x,nose_y,nose_score\n0.0,151.5,212.5,0.5\n0.1,,,0\n", read_detector_file
    ),
    given(
        "rows of points",
        "a.csv",
        b"frame,time,landmark,x,y,visibility\n0,0.0,0,151.5,212.5,0.5\n0,0.0,1,153,,0\n1,0.1,0,150,1,1\n",
        read_detector_file,
    ),
    given(
        "DeepLabCut",
        "a.csv",
        b"scorer,d,d,d\nbodyparts,hip,hip,hip\ncoords,x,y,likelihood\n0,151.5,212.5,0.5\n1,,,0\n",
        read_detector_file,
    ),
    given(
        "SLEAP",
        "a.csv",
        b"track,frame_idx,instance.score,hip.x,hip.y,hip.score\na,0,0.5,151.5,212.5,0.5\nb,0,1,,,0\na,1,1,1,2,1\n",
        read_detector_file,
    ),
    given("layout", "a.toml", LAYOUT, read_layout),
    given("markers in pixels", "a_px.trc", PIXEL_TRC, read_detector_file),
    given("points in XDF", "a.xdf", _points_xdf, read_detector_file),
    # --- tables of this package
    written(
        "gait reference", "a.json", lambda p: write_gait_reference(p, gait_support.means_only()), read_gait_reference
    ),
    given("skeleton table", "a.toml", _model("skeleton.toml"), read_skeleton_table),
    given("URDF", "a.urdf", _model("skeleton.urdf"), SkeletonModel.from_urdf),
    written("recording", "take", _take, Recording.load),
    # --- learning
    *_learning(),
    # --- inertial sensors
    *map(sensors, sensor_files.WRITERS),
    given("sensor map", "a.csv", b"serial,segment\nB279,pelvis # loose\nB27D,right shank\n", read_sensor_map),
    Reader("recording of sensor files", _with_sensor_files, Recording.load),
    given("sources", "a.json", OPENPOSE, lambda p: Sources.of([p])),
    # --- any of them
    written("inspect motion.h5", "motion.h5", lambda p: write_motion(p, motion()), inspect),
    written("inspect a.trc", "a.trc", lambda p: write_trc(p, _markers()), inspect),
    written("inspect a.c3d", "a.c3d", lambda p: write_c3d(p, _markers()), inspect),
    given("inspect a.bvh", "a.bvh", lambda: real("mocap", "10_01_excerpt.bvh"), inspect),
    given("inspect a.yml", "a.yml", OPENCV, inspect),
    Reader("inspect a.csv", lambda: sensor_file("plain CSV"), lambda d: inspect(d / "trial.csv")),
    written("inspect take", "take", _take, inspect),
    Reader("MVNX", lambda: sensor_file("Xsens MVNX"), lambda d: read_mvnx(d / "trial.mvnx")),
)


def write_files(folder: Path, files: Files) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
