"""A video of a walk as coloured dots, and the folder of the model that detects them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detector_support import points_px, walking, watching
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 480


@pytest.fixture(scope="session")
def film(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.float64]]:
    """A lossless video at 25 Hz of a walk as 17 coloured dots, and where they are."""
    # OpenCV's wheel needs a system library that machines without a screen may lack.
    cv2: Any = pytest.importorskip("cv2", exc_type=ImportError)
    dots: Any = pytest.importorskip("dot_detector", exc_type=ImportError)
    motion = walking()
    uv = points_px("coco17", motion, watching(motion))[:10]
    uv = (uv - uv.mean(axis=(0, 1))) * 0.75 + [320.0, 240.0]
    images = [np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in uv]
    for image, frame in zip(images, uv, strict=True):
        for (u, v), colour in zip(frame, dots.colours(17), strict=True):
            centre = (round(16 * u), round(16 * v))
            cv2.circle(image, centre, 16 * 4, (255 * colour).tolist(), -1, cv2.LINE_AA, 4)
    return dots.write_video(tmp_path_factory.mktemp("film") / "walk.mkv", images, codec="ffv1"), uv


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a pose model of 17 points."""
    dots: Any = pytest.importorskip("dot_detector", exc_type=ImportError)
    folder = tmp_path / "models"
    folder.mkdir()
    dots.pose_model(folder / "pose.onnx", 17)
    return folder
