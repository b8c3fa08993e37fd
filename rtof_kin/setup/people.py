"""People of a video: numbered for the picture `init` writes, and the one that the recording is of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.arrays import read_npz, write_npz
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoint_files import read_detector_file
from rtof_kin.vision.tracking import track_people

_LEAST_WEIGHT: Final = 0.05
"""Share of the most prominent person's weight below which somebody is a passer-by or a false detection."""
_RIVAL: Final = 0.4
"""Share of the most prominent person's weight from which on the choice is left to the user."""
_FEWEST_POINTS: Final = 4
"""Points at once that make a person."""
_DOUBLE: Final = 0.1
"""Distance, relative to the diagonal of the person's box, within which two points are the same."""


@dataclass(frozen=True)
class People:
    """People of a video, person n in column n - 1."""

    detections: Detections
    """Those who count, by their numbers; NaN where one is not seen."""
    times: Array
    """(T,) s."""
    weights: tuple[float, ...]
    """Prominence of each, relative to the first."""

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def share(self) -> Array:
        """(P,) fraction of the frames in which each is seen."""
        return np.asarray(self.detections.present.mean(axis=0))

    def first_frame(self, number: int) -> int:
        """Return the first frame in which a person is seen.

        Args:
            number: from 1.
        """
        return int(np.argmax(self.detections.present[:, number - 1]))


def number_people(detections: Detections, times: Array, image_px: tuple[float, float]) -> People:
    """Number the people, the most prominent first: large, in the middle and often seen.

    Args:
        times: (T,) s.

    Raises:
        InvalidInputError: there is no person.
    """
    detections = _without_doubles(detections)
    points = (detections.confidence > 0).sum(axis=-1)
    tracks = track_people(detections, times, image_px)
    if points.max() < _FEWEST_POINTS:
        raise no_person()
    kept = [(track, weight) for track, weight in tracks if weight >= _LEAST_WEIGHT * tracks[0][1]]
    uv, confidence = zip(*(track.of(detections) for track, _ in kept), strict=True)
    numbers = np.broadcast_to(np.arange(len(kept)), (len(times), len(kept)))
    own = replace(
        detections, uv_px=np.stack(uv, axis=1), confidence=np.stack(confidence, axis=1), times=times, identity=numbers
    )
    weights = tuple(weight / kept[0][1] for _, weight in kept)
    return People(own, times, weights)


def _without_doubles(detections: Detections) -> Detections:
    """Return the detections without those that a detector made twice of one person; the surer one stays."""
    uv, confidence = np.array(detections.uv_px), np.array(detections.confidence)
    for p, q in combinations(range(uv.shape[1]), 2):
        same = _same(uv[:, p], uv[:, q])
        surer = confidence[:, p].sum(axis=-1) >= confidence[:, q].sum(axis=-1)
        for gone, frames in ((q, same & surer), (p, same & ~surer)):
            uv[frames, gone], confidence[frames, gone] = np.nan, 0.0
    return replace(detections, uv_px=uv, confidence=confidence)


def _same(a: Array, b: Array) -> Mask:
    """Return the frames (T,) in which two people (T, K, 2) are one, by most of the points that both have."""
    apart = np.linalg.norm(a - b, axis=-1)
    size = np.linalg.norm(np.fmax.reduce(a, axis=1) - np.fmin.reduce(a, axis=1), axis=-1)
    both, near = np.isfinite(apart).sum(axis=1), (apart < _DOUBLE * size[:, None]).sum(axis=1)
    return np.asarray((both >= _FEWEST_POINTS) & (near > both / 2))


def write_people(path: Path, people: People) -> None:
    """Write an .npz file that `read_detector_file` reads too."""
    found = people.detections
    assert found.identity is not None
    write_npz(
        path,
        {
            "uv_px": found.uv_px,
            "confidence": found.confidence,
            "times": people.times,
            "identity": found.identity,
            "weights": np.array(people.weights),
        },
    )


def read_people(path: Path) -> People:
    """Read what `write_people` wrote.

    Raises:
        FileFormatError: damaged.
    """
    found, weights = read_detector_file(path), read_npz(path)["weights"]
    assert found.times is not None
    return People(found, found.times, tuple(weights.tolist()))


def no_person() -> InvalidInputError:
    """Return the error about a video without people."""
    return InvalidInputError(
        "no person was found in the video: film the whole person, in light, not smaller than a third of the "
        "image; or give the keypoints of another detector"
    )


def choose_person(people: People, number: int | None, picture: str) -> int:
    """Return the number of the person that the recording is of.

    Args:
        number: as the user says, None where not said.

    Raises:
        InvalidInputError: there is no such person, or several are equally prominent and none was chosen.
    """
    if number is None:
        rivals = [n for n, weight in enumerate(people.weights, start=1) if weight >= _RIVAL]
        if len(rivals) > 1:
            raise InvalidInputError(
                f"{len(rivals)} people are in the video: look at {picture} and choose one with {_options(rivals)}"
            )
        return 1
    if not 1 <= number <= len(people):
        known = [n for n in range(1, len(people) + 1)]
        raise InvalidInputError(
            f"--person {number}: there is no such person; look at {picture} and choose {_options(known)}"
        )
    return number


def _options(numbers: Sequence[int]) -> str:
    return " or ".join(f"--person {n}" for n in numbers)
