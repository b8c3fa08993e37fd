"""``follow.png``: three simulated visits of a walker who carries the right elbow bent, less and less.

Two walks at each visit: one of `tests/fixtures/mocap` at two tempi, with other errors and mountings.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from docs.pictures.studio import DOCS, Studio, save
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.recording.labels import Session
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_mocap, resample_clip
from rtof_kin.simulation.simulate import SimulationSettings, low_passed, simulate, standard_cameras

WALK: Final = DOCS.parent / "tests" / "fixtures" / "mocap" / "16_16.amc"
TEMPI: Final = {"walk1": 39.3, "walk2": 40.6}
"""Trial -> frame rate, Hz, that the walk is played at; it was captured at 40 Hz."""
VISITS: Final = {"2026-01-10": 2.5, "2026-02-14": 1.6, "2026-03-21": 1.0}
"""Day -> factor of the flexion of the right elbow."""
PLAN: Final = '[better]\nright_elbow_flexion_mean = "down"\n'
MEASURES: Final = "right_elbow_flexion,right_knee_flexion,gait_speed,stance_share_symmetry"
WIDTH, HEIGHT = 1200, 1180


def make(studio: Studio) -> list[Path]:
    from PIL import Image

    visits, page = studio.folder / "visits", studio.folder / "follow"
    for number, (day, factor) in enumerate(VISITS.items()):
        for place, (name, rate_hz) in enumerate(TEMPI.items()):
            folder = studio.folder / "walks" / day / name
            _recorded(rate_hz + 0.2 * number, factor, 10 * number + place + 4, day).save(folder)
            studio.rtof_kin("reconstruct", folder, "-o", visits / day / name)
    (visits / "follow.toml").write_text(PLAN, encoding="utf-8")
    print(studio.printed("compare", visits, "--measures", MEASURES, "-o", page))
    picture = studio.folder / "follow.png"
    studio.photograph(page / "follow.html", picture, WIDTH, HEIGHT)
    with Image.open(picture) as whole:
        return [save(whole, "follow.png", WIDTH)]


def _recorded(rate_hz: float, factor: float, seed: int, day: str) -> Recording:
    """The walk with more flexion of the right elbow."""
    clip = resample_clip(low_passed(read_mocap(WALK, rate_hz=rate_hz, output_rate_hz=None), 10.0), 60.0)
    clip = _bent(clip, factor)
    camera = standard_cameras(clip.poses, 7)[1]
    recording = simulate(
        clip.poses,
        clip.joint_offsets,
        camera=camera,
        settings=SimulationSettings.realistic(),
        seed=seed,
        name=f"{day}, {rate_hz:.1f} Hz",
    )
    return replace(recording, session=Session(subject="Example", date=day, protocol="walk 4 m"))


def _bent(clip: MocapClip, factor: float) -> MocapClip:
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    q = np.array(skeleton.motion(clip.poses).q)
    q[:, 7 + skeleton.dof_names.index("RightForeArm_z")] *= factor
    p, R = skeleton.forward_kinematics(q)
    return replace(clip, poses=replace(clip.poses, p_world_joint=p, R_world_bone=R))
