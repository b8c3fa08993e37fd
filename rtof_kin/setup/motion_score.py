"""Learned scores of which segments sensors are on, ``models/assignment.npz``, in NumPy.

A network of one hidden layer scores each sensor on each segment, another each pair of sensors on each pair of
segments; ``models/build_assignment.py`` trains them. The sum of the scores of an assignment is its
log-probability up to a constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.files.arrays import read_npz_as_saved
from rtof_kin.core.resources import model_path
from rtof_kin.setup.motion_features import pair_features, single_features
from rtof_kin.setup.sensor_motion import SensorMotions

_LARGEST = 4.0  # [standard deviations] to which features are cut


@dataclass(frozen=True, eq=False)
class MotionScore:
    """Scores of sensors on segments by their motion."""

    segments: tuple[str, ...]
    """K segments that the scores know."""
    weights: Mapping[str, Array]
    """Layers and scales of features by name."""

    @classmethod
    def load(cls, path: str | Path | None = None) -> MotionScore:
        """Read a file of ``models/build_assignment.py``.

        Args:
            path: default: the shipped one.

        Raises:
            FileFormatError: not such a file.
        """
        arrays = read_npz_as_saved(model_path("assignment.npz") if path is None else Path(path), kinds="fiubU")
        segments = tuple(str(name) for name in arrays.pop("segments"))
        return cls(segments, {name: values.astype(np.float64) for name, values in arrays.items()})

    def tables(self, motions: SensorMotions, segments: Sequence[str]) -> tuple[Array, Array]:
        """Return scores, nats, of sensors (S, K) and of ordered pairs (S, S, K, K), 0 of one with itself.

        Raises:
            UnknownNameError: a segment is not known.
        """
        keep = indices_of("segment", segments, self.segments)
        f = self._scaled("single", single_features(motions))
        g = self._scaled("pair", pair_features(motions))
        S, K = len(f), len(self.segments)
        both = [np.broadcast_to(f[:, None], (S, *f.shape)), np.broadcast_to(f, (S, *f.shape)), g]
        pair = self._layers("pair", np.concatenate(both, axis=-1)).reshape(S, S, K, K)
        pair = (pair + pair.transpose(1, 0, 3, 2)) / 2
        pair[np.arange(S), np.arange(S)] = 0.0
        return self._layers("single", f)[:, keep], pair[..., keep, :][..., keep]

    def _scaled(self, name: str, features: Array) -> Array:
        off = (features - self.weights[f"{name}_mean"]) / self.weights[f"{name}_sd"]
        return np.asarray(np.clip(off, -_LARGEST, _LARGEST))

    def _layers(self, name: str, x: Array) -> Array:
        w = self.weights
        hidden = np.maximum(x @ w[f"{name}_weight0"].T + w[f"{name}_bias0"], 0)
        return np.asarray(hidden @ w[f"{name}_weight1"].T + w[f"{name}_bias1"])


@cache
def shipped_score() -> MotionScore:
    """Return the shipped scores, read once."""
    return MotionScore.load()
