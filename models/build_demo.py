"""Make the demo recording: ``python models/build_demo.py CORPUS`` with the folder of free motion.

24 s of CMU 14_14 (jumping jacks, jogging, squats, side twists), a test subject that no shipped lifter was
trained on, with a simulated camera, realistic 2D errors and eight simulated IMUs.
"""

import sys
from dataclasses import replace
from pathlib import Path

from rtof_kin.simulation.mocap import read_mocap, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

FIRST, STOP = 240, 1680
CMU = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)


def main(corpus: Path) -> None:
    """Write models/demo."""
    clip = read_mocap(corpus / "cmu_bvh" / "14_14.bvh", output_rate_hz=None)
    clip = resample_clip(low_passed(clip, 10.0), 60.0)
    poses = clip.poses[FIRST:STOP]
    poses = replace(poses, times=poses.times - poses.times[0])
    recording = simulate(
        poses,
        clip.joint_offsets,
        camera=standard_cameras(poses, seed=14)[0],
        settings=SimulationSettings.realistic(),
        seed=14,
        name="demo",
        acknowledgement=CMU,
    )
    notes = (
        "24 s of exercises (CMU 14_14, real motion capture), watched by one simulated camera with "
        "realistic errors and eight simulated IMUs on the limbs."
    )
    folder = Path(__file__).parent / "demo"
    replace(recording, notes=notes, first_frame=FIRST).save(folder, overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
