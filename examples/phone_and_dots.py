"""A phone and sensors, e.g. Movella DOTs: ``python examples/phone_and_dots.py HEIGHT OUT VIDEO SENSORS...``.

SENSORS are files or folders as they come from the sensors, and maybe a file of two columns that says which
sensor is where. Clocks, headings and mounting are found from the motion.
"""

import sys
from pathlib import Path

from rtof_kin import Recording, export, reconstruct
from rtof_kin.reporting.page import report
from rtof_kin.setup.init import SetupSettings, find_people, write_recording
from rtof_kin.setup.sources import Sources
from rtof_kin.vision.video import detect_video

height, out, files = float(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
sources, settings = Sources.of(files), SetupSettings(height=height)

find_people(sources, settings, out / "recording", detect_video)
found = write_recording(sources, settings, out / "recording")
print("found:", *found.found, sep="\n  ")
print("doubtful:", *found.doubtful, sep="\n  ")

recording = Recording.load(out / "recording")
assert recording.calibration is not None
for sensor, joint in zip(recording.calibration.sensors, recording.calibration.joints, strict=True):
    print(f"{sensor} is on {joint}")
result = reconstruct(recording, mode="rtof")
export(result, out / "motion")
(out / "report.html").write_text(report(out / "motion"), encoding="utf-8")
