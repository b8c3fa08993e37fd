"""Measurements that a reconstruction used, as plain data at the times of its motion."""

from __future__ import annotations

import numpy as np

from rtof_kin.body.metrics import at_times
from rtof_kin.data.measurements import Measurements
from rtof_kin.reconstruction.result import Reconstruction


def measurements_of(result: Reconstruction) -> Measurements:
    """Return the measurements at the times of the motion, corrected by the calibration that was applied.

    Args:
        result: of `reconstruct`.
    """
    recording, times = result.recording, result.motion.poses.times
    seen = () if result.keypoints is None else (result.keypoints, *recording.views)
    measured, calibration = result.bone_imus, recording.calibration
    sensors, segments = tuple[str, ...](), tuple[str, ...]()
    R_bone_sensor = p_bone_sensor = np.empty((0, 3))
    R_world_sensor = np.empty((len(times), 0, 3, 3))
    if measured is not None and calibration is not None:
        measured = measured.resample(times)
        segments = measured.joints
        own = calibration.select(tuple(calibration.sensors[calibration.joints.index(j)] for j in segments))
        sensors, p_bone_sensor = own.sensors, own.p_bone_sensor
        R_bone_sensor = np.swapaxes(own.R_sensor_bone, -1, -2)
        R_world_sensor = measured.R_world_bone @ R_bone_sensor
    return Measurements(
        times=times,
        views=tuple(view.resample(times).landmarks for view in seen),
        sensors=sensors,
        segments=segments,
        R_world_sensor=R_world_sensor,
        R_bone_sensor=R_bone_sensor.reshape(-1, 3, 3),
        p_bone_sensor=p_bone_sensor,
        truth=None if recording.truth is None else at_times(recording.truth, times),
        faults=result.faults,
        floor_height=recording.floor_height,
    )
