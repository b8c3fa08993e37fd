"""3D points that another model sees in a video: their files, and the conventions of their names.

A convention (``models/lift_joints.toml``, and the layouts of ``models/detectors.toml``) says where in the body each
joint of a model lies. It is recognised by the names of the points, or by their number where an array has no names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, UnknownNameError, reading
from rtof_kin.core.files.arrays import read_csv, read_npz_as_saved
from rtof_kin.core.files.text import load_json, load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.formats.markers import MarkerSequence, read_c3d, read_trc
from rtof_kin.vision.layouts import (
    FEWEST_NAMED,
    MIRROR,
    OWN_LAYOUTS,
    DetectorTable,
    Layout,
    detector_table,
    mirrored,
    own,
)

P_MODEL: Final = "p_model"  #: Array (T, P, K, 3) of points in space in the files of the package's own detection
_ARRAYS: Final = ("p_world", "joints", "keypoints_3d", "pred_keypoints_3d", "joints_3d", "posed_joints", P_MODEL)
_TIMES: Final = ("times", "timestamps", "time")
_NAMES: Final = ("names", "joint_names")
_CENTRED: Final = 0.02  #: Distance of the hips' middle from the origin, relative to the body


@dataclass(frozen=True)
class LiftPoints:
    """3D points of another model in the video of a recording, on any axes and scale."""

    name: str  #: Of the file
    points: MarkerSequence  #: At times of the video's own clock
    convention: str = ""  #: Of the names; '' where they say it

    def __post_init__(self) -> None:
        if self.convention:
            convention(self.convention)
        p = np.array(self.points.p_world)
        p[np.ptp(p, axis=1).max(axis=1) == 0] = np.nan  # nobody: all points at one place
        object.__setattr__(self, "points", replace(self.points, p_world=p))


@dataclass(frozen=True, eq=False)
class Convention:
    """The K joints of a kind of model that have a place in the body."""

    layout: Layout  #: Their names
    counts: tuple[int, ...]  #: Numbers of points of arrays without names
    at: tuple[int, ...]  #: (K,) numbers of the joints in such an array
    segments: tuple[str, ...]  #: (K,) segment of each by its joint
    places: Array  #: (K, 3) m in its link frame, on the skeleton of 1.72 m
    sigma: Array  #: (K,) [m] standard deviation of the place per axis
    error: Array  #: (2,) [m] across and along the ray, which see `usual_errors`


def conventions() -> Mapping[str, Convention]:
    """Return all known conventions by name; errors as `detector_table`."""
    return _conventions(detector_table())


@lru_cache(maxsize=4)
def _conventions(table: DetectorTable) -> Mapping[str, Convention]:
    data = load_toml(model_path("lift_joints.toml"))
    usual = data["sd_point_mm"] / 1000
    known = {point.name: (point.joint, point.offset, usual) for point in table.points}
    known |= {own(name): (joint, place, usual) for name, (joint, place) in SkeletonModel.default().landmarks.items()}
    begins = {int(count): name for count, name in data["begins"].items()}
    found = {}
    for one in data["convention"]:
        rows = [row for joint in one["joints"] for row in _rows(joint, known)]
        names, at, places = zip(*rows, strict=True)
        form = Layout.of(one["name"], one["title"], names)
        found[form.name] = _convention(form, tuple(one["counts"]), at, places, data)
    for form in table.layouts.values():
        if form.name != OWN_LAYOUTS[1]:
            counts = (len(form), *(count for count, name in begins.items() if name == form.name))
            found[form.name] = _convention(form, counts, range(len(form)), [known[p] for p in form.points], data)
    return found


def _convention(
    form: Layout, counts: tuple[int, ...], at: Sequence[int], places: Sequence[Any], data: Mapping[str, Any]
) -> Convention:
    segments, offsets, sigma = zip(*places, strict=True)
    error = np.array(data["error_mm"].get(form.name, [0, 0])) / 1000
    return Convention(form, counts, tuple(at), segments, np.array(offsets), np.array(sigma), error)


def _rows(joint: Mapping[str, Any], known: Mapping[str, Any]) -> Iterator[tuple[str, int, tuple[str, Array, float]]]:
    """Yield name, number in an array and place of a joint of the table, of both sides where there are two."""
    sides = ("Left", "Right") if len(joint["at"]) > 1 else ("",)
    for at, side in zip(joint["at"], sides, strict=True):
        if "point" in joint:
            place = known[side + joint["point"]]
        else:
            segment, offset = joint["segment"], np.array(joint["place_mm"]) / 1000
            right = side == "Right"
            place = mirrored(segment) if right else segment, offset * (MIRROR if right else 1.0), joint["sd_mm"] / 1000
        yield joint["name"].replace("{s}", side.lower()), at, place


def convention(name: str) -> Convention:
    """Return a convention; `UnknownNameError`, which lists those known, where there is none."""
    if name not in (known := conventions()):
        raise UnknownNameError("convention of 3D joints", [name], [*known])
    return known[name]


def recognised(names: Sequence[str]) -> Convention | None:
    """Return the convention of which most joints are named, of equal ones the smallest; None where none has
    `FEWEST_NAMED` of them.
    """

    def count(one: Convention) -> int:
        return sum(i is not None for i in one.layout.found(names))

    best = max(conventions().values(), key=lambda one: (count(one), -len(one.layout)))
    return best if count(best) >= FEWEST_NAMED else None


def usual_errors(form: Convention, points: MarkerSequence) -> Array:
    """Return the least errors (2,), m, across and along the camera's ray that are known of a convention's joints about
    the hips, as models of one image give them; 0 where nothing is known, or the points move in space.
    """
    found = dict(zip(form.layout.points, form.layout.found(points.names), strict=True))
    hips = [i for name in ("LeftHip", "RightHip") if (i := found.get(name)) is not None]
    if not form.error.any() or len(hips) < 2:
        return np.zeros(2)
    size = np.ptp(points.p_world, axis=1).max(axis=-1)
    centre = np.linalg.norm(points.p_world[:, hips].mean(axis=1), axis=-1)
    return form.error if np.nanmedian(centre / size) < _CENTRED else np.zeros(2)


def split_convention(path: str | Path) -> tuple[Path, str]:
    """Return the file and the convention of ``FILE:CONVENTION``; '' where none is named."""
    file, colon, name = str(path).rpartition(":")
    return (Path(file), name) if colon and name in conventions() else (Path(path), "")


def read_lift_points(path: str | Path, wanted: str = "", frame_times: Array | None = None) -> LiftPoints:
    """Read the 3D points of another model, on any axes and scale. `FileFormatError`: missing, damaged or of another
    kind; no convention, or no times. `UnknownNameError`: no such convention.

    Args:
        path: ``.trc``, ``.c3d``; ``.npz`` with p_world, joints, keypoints_3d or pred_keypoints_3d (T, K, 3), names (K,)
            and times (T,) s, both of which may be missing; ``.json`` with times, names and points (T, K, 3; null
            where missing); ``.csv`` with the columns time and NAME_x, NAME_y, NAME_z.
        wanted: convention of the joints, where their names or number do not say it.
        frame_times: (T,) s of the video's frames, for an array without times.
    """
    path = Path(path)
    read: dict[str, Callable[[], MarkerSequence]] = {
        ".trc": lambda: read_trc(path, up="z"),
        ".c3d": lambda: read_c3d(path, up="z"),
        ".npz": lambda: _read_npz(path, wanted, frame_times),
        ".json": lambda: _read_json(path),
        ".csv": lambda: _read_csv(path),
    }
    if path.suffix.lower() == ".mot":
        raise FileFormatError(path, "angles of a model that is not here; give the .trc of points beside it")
    if path.suffix.lower() not in read:
        raise FileFormatError(path, f"no 3D points; known: {', '.join(read)}")
    return LiftPoints(path.name, read[path.suffix.lower()](), wanted)


def _read_json(path: Path) -> MarkerSequence:
    found = load_json(path)
    with reading(path, "no 3D points over time: needs times, names and points ({})", KeyError, TypeError, ValueError):
        values = [[[np.nan] * 3 if p is None else p for p in frame] for frame in found["points"]]
        return MarkerSequence(np.array(found["times"], float), tuple(found["names"]), np.array(values, float))


def _read_csv(path: Path) -> MarkerSequence:
    columns = read_csv(path)
    with reading(path, "no 3D points over time: needs time, and x, y and z of each point ({})", KeyError, ValueError):
        names = [column[:-2] for column in columns if column.endswith("_x")]
        points = [np.stack([columns[f"{name}_{axis}"] for axis in "xyz"], axis=-1) for name in names]
        return MarkerSequence(columns["time"], tuple(names), np.stack(points, axis=1))


def _read_npz(path: Path, wanted: str, frame_times: Array | None) -> MarkerSequence:
    arrays = read_npz_as_saved(path, 2**31, kinds="fiubU")
    points, times, names = (
        next((arrays[name] for name in known if name in arrays), None) for known in (_ARRAYS, _TIMES, _NAMES)
    )
    if points is None:
        raise FileFormatError(
            path, f"no array {', '.join(_ARRAYS[:4])} of shape (T, K, 3); there is {', '.join(arrays)}"
        )
    if points.ndim == 4 and points.shape[1] == 1:
        points = points[:, 0]
    if points.ndim != 3 or points.shape[2] != 3:
        raise FileFormatError(path, f"points of shape {points.shape}; give those of one person, (T, K, 3)")
    if times is None:
        times = frame_times
        if times is None or len(times) != len(points):
            frames = "" if times is None else f", and {len(points)} frames where the video has {len(times)}"
            raise FileFormatError(path, f"has no times{frames}; give times (T,), s since the video's first frame")
    p, labels = points.astype(float), () if names is None else tuple(map(str, names))
    if names is None:
        form = _counted(path, p.shape[1], wanted)
        inside = [k for k, at in enumerate(form.at) if at < p.shape[1]]
        labels, p = tuple(form.layout.names[k] for k in inside), p[:, [form.at[k] for k in inside]]
    with reading(path):
        return MarkerSequence(np.asarray(times, float), labels, p)


def _counted(path: Path, count: int, wanted: str) -> Convention:
    """Return the convention of an array of so many points without names."""
    if wanted:
        return convention(wanted)
    known = conventions()
    fitting = [one.layout for one in known.values() if count in one.counts]
    if len(fitting) == 1:
        return known[fitting[0].name]
    if fitting:
        which = " or ".join(f"{one.name} ({one.title})" for one in fitting)
        how = f"{path.name}:{fitting[0].name} after --lift, or in the files of [lift]"
        raise FileFormatError(path, f"{count} points without names may be {which}: say which, as {how}")
    numbers = ", ".join(f"{one.layout.name} {'/'.join(map(str, one.counts))}" for one in known.values())
    raise FileFormatError(path, f"{count} points without names are of no known convention ({numbers}); add names (K,)")
