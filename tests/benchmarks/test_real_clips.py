"""The benchmark of real clips: its reader on a written clip, its figures on planted points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from detector_support import walking

from benchmarks.real_clips import USUAL, Clip, caliscope, kinds_of_places, score, used
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import detector_point
from rtof_kin.vision.image_points import image_points

LAYOUT = "mediapipe33"
MOTION = walking()
SKELETON, POSES = MOTION.skeleton, MOTION.poses[:20]
CAMERAS = tuple(
    Camera.looking_at([4 * np.cos(a), 4 * np.sin(a), 1.3], [0, 0, 1.0], 1250.0) for a in np.radians([10, 100, 190, 280])
)


def test_planted_points_have_no_error_and_those_at_other_places_have() -> None:
    kinds = kinds_of_places(LAYOUT)
    assert list(kinds) == [USUAL, "measured places", "measured, views"]
    assert list(kinds_of_places("coco17")) == [USUAL]
    names = tuple(detector_point(LAYOUT, name) for name in kinds[USUAL])
    points = {}
    for kind, places in kinds.items():
        with used(places):
            points[kind] = image_points(SKELETON, names)
    planted, p, R = points["measured, views"], POSES.p_world_joint, POSES.R_world_bone
    at = planted.positions(p, R)
    uv = np.stack([camera.project(at) + planted.displaced(camera, p, R) for camera in CAMERAS])
    clip = Clip((), CAMERAS, SKELETON, names, uv, np.ones(uv.shape[:-1]))
    right = score(clip, 1, planted, POSES, None)
    assert right == pytest.approx(dict.fromkeys(right, 0.0), abs=1e-6)
    other = score(clip, 1, points[USUAL], POSES, None)
    assert other["shape_mm"] > 10
    assert other["other_px"] > 5
    shifted = POSES.with_poses(slice(None), p + np.array([0.0, 0.03, 0.04]), R)
    moved = score(clip, 1, points["measured, views"], shifted, None)
    assert moved["absolute_mm"] == pytest.approx(50, abs=2)
    assert moved["relative_mm"] == pytest.approx(0, abs=2)


def test_a_clip_of_caliscope_is_read(tmp_path: Path) -> None:
    cameras = "".join(
        f"[cam_{k}]\nsize = [1280, 720]\nmatrix = [[900.0, 0, 640], [0, 900.0, 360], [0, 0, 1]]\n"
        "distortions = [0.0, 0, 0, 0, 0]\ntranslation = [0.0, 0, 3]\nrotation = [0.0, 0, 0]\n"
        for k in (0, 1)
    )
    (tmp_path / "config.toml").write_text(cameras)
    rows = [f"{t},{k},{t},0.0,{i},{300 + 9 * i},{200 + 9 * i},," for t in (0, 1) for k in (0, 1) for i in range(33)]
    (tmp_path / "xy_HOLISTIC.csv").write_text("\n".join(["header", *rows, "1,0,1,0.0,104,5,5,,"]))
    trial = caliscope(tmp_path)
    assert [view.name for view in trial.views] == ["cam_0", "cam_1"]
    np.testing.assert_allclose(trial.views[1].uv_px[1, 4], [336, 236])
    assert trial.views[0].weight.all()
    np.testing.assert_allclose(trial.views[0].camera.R_camera_world.T @ [1, 0, 0], [0, 0, 1], atol=1e-12)
