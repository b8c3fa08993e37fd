"""Sensor files of every format, written with known motion in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
import xdf_file
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.data.imu import STANDARD_GRAVITY

Array = NDArray[np.float64]
G = STANDARD_GRAVITY
RATE = 60.0
REAL = Path(__file__).parents[1] / "fixtures" / "inertial"
SERIALS = ("00B40001", "00B40002")


@dataclass(frozen=True)
class Truth:
    """What one sensor truly measured."""

    R: Rotation
    """From the sensor to z up."""
    a: Array
    """(T, 3) acceleration in axes with z up, m/s^2."""
    f: Array
    """(T, 3) specific force in sensor axes, m/s^2."""
    w: Array
    """(T, 3) rad/s."""
    m: Array
    """(T, 3)"""

    @property
    def quat_wxyz(self) -> Array:
        return self.R.as_quat(scalar_first=True)


def truth(seed: int = 0, T: int = 40) -> Truth:
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng) * Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.03, (T, 3)), 0))
    a = rng.normal(0, 2, (T, 3))
    f = R.inv().apply(a + np.array([0, 0, G]))
    return Truth(R, a, f, rng.normal(0, 1, (T, 3)), rng.normal(0, 1, (T, 3)))


def lines(rows: Array, delimiter: str) -> list[str]:
    return [delimiter.join(f"{cell:.12g}" for cell in row) for row in rows]


def mt_text(one: Truth, counters: Array, orientation: str = "Quat", delimiter: str = "\t", rate: str = "60.0") -> str:
    names = ["PacketCounter", *(f"{kind}_{axis}" for kind in ("Acc", "Gyr", "Mag") for axis in "XYZ")]
    if orientation == "Quat":
        names += [f"Quat_q{i}" for i in range(4)]
        values = one.quat_wxyz
    elif orientation == "Mat":  # by columns, as OpenSense's example has them
        names += [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
        values = one.R.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    else:
        names += ["Roll", "Pitch", "Yaw"]
        values = one.R.as_euler("ZYX", degrees=True)[:, ::-1]
    rows = np.column_stack([counters, one.f, one.w, one.m, values])
    head = ["// Start Time: Unknown", f"// Update Rate: {rate}Hz", delimiter.join(names)]
    return "\n".join([*head, *lines(rows, delimiter), ""])


def write_mt(folder: Path, truths: list[Truth]) -> Path:
    for serial, one in zip(SERIALS, truths, strict=True):
        counters = np.arange(len(one.f)) + 100
        (folder / f"MT_1_000-001_{serial}.txt").write_text(mt_text(one, counters))
    return folder


def dot_text(one: Truth, stamps: Array, counters: Array | None = None, raw: bool = False) -> str:
    names = ["PacketCounter", "SampleTimeFine", "Quat_W", "Quat_X", "Quat_Y", "Quat_Z"]
    names += [f"{'Acc' if raw else 'FreeAcc'}_{axis}" for axis in "XYZ"]
    names += ["Gyr_X", "Gyr_Y", "Gyr_Z", "Mag_X", "Mag_Y", "Mag_Z", "Status"]
    counters = np.arange(len(stamps)) + 1 if counters is None else counters
    rows = np.column_stack(
        [counters, stamps, one.quat_wxyz, one.f if raw else one.a, np.rad2deg(one.w), one.m, np.zeros(len(stamps))]
    )
    head = ["sep=,", "DeviceTag:,Thigh", "OutputRate:,60Hz", "© Xsens", "", ",".join(names)]
    return "\n".join([*head, *lines(rows, ",")])


def write_dot(folder: Path, truths: list[Truth]) -> Path:
    for serial, one in zip(SERIALS, truths, strict=True):
        stamps = 5_000_000 + 16667 * np.arange(len(one.f))
        text = dot_text(one, stamps)
        (folder / f"{serial}_20210820_202113_1.csv").write_text(text, encoding="utf-8")
    return folder


def write_ximu3(folder: Path, truths: list[Truth]) -> Path:
    for serial, one in zip(SERIALS, truths, strict=True):
        own = folder / f"{serial} 64F0EDBF (UDP)"
        own.mkdir()
        stamps = 917_000_000 + 16667 * np.arange(len(one.f))
        kinds = ("Gyroscope {} (deg/s)", "Accelerometer {} (g)")
        axes = [kind.format(axis) for kind in kinds for axis in "XYZ"]
        tables = {
            "Inertial": (axes, np.column_stack([np.rad2deg(one.w), one.f / G])),
            "Quaternion": (["W", "X", "Y", "Z"], one.quat_wxyz),
            "Magnetometer": ([f"{axis} (a.u.)" for axis in "XYZ"], one.m),
        }
        for kind, (names, values) in tables.items():
            head = ",".join(["Timestamp (us)", *names])
            text = "\n".join([head, *lines(np.column_stack([stamps, values]), ","), ""])
            (own / f"{kind}.csv").write_text(text)
    return folder


def write_mat(folder: Path, truths: list[Truth]) -> Path:
    content: dict[str, object] = {"t": np.arange(len(truths[0].f))[:, None] / RATE}
    for serial, one in zip(SERIALS, truths, strict=True):
        content[f"s{serial}"] = {"acc": one.f, "gyr": one.w, "mag": one.m, "quat": one.quat_wxyz}
    path = folder / "trial.mat"
    scipy.io.savemat(path, content, do_compression=True)
    return path


def mvnx_text(truths: list[Truth], frames: str | None = None) -> str:
    labels = "".join(f'<sensor label="{serial}"/>' for serial in SERIALS[: len(truths)])
    if frames is None:
        frames = '<frame time="0" index="" type="tpose"><orientation>1 0 0 0</orientation></frame>'
        for i in range(len(truths[0].f)):
            quat, a, m = (
                " ".join(f"{x:.12g}" for one in truths for x in rows(one)[i])
                for rows in (lambda t: t.quat_wxyz, lambda t: t.a, lambda t: t.m)
            )
            frames += (
                f'<frame time="{round(1000 * i / 60)}" index="{i}" type="normal">'
                f"<orientation>1 0 0 0</orientation><position>0 0 {i / 100}</position>"
                f"<sensorFreeAcceleration>{a}</sensorFreeAcceleration>"
                f"<sensorMagneticField>{m}</sensorMagneticField>"
                f"<sensorOrientation>{quat}</sensorOrientation></frame>\n"
            )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<mvnx version="4" xmlns="http://www.xsens.com/mvn/mvnx">'
        f'<subject label="S" frameRate="60" segmentCount="1"><segments><segment label="Pelvis" id="1"/>'
        f"</segments><sensors>{labels}</sensors><frames>{frames}</frames></subject></mvnx>"
    )


def write_mvnx(folder: Path, truths: list[Truth]) -> Path:
    path = folder / "trial.mvnx"
    path.write_text(mvnx_text(truths))
    return path


def write_csv(folder: Path, truths: list[Truth]) -> Path:
    names, columns = ["time"], [np.arange(len(truths[0].f))[:, None] / RATE]
    for serial, one in zip(SERIALS, truths, strict=True):
        for kind, axes, values in (
            ("f", "xyz", one.f),
            ("w", "xyz", one.w),
            ("m", "xyz", one.m),
            ("q", "wxyz", one.quat_wxyz),
        ):
            names += [f"{serial}_{kind}{axis}" for axis in axes]
            columns.append(values)
    path = folder / "trial.csv"
    path.write_text("\n".join([",".join(names), *lines(np.column_stack(columns), ","), ""]))
    return path


def write_sto(folder: Path, truths: list[Truth]) -> Path:
    times = [f"{i / RATE:.12g}" for i in range(len(truths[0].f))]
    columns = [lines(one.quat_wxyz, ",") for one in truths]
    rows = ["\t".join(cells) for cells in zip(times, *columns, strict=True)]
    names = "\t".join(["time", *(f"{serial}_imu" for serial in SERIALS)])
    path = folder / "trial.sto"
    head = ["DataRate=60.000000", "DataType=Quaternion", "version=3", "OpenSimVersion=4.1", "endheader"]
    path.write_text("\n".join([*head, names, *rows, ""]))
    return path


def write_total_capture(folder: Path, truths: list[Truth]) -> Path:
    text = [f"{len(truths)}\t{len(truths[0].f)}"]
    for i in range(len(truths[0].f)):
        text.append(str(i + 1))
        for serial, one in zip(SERIALS, truths, strict=True):
            text.append("\t".join([serial, *(f"{x:.12g}" for x in (*one.quat_wxyz[i], *one.f[i]))]))
    path = folder / "s1_walking1_Xsens.sensors"
    path.write_text("\n".join([*text, ""]))
    return path


def write_noraxon(folder: Path, truths: list[Truth]) -> Path:
    names, columns = ["time", "Activity"], [np.arange(len(truths[0].f)) / RATE, np.zeros(len(truths[0].f))]
    for serial, one in zip(SERIALS, truths, strict=True):
        for i, axis in enumerate("xyz"):
            names.append(f"{serial} Accel Sensor {axis.upper()} (mG)")
            columns.append(one.f[:, i] / G * 1000)
            names.append(f"Noraxon MyoMotion-Segments-{serial}-Gyroscope-{axis} (deg/s)")
            columns.append(np.rad2deg(one.w[:, i]))
    head = ['"type","name","last_name"', '"gait, fast","A","B"', "", ",".join(f'"{name}"' for name in names)]
    path = folder / "trial.csv"
    path.write_text("\n".join([*head, *lines(np.column_stack(columns), ","), ""]))
    return path


def write_xdf(folder: Path, truths: list[Truth]) -> Path:
    """A file of LabRecorder: a stream for each sensor, in g and degrees, on clocks that were measured."""
    streams = []
    for number, (serial, one) in enumerate(zip(SERIALS, truths, strict=False), start=1):
        labels = [f"{kind}_{axis}" for kind in ("acc", "gyr", "mag") for axis in "xyz"]
        values = np.concatenate([one.f / G, np.rad2deg(one.w), one.m, one.quat_wxyz], axis=1)
        units = ["g"] * 3 + ["deg/s"] * 3 + [""] * 7
        times = 5000.0 + np.arange(len(values)) / RATE
        offsets = [(5000.0, 0.25), (5010.0, 0.25)]
        streams.append(
            xdf_file.Stream(
                number, serial, (*labels, "qw", "qx", "qy", "qz"), times, values, tuple(units), offsets=offsets
            )
        )
    path = folder / "trial.xdf"
    path.write_bytes(xdf_file.content(*streams))
    return path


def write_bids(folder: Path, truths: list[Truth]) -> Path:
    """As published data sets of Motion-BIDS: by quantity, degrees, n/a, channels of other kinds, latency last."""
    columns, channels = [], []
    kinds = (("ACCEL", "m/s^2", "xyz"), ("GYRO", "deg/s", "xyz"), ("MAGN", "n/a", "xyz"), ("ORNT", "n/a", "wxyz"))
    for kind, unit, axes in kinds:
        for serial, one in zip(SERIALS, truths, strict=False):
            values = {"ACCEL": one.f, "GYRO": np.rad2deg(one.w), "MAGN": one.m, "ORNT": one.quat_wxyz}[kind]
            columns += [*values.T, np.full(len(values), np.nan)]
            names = [f"quat_{axis}" if kind == "ORNT" else axis for axis in axes]
            channels += [f"{serial}_{kind}_{name}\t{name}\t{kind}\t{serial}\t{unit}\t60" for name in names]
            channels += [f"{serial}_{kind}_extra\tn/a\tMISC\t{serial}\tn/a\t60"]
    columns.append(np.arange(len(columns[0])) / RATE)
    head, stem = "name\tcomponent\ttype\ttracked_point\tunits\tsampling_frequency", "sub-pp002_task-walk"
    channels = [head, *channels, "imu_latency\tn/a\tLATENCY\tn/a\tseconds\t60", ""]
    (folder / f"{stem}_tracksys-imu_channels.tsv").write_text("\n".join(channels))
    path = folder / f"{stem}_tracksys-imu_motion.tsv"
    path.write_text("\n".join([*lines(np.column_stack(columns), "\t"), ""]).replace("nan", "n/a"))
    (folder / "task-walk_motion.json").write_text('{"SamplingFrequency": 60, "TaskName": "walk"}')
    return path


WRITERS: dict[str, Callable[[Path, list[Truth]], Path]] = {
    "Xsens MT Manager text": write_mt,
    "Movella DOT CSV": write_dot,
    "x-IMU3 folders": write_ximu3,
    "MATLAB structs": write_mat,
    "Xsens MVNX": write_mvnx,
    "Noraxon CSV": write_noraxon,
    "plain CSV": write_csv,
    "OpenSense .sto": write_sto,
    "Total Capture .sensors": write_total_capture,
    "XDF": write_xdf,
    "Motion-BIDS": write_bids,
}
"""One for each format, by its title: they write a trial and return what is to be read."""
