"""The scene of a planted motion, as the browser gets it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from overlay_support import write_film
from scene_support import BENT, RATE, camera, measured, walking, with_provenance, written

from rtof_kin.body.motion_file import MotionReader
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.camera_motion import CameraMotion, stabilised
from rtof_kin.data.poses import COLOURS, Provenance, Rgb
from rtof_kin.view.blocks import frame_at
from rtof_kin.view.camera_layer import camera_block
from rtof_kin.view.curves import AngleBlocks, Curves
from rtof_kin.view.layers import solid_colours
from rtof_kin.view.motion_scene import MotionScene
from rtof_kin.view.viewer import MotionViewer, Opened, local_server, motion_files

pytest.importorskip("viser")
FRAMES = 120
KINDS = [Provenance.CAMERA, Provenance.IMU, Provenance.BRIDGED, Provenance.PRIOR]


def shown(colour: Rgb) -> NDArray[np.uint8]:
    return solid_colours(np.array(colour, dtype=np.uint8))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    motion = with_provenance(walking(FRAMES), "Head", KINDS)
    return written(tmp_path_factory.mktemp("scene") / "a", motion, measured(motion))


@pytest.fixture(scope="module")
def files(out: Path) -> Iterator[Opened]:
    second = walking(FRAMES // 2, start=2.4)
    with motion_files(out, written(out.parent / "b", second)) as opened:
        yield opened


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    with local_server() as opened:
        yield opened


@pytest.fixture(scope="module")
def scene(server: Any, files: Opened) -> Iterator[MotionScene]:
    made = MotionScene(server, files.motion, files.measurements, files.second)
    yield made
    made.close()


def test_all_parts_are_there_and_can_be_hidden(scene: MotionScene) -> None:
    assert len(scene.layers) == 12
    for label, handle in (
        ("segments", scene.person.body.handle),
        ("95 % ellipsoids", scene.person.ellipsoids),
        ("floor", scene.stage.floor),
        ("detected points", scene.cameras[0].points["detected"]),
    ):
        scene.layers[label](False)
        assert not handle.visible
        assert scene.cameras[0].points["reprojected"].visible
        scene.layers[label](True)
        assert handle.visible
    assert scene.stage.height == pytest.approx(0.02)


def test_person_stands_where_the_motion_says(scene: MotionScene, files: Opened) -> None:
    for frame in (0, 77):
        assert scene.show(frame, 10.0) is not None
        poses = files.motion.read(frame, frame + 1).poses
        axes = scene.person.axes
        np.testing.assert_allclose(axes.batched_positions, poses.p_world_joint[0], atol=1e-5)
        np.testing.assert_allclose(so3.from_quat_wxyz(axes.batched_wxyzs), poses.R_world_bone[0], atol=1e-5)
        body = scene.person.body.handle
        assert np.all(body.batched_scales > 0)
        assert body.batched_opacities is None
        np.testing.assert_allclose(scene.stage.world.position[:2], -poses.p_world_joint[0, 0, :2], atol=1e-6)


def test_colour_of_a_segment_is_that_of_its_provenance(scene: MotionScene, files: Opened) -> None:
    head = files.motion.skeleton.index("Head")[0]
    grey, bridged = Provenance.PRIOR, Provenance.BRIDGED
    expected = [grey, grey, bridged, grey, Provenance.CAMERA_AND_IMU]  # its direction is not seen at first
    for frame, kind in enumerate(expected):
        scene.show(frame, 10.0)
        np.testing.assert_array_equal(scene.person.body.handle.batched_colors[head], shown(COLOURS[kind]))


def test_truth_and_second_motion_are_beside_it(scene: MotionScene, files: Opened) -> None:
    scene.show(30, 10.0)
    body, truth, second = (part.body.handle for part in (scene.person, scene.truth, scene.second) if part is not None)
    np.testing.assert_allclose(truth.batched_positions - body.batched_positions, [[0, 0.1, 0]] * 21, atol=1e-5)
    np.testing.assert_allclose(  # began 0.4 s later at the same place
        second.batched_positions - body.batched_positions, [[-0.4, 0, 0]] * 21, atol=1e-5
    )
    assert len({tuple(map(tuple, np.atleast_2d(h.batched_colors))) for h in (body, truth, second)}) == 3
    scene.show(5, 10.0)
    assert not second.batched_scales.any()  # it has not begun
    scene.put_beside(1.0)
    assert scene.truth is not None
    assert scene.second is not None
    np.testing.assert_allclose(scene.truth.frame.position, -scene.second.frame.position)
    assert np.linalg.norm(scene.truth.frame.position) == pytest.approx(1.0)
    scene.put_beside(0.0)


def test_sensors_sit_on_their_segments_with_measured_axes(scene: MotionScene, files: Opened) -> None:
    scene.show(40, 10.0)
    assert scene.sensors is not None
    assert files.measurements is not None
    given = files.measurements.read(40, 41)
    poses = files.motion.read(40, 41).poses
    joints = files.motion.skeleton.index(*given.segments)
    at = poses.p_world_joint[0, joints] + np.einsum("sij,sj->si", poses.R_world_bone[0, joints], given.p_bone_sensor)
    axes = scene.sensors.axes
    np.testing.assert_allclose(axes.batched_positions, at, atol=1e-5)
    np.testing.assert_allclose(so3.from_quat_wxyz(axes.batched_wxyzs), given.R_world_sensor[0], atol=1e-5)


def test_line_from_the_camera_through_a_point_meets_the_joint(scene: MotionScene, files: Opened) -> None:
    scene.show(50, 10.0)
    layer = scene.cameras[0]
    poses = files.motion.read(50, 51).poses
    joints = poses.p_world_joint[0] - camera().center_world
    for what in ("detected", "reprojected"):
        handle = layer.points[what]
        inside = np.asarray(handle.points) * handle.scale
        rays = so3.unit(inside @ so3.from_quat_wxyz(np.array(handle.wxyz)).T)
        np.testing.assert_allclose(handle.position, camera().center_world, atol=1e-9)
        assert len(rays) == len(joints)
        np.testing.assert_allclose(rays, so3.unit(joints), atol=2e-4)


def test_handheld_camera_turns_with_its_frames() -> None:
    motion = walking(FRAMES)
    view = measured(motion).views[0]
    turn = so3.exp(np.linspace(-0.2, 0.2, FRAMES)[:, None] * np.array([0.2, 1.0, 0.1]))
    still = CameraMotion(motion.times, turn).R_first_still
    R_world_true = camera().R_camera_world.T @ still.T @ turn
    true = [replace(camera(), R_camera_world=R.T, t_camera_world=-R.T @ camera().center_world) for R in R_world_true]
    uv = np.stack([c.project(p) for c, p in zip(true, motion.poses.p_world_joint, strict=True)])
    held = stabilised(replace(view, uv_px=uv), CameraMotion(motion.times, turn))
    assert held.turning is not None
    block = camera_block(held, motion.poses.p_world_joint)
    np.testing.assert_allclose(block.R_world_camera, R_world_true, atol=1e-6)
    seen = np.isfinite(block.detected).all(axis=-1)
    assert seen.mean() > 0.5
    rays = np.einsum("tij,tlj->tli", block.R_world_camera, so3.unit(block.detected))
    wanted = so3.unit(motion.poses.p_world_joint - camera().center_world)
    np.testing.assert_allclose(rays[seen], wanted[seen], atol=1e-6)
    np.testing.assert_allclose(block.reprojected[seen], block.detected[seen], atol=1e-6)


def test_looking_through_the_camera_puts_the_image_behind_the_person(scene: MotionScene) -> None:
    scene.behind = 0
    scene.show(50, 10.0)
    distance = np.linalg.norm(camera().center_world - [0.96, 0, 0.95])
    assert scene.cameras[0].points["detected"].scale > 1.2 * distance
    scene.behind = None
    scene.show(51, 10.0)
    assert scene.cameras[0].points["detected"].scale < 1.0


def test_measurements_of_another_motion_are_refused(out: Path, tmp_path: Path) -> None:
    motion = walking(60)
    other = written(tmp_path / "c", motion)
    (other / "measurements.h5").write_bytes((out / "measurements.h5").read_bytes())
    with pytest.raises(FileFormatError, match="not of the motion.h5 beside it"), motion_files(other):
        pass


def test_curve_is_the_clinical_angle_with_its_band_and_a_cursor(server: Any, files: Opened) -> None:
    angles = AngleBlocks(files.motion)
    curves = Curves(server, angles)
    try:
        now = float(files.motion.times[60])
        assert curves.show(60, now, 20.0)
        assert curves.chosen == ("right_knee_flexion", "left_knee_flexion", None)
        x, value, low, high, *_, none, _, _, cursor = curves._plot.data
        at = int(np.flatnonzero(np.isfinite(cursor))[0])
        assert x[at] == x[at + 1] == now
        assert np.isfinite(cursor).sum() == 2
        known = np.isfinite(value)
        np.testing.assert_allclose(value[known], np.degrees(BENT), atol=0.5)
        np.testing.assert_allclose((high - low)[known] / 2, 1.96 * 2.0, rtol=0.02)
        assert (~known).sum() == 2  # only beside the cursor
        assert not np.isfinite(none).any()
        assert cursor[at] < value[known].min() <= value[known].max() < cursor[at + 1]
    finally:
        angles.close()


def test_angles_in_parts_are_those_of_the_whole_but_for_hinges_that_have_not_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = walking(300)
    q = np.array(motion.q)
    knee = 7 + motion.skeleton.dof_names.index("RightLeg_y")
    q[150:, knee] += 0.5 * np.sin(np.arange(150) / 20)
    p, R = motion.skeleton.forward_kinematics(q)
    motion = replace(motion, q=q, poses=replace(motion.poses, p_world_joint=p, R_world_bone=R))
    whole = clinical_angles(motion)
    monkeypatch.setattr("rtof_kin.view.curves.WHOLE_S", 1.0)
    monkeypatch.setattr("rtof_kin.view.curves._PART_S", 2.0)
    monkeypatch.setattr("rtof_kin.view.curves._MARGIN_S", 0.2)
    with MotionReader(written(tmp_path, motion) / "motion.h5") as blocks:
        angles = AngleBlocks(blocks)
        assert angles.in_parts
        (first, _), _, (last, _) = (angles.at(frame, 20.0) for frame in (0, 250, 250))
        others = [name for name in angles.names if name.startswith("right_knee") and "flexion" not in name]
        assert len(others) == 2
        assert not np.isfinite([first[name] for name in others]).any()
        for found in (first, last):
            at = np.searchsorted(whole.times, found.times)
            assert len(at) < 150
            np.testing.assert_allclose(found["right_knee_flexion"], whole["right_knee_flexion"][at], atol=1e-6)
            known = np.isfinite(found.values)
            np.testing.assert_allclose(found.values[known], whole.values[at][known], atol=1e-6)
        assert not np.isfinite([last[name] for name in others]).any()  # the model's knee is a hinge
        angles.close()


def test_viewer_plays_at_its_speed_and_follows_the_slider(server: Any, files: Opened) -> None:
    with MotionViewer(server, files) as viewer:
        viewer.playback.play(0.0)
        for now in np.arange(0.0, 1.0, 1 / 60):
            viewer.scene.show(frame_at(files.motion.times, viewer.playback.at(float(now))), 5.0)
            viewer.update(float(now))
        assert viewer.frame == round((1 - 1 / 60) * RATE)
        assert 45 <= viewer.sent <= 52
        viewer.playback.play(2.0, False)
        viewer.controls._seek(3.0)
        viewer.update(3.0)
        assert viewer.frame == 50
        assert "frame 50 of 120, 3.000 s" in viewer.controls.status.content
        viewer.controls._move(1 / RATE)
        viewer.update(4.0)
        assert viewer.frame == 51


def test_first_line_of_the_panel_is_the_verdict_and_files_cannot_add_markup(server: Any, files: Opened) -> None:
    with MotionViewer(server, files):
        messages = server._websock_server._broadcast_buffer.message_from_id.values()
        texts = [m.props.content for m in messages if type(m).__name__ == "GuiHtmlMessage"]
    first = next(text for text in texts if "FAIL" in text)
    assert "planted &amp; bad" in first
    assert "glide &lt;b&gt;" in first


def test_image_of_the_video_fills_the_frustum(server: Any, files: Opened, tmp_path: Path) -> None:
    levels = [np.full((180, 320, 3), level, dtype=np.uint8) for level in range(0, 200, 2)]
    path = write_film(tmp_path / "grey.mp4", levels, range(0, 4000, 40))
    with MotionViewer(server, files, [path]) as viewer:
        viewer.controls._seek(3.0)
        layer = viewer.scene.cameras[0]
        deadline = time.monotonic() + 20
        while layer.image is None or not 145 < np.median(layer.image.image) < 155:  # 25 * 3 s * 2
            viewer.update(time.monotonic())
            assert time.monotonic() < deadline
            time.sleep(0.02)
        half = np.array([layer.image.render_width, layer.image.render_height, 0]) / 2 * layer.image.scale
        signs = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        corners = layer.image.position + (signs * half) @ so3.from_quat_wxyz(np.array(layer.image.wxyz)).T
        uv = camera().project(corners)
        np.testing.assert_allclose(uv, [(0, 0), (1280, 0), (1280, 720), (0, 720)], atol=3.0)
    square = write_film(tmp_path / "square.mp4", [np.zeros((128, 128, 3), dtype=np.uint8)], [0])
    with pytest.raises(InvalidInputError, match="of another shape"):
        MotionViewer(server, files, [square])


def test_several_cameras_have_their_own_frustum_and_view(server: Any, tmp_path: Path) -> None:
    motion = walking(20)
    with (
        motion_files(written(tmp_path / "two", motion, measured(motion, cameras=2))) as opened,
        MotionViewer(server, opened) as viewer,
    ):
        assert [layer.label.text for layer in viewer.scene.cameras] == ["camera 1", "camera 2"]
        viewer.controls.look_through(None, 1)
        viewer.scene.show(3, 5.0)
        scales = [layer.points["detected"].scale for layer in viewer.scene.cameras]
        assert scales[0] < 1 < scales[1]
        assert not viewer.scene.stage.following
        viewer.controls.look_freely(None)
        viewer.scene.show(4, 5.0)
        assert viewer.scene.cameras[1].points["detected"].scale < 1
        assert viewer.scene.stage.following
