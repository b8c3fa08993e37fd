"""Files of a take as a user has them: keypoints of a detector, sensors on a clock of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from detector_support import points_px, walking, watching
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import ImuSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.people import People, number_people
from rtof_kin.vision.keypoint_files import read_detector_file

Array = NDArray[np.float64]
LAYOUT = "halpe26"
SIZE = "1920x1080"


def walker() -> Array:
    """(T, K, 2) px of a walking person."""
    return points_px(LAYOUT, walking(), watching(walking()))


def beside(uv: Array, scale: float, shift: tuple[float, float]) -> Array:
    """The same person elsewhere in the image and of another size."""
    return scale * uv + np.asarray(shift)


def pair() -> tuple[Array, Array]:
    """Two people of one size, side by side."""
    first = beside(walker(), 0.7, (0.0, 200.0))
    return first, beside(first, 1.0, (700.0, 0.0))


def write_keypoints(path: Path, *people: Array, rate_hz: float | None = 30.0) -> Path:
    """An .npz file of people (T, K, 2) whose order changes from frame to frame."""
    uv = np.stack(people, axis=1)
    uv[1::2] = uv[1::2, ::-1]
    arrays = {"keypoints": np.concatenate([uv, np.full((*uv.shape[:-1], 1), 0.9)], axis=-1)}
    if rate_hz is not None:
        arrays["times"] = np.arange(len(uv)) / rate_hz
    np.savez(path, **arrays)
    return path


def people_in(path: Path) -> People:
    """The people of such a file in an image of 1920 x 1080 px."""
    found = read_detector_file(path)
    assert found.times is not None
    return number_people(found, found.times, (1920, 1080))


def write_demo(folder: Path, first: int, last: int, begun: float = 37.0) -> tuple[Path, Path, dict[str, str]]:
    """Seconds of the demo as keypoints and a CSV of sensors without names, and the segment of each.

    The sensors' clock shows `begun` when that of the video shows 0; each sensor has a heading of its own.
    """
    demo = Recording.load(model_path("demo"))
    assert demo.imus is not None
    assert demo.calibration is not None
    keypoints, imus = demo.video, demo.imus
    frames = (keypoints.times >= first) & (keypoints.times <= last)
    np.savez(
        folder / "keypoints.npz",
        uv_px=keypoints.uv_px[frames],
        confidence=keypoints.confidence[frames],
        times=keypoints.times[frames],
    )
    rng, near = np.random.default_rng(0), (imus.times >= first - 3) & (imus.times <= last + 3)
    turns = so3.about_axis("z", rng.uniform(-np.pi, np.pi, len(imus.names)))
    serials = tuple(f"00B4{22000 + 7 * s}" for s in range(len(imus.names)))
    turned = ImuSequence(imus.times[near] + begun, turns @ imus.R_inertial_sensor[near], imus.f_sensor[near], serials)
    segments = dict(zip(serials, demo.calibration.select(imus.names).joints, strict=True))
    return folder / "keypoints.npz", write_sensors(folder / "sensors.csv", turned), segments


def write_sensors(path: Path, imus: ImuSequence) -> Path:
    """A CSV of sensors."""
    columns = {"time": imus.times}
    for s, name in enumerate(imus.names):
        quat = so3.to_quat_wxyz(imus.R_inertial_sensor[:, s])
        columns |= {f"{name}_q{a}": q for a, q in zip("wxyz", quat.T, strict=True)}
        columns |= {f"{name}_f{a}": f for a, f in zip("xyz", imus.f_sensor[:, s].T, strict=True)}
    rows = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.7g")
    return path
