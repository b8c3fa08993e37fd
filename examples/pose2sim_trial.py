"""Trial of a Pose2Sim session: cameras, detections, and matching of the people across cameras."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from multi_view import triangulate
from numpy.typing import NDArray

from rtof_kin.core.errors import FileFormatError, RtofError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.formats.camera_toml import read_camera_toml
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.keypoints import DetectedKeypoints, keypoints_from_detections

Array = NDArray[np.float64]
LEAST_CONFIDENCE = 0.2
SAME_PERSON_PX = 60.0
"""Largest median reprojection error of one person's points."""
FEWEST_POINTS = 8
MOST_PEOPLE = 4
"""Candidates per camera and frame: those with the most points."""


@dataclass(frozen=True)
class View:
    """Detections of the person in one camera."""

    name: str
    camera: Camera
    """Of the calibration file."""
    found: DetectedKeypoints
    """Landmarks of the skeleton, with their source."""
    uv_px: Array
    """(T, K, 2) the detector's own points of the person; NaN where unobserved."""
    weight: Array
    """(T, K) their confidence; 0 where unobserved."""


@dataclass(frozen=True)
class Trial:
    """Recording of one person by calibrated cameras."""

    name: str
    views: tuple[View, ...]
    height: float
    """Standing height, m, from the configuration or the caller."""
    person: str
    """Description of the tracked person."""
    videos: tuple[Path | None, ...]
    """Video of each view, or None."""


def find_trial(root: Path, name: str) -> Path:
    """Return the folder below (or equal to) `root` with detections in it and `name` in its path.

    Raises:
        RtofError: there is none, or more than one.
    """
    folders = sorted({f.parents[1] for f in root.glob("**/pose/*_json") if f.is_dir()})
    trials = [f for f in folders if name in str(f.relative_to(root.parent))]
    exact = [f for f in trials if f.name == name]
    if len(exact or trials) != 1:
        known = ", ".join(f.name for f in folders) or "none: no folder pose/*_json"
        problem = "several trials" if trials else "no trial"
        raise RtofError(f"{root}: {problem} called {name!r}; there are {known}")
    return (exact or trials)[0]


def read_trial(
    root: Path, name: str, height: float | Sequence[float] | None = None, participant: int | None = None
) -> Trial:
    """Read one person of a trial from all cameras.

    People are matched across the cameras by triangulation; where the configuration has several heights,
    they are assigned in the order of size.

    Args:
        root: folder of the session. name: of the trial, see `find_trial`.
        height: standing height, or those of all people, m; default: of the configuration.
        participant: number in the list of heights, from 1; default: the tallest.

    Raises:
        RtofError: files are missing or do not belong together; the message says which.
    """
    folder = find_trial(root, name)
    cameras = read_camera_toml(_calibration(folder, root))
    poses = sorted(p for p in (folder / "pose").glob("*_json") if p.is_dir())
    if len(poses) != len(cameras) or len(poses) < 2:
        raise FileFormatError(
            folder / "pose",
            f"{len(poses)} folders of detections for {len(cameras)} cameras; each "
            "camera needs one, and two are the least",
        )
    seen = [
        read_detector_file(path, camera.width_px, camera.height_px).in_pixels(camera.width_px, camera.height_px)
        for path, camera in zip(poses, cameras.values(), strict=True)
    ]
    frames = min(map(len, seen))
    rate_hz = float(_setting(folder, root, "frame_rate", 60.0))
    heights = _heights(folder, root) if height is None else np.atleast_1d(height).tolist()
    groups, frame = _people(list(cameras.values()), seen, frames, len(heights))
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    if participant is None:
        participant = order[-1] + 1
    if not 1 <= participant <= len(heights):
        known = [str(i + 1) for i in range(len(heights))]
        raise UnknownNameError("participant", [str(participant)], known)
    rank = order.index(participant - 1)
    if rank >= len(groups):
        raise RtofError(
            f"{folder}: in frame {frame}, {len(groups)} people were found in all cameras, of "
            f"{len(heights)} in the configuration; give another participant"
        )
    people = groups[rank]
    times = np.arange(frames) / rate_hz
    views = [
        _view(n, camera, found, times, who, frame)
        for (n, camera), found, who in zip(cameras.items(), seen, people, strict=True)
    ]
    person = f"participant {participant} of {len(heights)} ({heights[participant - 1]:.2f} m): number " + (
        ", ".join(f"{who} in {n}" for n, who in zip(cameras, people, strict=True))
    )
    return Trial(
        folder.name,
        tuple(views),
        heights[participant - 1],
        f"{person}, in frame {frame}",
        tuple(_video(folder, pose) for pose in poses),
    )


