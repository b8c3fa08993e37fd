"""From sensors without a video to the folder of a recording: segments by their names, mounting by a pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.text import write_text
from rtof_kin.formats.imu_calibration_toml import calibration_table
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.pose_calibration import PoseCalibration, calibrate_by_pose
from rtof_kin.recording.index import INDEX, SCHEMA_VERSION
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.sensor_files import IMUS, imus_of_log, write_imus
from rtof_kin.setup.init import Findings, findings_of, subject_table, texts_of
from rtof_kin.setup.recording_text import Field, Origin, Tables
from rtof_kin.setup.sensors import known_places
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources


def make_sensor_recording(
    sources: Sources,
    settings: SetupSettings,
    folder: str | Path,
    *,
    name: str | None = None,
    inputs: Mapping[str, str] | None = None,
) -> Findings:
    """Write a recording of sensors alone; the person stands still in a known pose for a second.

    `sources`: sensors and, where their names do not say it, a map of their segments. `settings`: of the user; height
    and pose (`rtof_kin.inertial.pose_calibration.POSES`) are used. `name`: title in reports; default: of the files.
    `inputs`: fingerprints for the folder's manifest.

    Raises:
        InvalidInputError: which sensor is where is not known.
        CalibrationError: the sensors never rest, or two are on one segment. Errors of the files.
    """
    log, skeleton = read_sensor_log(sources.sensors), SkeletonModel.default()
    places = known_places(log, sources.sensor_map, skeleton)
    if places is None:
        raise InvalidInputError(
            f"{log.path}: without a video it must be known which sensor is where; name their segments in a "
            "file of two columns, --map FILE"
        )
    log = log.select(list(places))
    joints = {sensor: str(field.value) for sensor, field in places.items()}
    skeleton = skeleton if settings.height is None else skeleton.with_height(settings.height)
    found = calibrate_by_pose(log, joints, settings.pose, skeleton)
    imus = imus_of_log(log)
    first = float(imus.times[0])
    tables: Tables = {
        "schema_version": Field(SCHEMA_VERSION),
        "name": Field(name or sources.name),
        "subject": subject_table(settings),
        "imus": _sensors(found, imus.names, places, first),
    }
    findings = findings_of(tables, list(found.warnings))
    with new_folder(folder, INDEX, overwrite=True, inputs=inputs) as fresh:
        write_imus(fresh / IMUS, replace(imus, times=imus.times - first))
        for file, text in texts_of(findings, tables, sources, settings).items():
            write_text(fresh / file, text)
        Recording.load(fresh)
    return findings


def _sensors(found: PoseCalibration, names: tuple[str, ...], places: Mapping[str, Field], first: float) -> Tables:
    """Return the table ``[imus]``, of times from the first sample on."""
    start, stop = (at - first for at in found.still)
    held = f"{found.pose}-pose from {start:.1f} to {stop:.1f} s"
    pose = Field(list(names), Origin.ASSUMED, held, f"the person stood in the {held}; --pose takes another one")
    tables, sensors = calibration_table(found.calibration), dict[str, Tables]()
    for report in found.sensors:
        own, off = tables[report.sensor], f"± {report.expected_deg:.0f} degrees"
        sensors[report.sensor] = {
            "joint": places[report.sensor],
            "lever_arm_m": Field(own["lever_arm_m"], Origin.ASSUMED, "the usual place on this segment"),
            "R_world_inertial": Field(own["R_world_inertial"], Origin.FOUND, "heading"),
            "R_sensor_bone": Field(own["R_sensor_bone"], Origin.FOUND, f"mounting {off}, by the pose"),
            "mounting_sd_deg": Field(
                round(report.expected_deg / np.sqrt(3), 1), Origin.ASSUMED, f"about each axis, {off} in all"
            ),
        }
    usual = float(np.mean([report.expected_deg for report in found.sensors]))
    summary = f"mounting of {len(sensors)} sensors, ± {usual:.0f} degrees, by the pose"
    return {"file": Field(IMUS, Origin.FOUND, "", summary), "names": pose, "sensors": sensors}
