"""A phone, and sensors if there are any: ``python examples/phone_and_dots.py HEIGHT OUT VIDEO [SENSORS...]``.

`rtof_kin.run` does all of this in one call. SENSORS are files or folders as they come from the sensors, e.g. Movella
DOTs, and maybe a file of two columns that says which sensor is where. Clocks, headings and mounting are found from the
motion. Instead of the video, or beside it, a detector's keypoints; also a calibration of the camera.
"""

import sys
from pathlib import Path

from rtof_kin import Recording, export, make_recording, reconstruct, report

height, out, files = float(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
found = make_recording(files, out / "recording", height=height)
print("found:", *found.found, sep="\n  ")
print("doubtful:", *found.doubtful, sep="\n  ")

recording = Recording.load(out / "recording")
if recording.calibration is not None:
    for sensor, joint in zip(recording.calibration.sensors, recording.calibration.joints, strict=True):
        print(f"{sensor} is on {joint}")
result = reconstruct(recording)
export(result, out / "motion")
(out / "report.html").write_text(report(out / "motion"), encoding="utf-8")
print(f"{len(result.motion.times)} frames; open {out}/report.html")
