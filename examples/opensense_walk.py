"""Sensors alone, OpenSense's walk: ``python examples/opensense_walk.py SENSORS MAP OUT [CALIBRATION_POSE]``.

SENSORS is the folder ``IMUData`` of OpenSim's OpenSense example (Apache-2.0, opensim-core), MAP its
``myIMUMappings.xml``, or any sensors that stand still for a second first and a file of two columns.
"""

import sys

from rtof_kin import Recording, SkeletonModel, export, reconstruct
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.sensor_map import matched, read_sensor_map
from rtof_kin.inertial.pose_calibration import calibrate_by_pose
from rtof_kin.inertial.segment_names import known_segment
from rtof_kin.recording.sensor_files import imus_of_log

sensors, places, out, pose = *sys.argv[1:4], sys.argv[4] if len(sys.argv) > 4 else "N"
skeleton = SkeletonModel.default()

log = read_sensor_log(sensors)
joints = {
    sensor: known_segment(place, skeleton) for sensor, place in matched(read_sensor_map(places), log.names).items()
}
found = calibrate_by_pose(log, joints, pose, skeleton)
print("stood still from {:.1f} to {:.1f} s".format(*found.still), *found.warnings, sep="\nnote: ")

recording = Recording("walk", imus=imus_of_log(log.select(list(joints))), calibration=found.calibration)
result = reconstruct(recording, mode="imu")
export(result, out, formats=("csv", "mot"))
print(f"{len(result.motion.times)} frames of {len(joints)} sensors; OpenSim opens {out}")
for warning in result.warnings:
    print("note:", warning)
