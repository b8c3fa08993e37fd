"""Reconstruction of a sensor trial without a camera: ``python examples/sensors_only.py TRIAL PATH [OUT]``.

TRIAL is a table of ``sensor_trials.toml`` with the placement of the sensors, PATH the sensors' file or
folder. The sensors are calibrated by the standing pose of a second or more at the start.
"""

import sys
import tomllib
from pathlib import Path

from sensors_only_figure import draw

from rtof_kin import Recording, SkeletonModel, export, reconstruct
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.inertial.orientation import OrientationSettings, log_with_orientation
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.recording.sensor_files import imus_of_log

trial, path = sys.argv[1], Path(sys.argv[2])
out = Path(sys.argv[3] if len(sys.argv) > 3 else f"out/{trial}")
facts = tomllib.loads((Path(__file__).parent / "sensor_trials.toml").read_text(encoding="utf-8"))[trial]

log = read_sensor_log(path, **facts.get("declared", {})).select(list(facts["joints"]))
if facts.get("vqf"):
    log = log_with_orientation(log, log.names, OrientationSettings(magnetometer=False))
found = calibrate_by_pose(log, facts["joints"], facts["pose"], SkeletonModel.default(), headings=facts["headings"])
for sentence in (*log.notes, *found.warnings):
    print("note:", sentence)
recording = Recording(trial, imus=imus_of_log(log), calibration=found.calibration)
result = reconstruct(recording, mode="imu")
export(result, out, overwrite=True)
draw(result, out / "figures" / "moving.png")
print(f"{len(result.motion.times)} frames; pose from {found.still[0]:.1f} to {found.still[1]:.1f} s")
print(f"root position at the end: standard deviation {result.root_sigma[-1]:.2f} m per axis")
for warning in result.warnings:
    print("note:", warning)