def _view(name: str, camera: Camera, seen: Detections, times: Array, person: int, frame: int) -> View:
    part = Detections(seen.uv_px[: len(times)], seen.confidence[: len(times)])
    found = keypoints_from_detections(part, times, camera, person=person, frame=frame)
    uv, confidence = found.track.of(part)
    return View(name, camera, found, uv, np.where(confidence < LEAST_CONFIDENCE, 0.0, confidence))


def _people(
    cameras: Sequence[Camera], seen: Sequence[Detections], frames: int, count: int
) -> tuple[list[tuple[int, ...]], int]:
    """Return the number in each camera of up to `count` people, the smallest first, and the frame nearest
    to the middle in which that many were found."""
    best: tuple[list[tuple[int, ...]], int] = ([], frames // 2)
    for frame in sorted(range(0, frames, 5), key=lambda f: abs(f - frames // 2)):
        groups = _matched(cameras, seen, frame)[:count]
        if len(groups) > len(best[0]):
            best = [people for _, people in sorted(groups)], frame
        if len(groups) == count:
            break
    if not best[0]:
        raise RtofError(
            "nobody was seen by all cameras at once: their points do not meet in space; check that "
            "calibration and detections are of the same recording and in the same order"
        )
    return best


def _matched(cameras: Sequence[Camera], seen: Sequence[Detections], frame: int) -> list[tuple[float, tuple[int, ...]]]:
    """Return (size, number in each camera) of the people of a frame, best fit first."""
    fits = []
    for people in itertools.product(*(_prominent(d, frame) for d in seen)):
        uv = np.stack([d.uv_px[frame, who] for d, who in zip(seen, people, strict=True)])
        weight = np.stack([d.confidence[frame, who] for d, who in zip(seen, people, strict=True)])
        weight = np.where(weight < LEAST_CONFIDENCE, 0.0, weight)
        weight[:, (weight > 0).sum(axis=0) < min(3, len(cameras))] = 0.0
        p, error = triangulate(cameras, uv, weight)
        known = np.isfinite(p).all(axis=-1)
        if known.sum() < FEWEST_POINTS:
            continue
        distance = np.linalg.norm(error, axis=-1)
        each = [np.median(d[np.isfinite(d)]) for d in distance if np.isfinite(d).any()]
        misfit = float(np.max(each))  # robust triangulation concentrates a mismatch in one camera
        size = float(np.median(np.linalg.norm(p[known] - np.median(p[known], axis=0), axis=-1)))
        fits.append((misfit, size, people))
    groups: list[tuple[float, tuple[int, ...]]] = []
    for misfit, size, people in sorted(fits):
        taken = any(a == b for _, other in groups for a, b in zip(people, other, strict=True))
        if misfit < SAME_PERSON_PX and not taken:
            groups.append((size, people))
    return groups


def _prominent(seen: Detections, frame: int) -> list[int]:
    sure = (seen.confidence[frame] >= LEAST_CONFIDENCE).sum(axis=-1)
    most = np.argsort(-sure, kind="stable")[:MOST_PEOPLE]
    return [int(p) for p in most if sure[p] >= FEWEST_POINTS]


# --- files ---------------------------------------------------------------------------------------


def _upwards(folder: Path, root: Path) -> Iterator[Path]:
    """Yield the folder of the trial and its parents, up to that of the session."""
    for place in (folder, *folder.parents):
        yield place
        if place == root:
            return


def _calibration(folder: Path, root: Path) -> Path:
    for place in _upwards(folder, root):
        for inner in sorted(place.iterdir()):
            if inner.is_dir() and "calib" in inner.name.lower():
                files = sorted(inner.glob("*.toml"))
                if len(files) == 1:
                    return files[0]
                if files:
                    raise FileFormatError(inner, f"{len(files)} files .toml; keep the one that holds")
    raise FileFormatError(root, "no folder *calib* with a .toml in it; give the session's folder")


def _setting(folder: Path, root: Path, field: str, default: Any = None) -> Any:
    """Return a field of the nearest Config.toml that has it."""
    for place in _upwards(folder, root):
        path = place / "Config.toml"
        if not path.is_file():
            continue
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise FileFormatError(path, f"not readable as TOML: {error}") from error
        for name in ("project", "markerAugmentation"):
            table = tables.get(name, {})
            if isinstance(table, dict) and field in table:
                return table[field]
    return default


def _heights(folder: Path, root: Path) -> list[float]:
    given = _setting(folder, root, "participant_height")
    heights = given if isinstance(given, list) else [given]
    if not heights or not all(isinstance(h, float | int) and 0.4 < h < 2.6 for h in heights):
        raise FileFormatError(
            folder / "Config.toml",
            f"participant_height is {given!r}, here and in the folders above; give the height in metres by --height",
        )
    return [float(h) for h in heights]


def _video(folder: Path, pose: Path) -> Path | None:
    name = pose.name.removesuffix("_json")
    return next(iter(sorted((folder / "videos").glob(f"{name}.*"))), None)
