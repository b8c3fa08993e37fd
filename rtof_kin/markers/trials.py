"""Marker trials of one person as motions: read, fit, solve, write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.formats.markers import MarkerSequence, read_c3d, read_trc
from rtof_kin.markers.fit import MISFIT, MarkerBody, fit_body, marker_residuals, track
from rtof_kin.markers.marker_sets import places_of
from rtof_kin.markers.settings import TRIALS, MarkerSettings


def read_trial(path: str | Path, up: str | None = None) -> MarkerSequence:
    """Read a trial into a world with z up, m. `FileFormatError`: missing, damaged, or another kind of file.

    Args:
        path: ``.c3d``, ``.trc``, or ``.npz`` with times (T,) s, names (M,) and p_world (T, M, 3) m, z up, NaN missing.
        up: axis of a C3D or TRC file that points up; default: the one that a C3D declares, y of a TRC.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".c3d":
        return read_c3d(path, up=up)
    if suffix == ".trc":
        return read_trc(path, up=up or "y")
    if suffix != ".npz":
        raise FileFormatError(path, f"no marker trial; known: {', '.join(TRIALS)}")
    arrays = read_npz_as_saved(path, 2**31, kinds="fiubU")
    with reading(path, "no marker trial: needs times, names and p_world ({})", KeyError, ValueError):
        names = tuple(map(str, arrays["names"]))
        return MarkerSequence(arrays["times"].astype(float), names, arrays["p_world"].astype(float))


@dataclass(frozen=True)
class MarkerResult:
    """The motion of one trial, on the body of all trials of its person."""

    name: str  #: Of the file
    trial: MarkerSequence
    body: MarkerBody
    motion: Motion

    @cached_property
    def residuals(self) -> Array:
        """Distances (T, K) of the trial's markers from those of the body, m; NaN where missing."""
        return marker_residuals(self.trial, self.body, self.motion)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, m."""
        return float(np.sqrt(np.nanmean(self.residuals**2)))

    @property
    def unseen(self) -> float:
        """Share of the frames in which too few markers are seen."""
        return 1 - float(np.mean(self.motion.poses.valid.any(axis=1)))

    @property
    def headline(self) -> str:
        """What a reader sees first: how well the markers fit, and what is doubtful."""
        body, seconds = self.body, float(self.trial.times[-1] - self.trial.times[0])
        text = (
            f"{len(body.places.names)} markers ({body.places.set_name}) on a body of {body.skeleton.height:.2f} m, "
            f"{seconds:.1f} s: residual {1000 * self.rms:.1f} mm"
        )
        if self.rms > MISFIT:
            text = f"DOES NOT FIT (is the rate of the file right, and are all trials of one person?): {text}"
        if self.unseen:
            text += f"; in {100 * self.unseen:.0f} % of the frames too few markers are seen"
        for name, rms in self.body.left_out.items():
            text += (
                f"; LEFT OUT {name}, which lies {1000 * rms:.0f} mm from where the others say: exchanged or fallen off?"
            )
        if body.doubtful:
            named = ", ".join(f"{name} {1000 * rms:.0f} mm" for name, rms in body.doubtful.items())
            text += f"; DOUBTFUL {named}"
        return text + "."


def motion_of_markers(
    path: str | Path,
    settings: MarkerSettings | None = None,
    skeleton: SkeletonModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MarkerResult:
    """Return the motion of a marker trial on the person's skeleton. Errors of `read_trial`, `places_of` and `fit_body`.

    Args:
        path: see `read_trial`. skeleton: proportions to start from. progress: see `fit_body`.
    """
    how = settings or MarkerSettings()
    trials = [read_trial(file, how.up) for file in (path, *how.trials)]
    names = list(dict.fromkeys(name for trial in trials for name in trial.names))
    body = fit_body(
        trials, skeleton, places_of(names, how.marker_table, how.marker_set, how.marker_person), progress=progress
    )
    return MarkerResult(Path(path).stem, trials[0], body, track(trials[0], body))


def marker_facts(result: MarkerResult) -> dict[str, Any]:
    """Return places and residuals of the markers and the bones as plain values, for ``markers.json``."""
    body = result.body
    rows = {
        name: {
            "segment": segment,
            "place_mm": (1000 * place).round(1).tolist(),
            "rms_mm": round(1000 * float(np.sqrt(np.nanmean(own**2))), 2) if np.isfinite(own).any() else None,
        }
        for name, segment, place, own in zip(
            body.places.names, body.places.segments, body.places.p_bone_marker, result.residuals.T, strict=True
        )
    }
    directions = so3.unit(body.skeleton.joint_offsets[1:])
    bones = zip(body.skeleton.bone_lengths.items(), directions, body.sigma_offsets[1:], strict=True)
    return {
        "headline": result.headline,
        "marker_set": body.places.set_name,
        "height_m": round(body.skeleton.height, 4),
        "bones_m": {
            name: {"length": round(length, 4), "sigma": round(float(np.linalg.norm(along * sigma)), 4)}
            for (name, length), along, sigma in bones
        },
        "markers": rows,
        "left_out_m": body.left_out,
    }
