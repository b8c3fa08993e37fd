"""Figures of a reconstruction: files, colours, labels and plotted values."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from rtof_kin.body.metrics import flexion
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.camera import Camera
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.reporting import figures

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
    """The same without a reference."""
    recording = replace(result.recording, truth=None)
    return replace(result, recording=recording, metrics=None, stage_metrics={})


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


def test_figures_are_written_as_png(result: Reconstruction, untrue: Reconstruction, tmp_path: Path) -> None:
    figures.write_figures(result, tmp_path / "deep" / "figures")
    paths = [*(tmp_path / "deep" / "figures").glob("*.png")]
    assert {path.stem for path in paths} == {"skeletons", "joint_angles", "error_over_time"}
    for path in paths:
        image = imread(path)
        assert min(image.shape[:2]) > 200
        assert image.std() > 0.02
    figures.write_figures(untrue, tmp_path / "untrue")
    assert {path.stem for path in (tmp_path / "untrue").glob("*.png")} == {"skeletons", "joint_angles"}


def test_estimate_and_reference_have_their_colors(result: Reconstruction, untrue: Reconstruction) -> None:
    for plot in (figures.skeletons, figures.joint_angles):
        assert colors(plot(result)) == {figures.ESTIMATE, figures.TRUTH}
        assert colors(plot(untrue)) == {figures.ESTIMATE}


def test_skeletons_are_upright_in_the_view_of_the_camera(result: Reconstruction) -> None:
    figure = figures.skeletons(result, instants=3)
    assert len(figure.axes) == 6
    y = np.concatenate([np.asarray(line.get_ydata()) for line in figure.axes[0].lines])
    assert 1.2 < y.max() - y.min() < 2.0
    assert "camera" in texts(figure)
    assert "[m]" in texts(figure)


def test_single_frames_and_cameras_that_look_down_are_plotted(result: Reconstruction) -> None:
    single = replace(result, motion=result.motion[:1])
    assert figures.ESTIMATE in colors(figures.skeletons(single, instants=1))
    assert len(figures.joint_angles(single).axes) == 4
    keypoints = result.recording.keypoints
    assert keypoints is not None
    R, t = np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 4.0])
    down = Camera(keypoints.camera.K, R, t, width_px=1920, height_px=1080)
    figure = figures.skeletons(replace(result, keypoints=replace(keypoints, camera=down)), instants=1)
    assert all(np.isfinite(line.get_ydata()).all() for ax in figure.axes for line in ax.lines)


def test_error_figure_has_each_stage_with_its_mean(result: Reconstruction) -> None:
    figure = figures.error_over_time(result)
    shown = texts(figure)
    for stage, metrics in result.stage_metrics.items():
        for ax, key in zip(figure.axes, ("mpjpe_rr_mm", "mpjpe_mm"), strict=True):
            assert f"{stage}: mean {metrics[key]:.1f} mm" in shown
            (line,) = [own for own in ax.lines if str(own.get_label()).startswith(f"{stage}:")]
            np.testing.assert_array_equal(line.get_ydata(), metrics.over_time[key])


def test_invalid_frames_are_shaded(result: Reconstruction) -> None:
    times = result.motion.times
    (patch,) = figures.error_over_time(result).axes[0].patches
    shaded: Any = patch
    assert shaded.get_x() == pytest.approx(times[8])
    assert shaded.get_x() + shaded.get_width() == pytest.approx(times[11])


def test_joint_angles_are_knee_and_elbow_flexion_in_degrees(result: Reconstruction) -> None:
    figure = figures.joint_angles(result)
    shown = texts(figure)
    for name in ("knee flexion", "elbow flexion", "[deg]", "time [s]"):
        assert name in shown
    expected = np.degrees(flexion(result.motion.poses.p_world_joint, BODY))
    columns = [j for j in range(21) if np.isfinite(expected[:, j]).all()]
    plotted = np.array([np.asarray(ax.lines[-1].get_ydata()) for ax in figure.axes])
    np.testing.assert_allclose(plotted, expected[:, columns].T)
    assert result.recording.truth is not None
    true = np.degrees(flexion(result.recording.truth.p_world_joint, BODY))
    error = np.abs(true - expected)[:, columns[0]].mean()
    assert f"(error {error:.1f} deg)" in figure.axes[0].get_title()


def test_plotting_does_not_import_pyplot() -> None:
    code = "import sys, rtof_kin.reporting.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
