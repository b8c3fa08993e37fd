"""Several cameras in a recording and its folder."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording

POSES = planted.moving(SkeletonModel.default(), 12).poses
SIDE = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], 900.0, 1280, 720)


def view(start: float = 0.01, rate_hz: float = 25.0) -> KeypointSequence:
    """A second camera with a rate, a start and points of its own."""
    uv = np.random.default_rng(0).uniform(100, 600, (5, 3, 2))
    uv[1, 2] = np.nan
    times = start + np.arange(5) / rate_hz
    return KeypointSequence(SIDE, times, uv, np.isfinite(uv[..., 0]) * 0.8, ("Hips", "Nose", "LeftHand"))


def recording(*views: KeypointSequence) -> Recording:
    return Recording("two", planted.keypoints(POSES), views=views)


def test_views_are_read_back_exactly(tmp_path: Path) -> None:
    before = recording(view(), replace(view(0.02), camera=planted.camera()))
    before.save(tmp_path / "two")
    after = Recording.load(tmp_path / "two")
    assert len(after.views) == 2
    for a, b in zip(before.views, after.views, strict=True):
        assert a.names == b.names
        for name in ("times", "uv_px", "confidence"):
            np.testing.assert_array_equal(getattr(b, name), getattr(a, name))
        for name in ("K", "R_camera_world", "t_camera_world", "distortion", "width_px"):
            np.testing.assert_array_equal(getattr(b.camera, name), getattr(a.camera, name))


def written(folder: Path, text: str) -> Path:
    """The folder of a recording of one camera with more in its index."""
    recording().save(folder)
    np.savez(folder / "side.npz", uv_px=view().uv_px)
    index = folder / INDEX
    index.write_text(index.read_text() + textwrap.dedent(text))
    return folder


BY_HAND = """
    [[views]]
    [views.camera]
    width_px = 1280
    height_px = 720
    focal_px = 900.0
    position_m = [0.5, -4.0, 1.2]
    target_m = [0.0, 0.0, 1.0]
    assumed = ["focal length"]
    [views.keypoints]
    file = "side.npz"
    rate_hz = 25.0
    landmarks = ["Hips", "Nose", ""]
"""


def test_a_view_written_by_hand_is_read(tmp_path: Path) -> None:
    (side,) = Recording.load(written(tmp_path / "a", BY_HAND)).views
    assert side.names == ("Hips", "Nose")
    assert side.camera.assumed == ("focal length",)
    np.testing.assert_allclose(side.camera.center_world, [0.5, -4.0, 1.2])


@pytest.mark.parametrize(
    ("old", "new", "error", "words"),
    [
        ("[[views]]", "[views]", FileFormatError, r"\[\[views\]\]"),
        ('"Nose"', '"Nos"', UnknownNameError, r"views.1.keypoints.*Nos"),
        ("focal_px", "focal", RtofError, r"views.1.camera.*focal_px"),
        ("[views.keypoints]", "[views.points]", RtofError, r"views.1"),
        ('file = "side.npz"', 'file = "../side.npz"', FileFormatError, "folder"),
    ],
)
def test_errors_name_the_view(tmp_path: Path, old: str, new: str, error: type[RtofError], words: str) -> None:
    assert old in BY_HAND
    with pytest.raises(error, match=f"(?s){words}"):
        Recording.load(written(tmp_path / "a", BY_HAND.replace(old, new)))


def test_views_must_fit_the_recording() -> None:
    with pytest.raises(InvalidInputError, match="view 1 times"):
        recording(view(start=100.0))
    with pytest.raises(UnknownNameError, match="Elbow"):
        recording(replace(view(), names=("Hips", "Nose", "Elbow")))
    imus = planted.recording(planted.moving(SkeletonModel.default(), 12))
    with pytest.raises(InvalidInputError, match="first one as keypoints"):
        replace(imus, keypoints=None, views=(view(0.0),))
