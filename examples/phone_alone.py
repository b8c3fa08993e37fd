"""A phone alone: ``python examples/phone_alone.py HEIGHT OUT VIDEO``, as ``rtof-kin run`` does it.

Instead of the video, or beside it, a detector's keypoints; also a calibration of the camera.
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

people = find_people(sources, settings, out / "recording", detect_video)
print(f"{len(people)} people: {out}/recording/frames.png")
found = write_recording(sources, settings, out / "recording")
print("assumed:", *found.assumed, sep="\n  ")
print("doubtful:", *found.doubtful, sep="\n  ")

result = reconstruct(Recording.load(out / "recording"), mode="rto")
export(result, out / "motion")
(out / "report.html").write_text(report(out / "motion"), encoding="utf-8")
print(f"{len(result.motion.times)} frames; open {out}/report.html")
