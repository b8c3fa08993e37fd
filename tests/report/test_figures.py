"""Pictures: that they are drawn, show the numbers they name, and hold what they are given."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rtof_kin.body.metrics import flexion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.report import figures

BODY = SkeletonModel.default()
T = 20


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    truth = planted.moving(BODY, T)
    settings = ReconstructionSettings(frames=16)
    lifter = planted.PlantedLifter(truth, blind=slice(8, 12))
    return reconstruct(planted.recording(truth), lifter=lifter, settings=settings, calibrate=False)


@pytest.fixture(scope="module")
def untrue(result: Reconstruction) -> Reconstruction:
    """The same without a truth."""
    recording = replace(result.recording, truth=None)
    return replace(result, recording=recording, metrics=None, stage_metrics={})


def pixels(figure: Figure) -> NDArray[np.uint8]:
    """(height, width, 4) of a small rendering."""
    figure.set_dpi(40)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def has_color(image: NDArray[np.uint8], color: str) -> bool:
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    return bool(np.any(np.abs(image[..., :3].astype(int) - rgb).max(axis=-1) < 40))


def chunks(png: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and data of every chunk of a PNG, checksums verified."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at = 8
    while at < len(png):
        (length,) = struct.unpack(">I", png[at : at + 4])
        kind, data = png[at + 4 : at + 8], png[at + 8 : at + 8 + length]
        (checksum,) = struct.unpack(">I", png[at + 8 + length : at + 12 + length])
        assert zlib.crc32(kind + data) == checksum
        yield kind, data
        at += 12 + length


def colors(figure: Figure) -> set[str]:
    return {str(line.get_color()) for ax in figure.axes for line in ax.lines}


def texts(figure: Figure) -> str:
    """All titles, labels and legends."""
    found: list[str] = [figure.get_suptitle()]
    for ax in figure.axes:
        found += [ax.get_title(), ax.get_xlabel(), ax.get_ylabel()]
        legend = ax.get_legend()
        found += [text.get_text() for text in legend.get_texts()] if legend else []
    return "\n".join(found)


def test_every_figure_is_a_png_with_something_in_it(result: Reconstruction, tmp_path: Path) -> None:
    paths = figures.write_figures(result, tmp_path / "deep" / "figures")
    assert {path.name for path in paths} == {
        "skeletons.png", "joint_angles.png", "error_over_time.png",
    }  # fmt: skip
    for path in paths:
        found = dict(chunks(path.read_bytes()))
        width, height = struct.unpack(">II", found[b"IHDR"][:8])
        assert width > 300
        assert height > 200
        assert b"IEND" in found
        assert path.stat().st_size > 5000


def test_without_truth_there_is_no_error_to_draw(untrue: Reconstruction, tmp_path: Path) -> None:
    paths = figures.write_figures(untrue, tmp_path)
    assert {path.stem for path in paths} == {"skeletons", "joint_angles"}
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in paths}


def test_the_estimate_is_red_and_the_truth_green(result: Reconstruction, untrue: Reconstruction) -> None:
    for draw in (figures.skeletons, figures.joint_angles):
        assert colors(draw(result)) == {figures.ESTIMATE, figures.TRUTH}
        assert colors(draw(untrue)) == {figures.ESTIMATE}
    both = pixels(figures.skeletons(result))
    assert has_color(both, figures.ESTIMATE)
    assert has_color(both, figures.TRUTH)


def test_skeletons_stand_upright_before_the_camera(result: Reconstruction) -> None:
    figure = figures.skeletons(result, instants=3)
    assert len(figure.axes) == 6
    head = np.array([line.get_ydata() for line in figure.axes[0].lines]).max()
    feet = np.array([line.get_ydata() for line in figure.axes[0].lines]).min()
    assert 1.2 < head - feet < 2.0
    assert "camera" in texts(figure)
    assert "[m]" in texts(figure)


def test_one_frame_is_enough_for_a_picture(result: Reconstruction) -> None:
    single = replace(result, motion=result.motion[:1])
    assert has_color(pixels(figures.skeletons(single, instants=1)), figures.ESTIMATE)
    assert len(figures.joint_angles(single).axes) == 4


def test_a_camera_that_looks_straight_down_still_shows_the_skeleton(result: Reconstruction) -> None:
    down = Camera(
        K=result.recording.keypoints.camera.K,
        R_camera_world=np.diag([1.0, -1.0, -1.0]),
        t_camera_world=np.array([0.0, 0.0, 4.0]),
        width_px=1920,
        height_px=1080,
    )
    recording = replace(result.recording, keypoints=replace(result.recording.keypoints, camera=down))
    figure = figures.skeletons(replace(result, recording=recording), instants=1)
    assert has_color(pixels(figure), figures.ESTIMATE)


def test_the_error_figure_has_every_stage_with_its_mean(result: Reconstruction) -> None:
    figure = figures.error_over_time(result)
    shown = texts(figure)
    for stage, metrics in result.stage_metrics.items():
        assert f"{stage}: mean {metrics['mpjpe_rr_mm']:.1f} mm" in shown
        assert f"{stage}: mean {metrics['mpjpe_mm']:.1f} mm" in shown
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    for stage, metrics in result.stage_metrics.items():
        (line,) = [v for k, v in lines.items() if str(k).startswith(f"{stage}:")]
        np.testing.assert_array_equal(line.get_ydata(), metrics.over_time["mpjpe_rr_mm"])


def test_frames_that_are_not_valid_are_shaded(result: Reconstruction) -> None:
    times = result.motion.times
    (patch,) = figures.error_over_time(result).axes[0].patches
    shaded: Any = patch
    assert shaded.get_x() == pytest.approx(times[8])
    assert shaded.get_x() + shaded.get_width() == pytest.approx(times[11])


def test_the_joint_angles_are_knees_and_elbows_in_degrees(result: Reconstruction) -> None:
    figure = figures.joint_angles(result)
    shown = texts(figure)
    for name in ("knee flexion", "elbow flexion", "[deg]", "time [s]"):
        assert name in shown
    assert len(figure.axes) == 4
    expected = np.degrees(flexion(result.motion.poses.p_world_joint, BODY))
    drawn = [np.asarray(ax.lines[-1].get_ydata()) for ax in figure.axes]
    columns = [j for j in range(21) if np.isfinite(expected[:, j]).all()]
    np.testing.assert_allclose(np.array(drawn), expected[:, columns].T)
    assert result.recording.truth is not None
    error = np.abs(flexion(result.recording.truth.p_world_joint, BODY) - np.radians(expected))[:, columns[0]]
    assert f"(error {np.degrees(error).mean():.1f} deg)" in figure.axes[0].get_title()


def test_drawing_needs_no_global_state_and_no_screen() -> None:
    code = "import sys, rtof_kin.report.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
