"""A real walk with simulated sensors on every usual segment, and its poses."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from clinical_support import WALK

from rtof_kin.core import rotations as so3
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import read_mocap, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras


@lru_cache
def walk() -> Recording:
    """A test subject's walk, filmed without errors, thirteen sensors with realistic ones."""
    clip = resample_clip(low_passed(read_mocap(WALK, rate_hz=40.0, output_rate_hz=None), 10.0), 60.0)
    settings = SimulationSettings.perfect()
    sensors = ("Head", "Sternum", "Pelvis", *settings.sensors, "L_Foot", "R_Foot")
    camera = standard_cameras(clip.poses, 1)[0]
    settings = replace(settings, sensors=sensors)
    return simulate(clip.poses, clip.joint_offsets, camera=camera, settings=settings, seed=1)


def walking_log(sensors: tuple[str, ...] | None = None) -> SensorLog:
    """Its sensors, all or some."""
    imus = walk().imus
    assert imus is not None
    log = SensorLog.of_imus(imus, "walk")
    return log if sensors is None else log.select(sensors)


def places() -> dict[str, str]:
    """Sensor -> segment."""
    calibration = walk().calibration
    assert calibration is not None
    return dict(zip(calibration.sensors, calibration.joints, strict=True))


def walking_poses(error_deg: float = 5.0) -> PoseSequence:
    """Its true poses with constant errors of every segment."""
    truth = walk().truth
    assert truth is not None
    rng = np.random.default_rng(2)
    off = so3.exp(np.radians(error_deg) * rng.standard_normal((len(truth.names), 3)))
    return replace(truth, R_world_bone=truth.R_world_bone @ off)


def turned(log: SensorLog, seed: int) -> SensorLog:
    """The same motion measured by sensors mounted otherwise, each with another heading."""
    rng = np.random.default_rng(seed)
    streams = []
    for stream in log.streams:
        R_new, turn = so3.exp(rng.standard_normal(3) * 2), so3.about_axis("z", rng.uniform(-3, 3))
        assert stream.R_inertial_sensor is not None
        assert stream.f_sensor is not None
        R = turn @ stream.R_inertial_sensor @ R_new
        streams.append(replace(stream, R_inertial_sensor=R, f_sensor=stream.f_sensor @ R_new))
    return replace(log, streams=tuple(streams))


SOME = ("Pelvis", "L_UpLeg", "R_UpLeg", "L_LowLeg", "R_LowLeg", "L_LowArm", "R_LowArm")


def some() -> Recording:
    """The walk with seven of its sensors."""
    recording = walk()
    assert recording.imus is not None
    assert recording.calibration is not None
    return replace(recording, imus=recording.imus.select(SOME), calibration=recording.calibration.select(SOME))


def exchanged(recording: Recording, a: str, b: str) -> Recording:
    """The samples of two sensors under each other's names."""
    imus = recording.imus
    assert imus is not None
    names = tuple({a: b, b: a}.get(name, name) for name in imus.names)
    return replace(recording, imus=replace(imus, names=names).select(imus.names))
