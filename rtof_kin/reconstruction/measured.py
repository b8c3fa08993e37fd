"""Measurements that a reconstruction used, as plain data at the times of its motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtof_kin.body.metrics import at_times
from rtof_kin.data.keypoints import Measurements
from rtof_kin.reconstruction.result import Reconstruction


def measurements_of(result: Reconstruction) -> Measurements:
    """Return the measurements at the times of the motion, corrected by the calibration that was applied."""
    recording, times = result.recording, result.motion.poses.times
    seen = () if result.keypoints is None else (result.keypoints, *recording.views)
    measured, calibration = result.bone_imus, recording.calibration
    sensors: dict[str, Any] = {}
    if measured is not None and calibration is not None:
        measured = measured.resample(times)
        names = (calibration.sensors[calibration.joints.index(joint)] for joint in measured.joints)
        own = calibration.select(tuple(names))
        R_bone_sensor = np.swapaxes(own.R_sensor_bone, -1, -2)
        sensors = {
            "sensors": own.sensors,
            "segments": measured.joints,
            "R_world_sensor": measured.R_world_bone @ R_bone_sensor,
            "R_bone_sensor": R_bone_sensor,
            "p_bone_sensor": own.p_bone_sensor,
        }
    return Measurements(
        times=times,
        views=tuple(view.resample(times).landmarks for view in seen),
        **sensors,
        truth=None if recording.truth is None else at_times(recording.truth, times),
        faults=result.faults,
        floor_height=recording.floor_height,
    )
