"""The command overlay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("av")
from overlay_support import motion_with, numbered, read_film, upright_camera, write_film, write_output

from rtof_kin.body.skeleton import SkeletonModel


@pytest.fixture(scope="module")
def out(skeleton: SkeletonModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("overlay") / "out"
    return write_output(folder, motion_with(skeleton, 12, sigma=0.02), [upright_camera(320, 240)])


@pytest.fixture(scope="module")
def video(out: Path) -> Path:
    times = [17 * i for i in range(12)]
    return write_film(out.parent / "v.mp4", [numbered(320, 240, i) for i in range(12)], times)


def test_a_film_is_written_and_described(cli: Callable[..., Any], out: Path, video: Path, tmp_path: Path) -> None:
    path = tmp_path / "o.mp4"
    done = cli.ok("overlay", out, video, "-o", path, "--bands", "--points", "--blur-face")
    done.says("12 pictures of 320 x 240 px", "no sound, no metadata", "only the tracked person's face")
    assert len(read_film(path)[0]) == 12
    assert "is there already" in cli.refused("overlay", out, video, "-o", path).err
    assert cli("overlay", out, "--no-video", "-o", path, "--overwrite", "--angles", "none").code == 0


def test_video_or_no_video_must_be_said(cli: Callable[..., Any], out: Path, video: Path, tmp_path: Path) -> None:
    neither = cli("overlay", out, "-o", tmp_path / "o.mp4")
    assert (neither.code, "--no-video" in neither.err) == (2, True)
    both = cli("overlay", out, video, "--no-video", "-o", tmp_path / "o.mp4")
    assert (both.code, "--no-video" in both.err) == (2, True)


def test_unknown_angles_and_films_are_named(cli: Callable[..., Any], out: Path, tmp_path: Path) -> None:
    assert (
        "right_knee_flexion"
        in cli.refused("overlay", out, "--no-video", "-o", tmp_path / "o.mp4", "--angles", "right_nee_flexion").err
    )
    assert "no such video" in cli.refused("overlay", out, tmp_path / "none.mp4", "-o", tmp_path / "o.mp4").err
    assert "interval" in cli("overlay", out, "--no-video", "-o", tmp_path / "o.mp4", "--start", "3", "--stop", "1").err
    assert not list(tmp_path.iterdir())
