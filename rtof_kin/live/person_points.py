"""Points of one person in image after image, as a live estimate takes them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError, SourceError
from rtof_kin.vision.detections import Detections, Person, of_body
from rtof_kin.vision.keypoints import MOST_OUTSIDE, keypoint_names, with_own_points
from rtof_kin.vision.landmark_regression import LandmarkRegression, recognise
from rtof_kin.vision.person_detector import Detector
from rtof_kin.vision.tracking import PersonFollower

_LAYOUTS: Final = {
    17: "coco17",
    23: "coco23",
    25: "body25",
    26: "halpe26",
    33: "mediapipe33",
    37: "spine37",
    52: "anatomical52",
    68: "halpe_hands34",
    70: "sapiens38",
    133: "coco23",
    136: "halpe26",
    308: "sapiens38",
}
"""Points of a detector's person -> their layout; those of whole bodies begin with the body's."""
_CHECKED: Final = 30  # Images with the person after which the layout is confirmed by geometry


class PersonPoints:
    """The skeleton's landmarks and the detector's own points of one person, followed over time.

    `detector`: used for nothing else. `camera_px`: width and height that points are scaled to; None: as the images.
    `SourceError`: no layout has as many points; the images have another form than the camera's.
    """

    def __init__(self, detector: Detector, image_px: tuple[int, int], camera_px: tuple[int, int] | None = None):
        self._detector = detector
        self._regression = LandmarkRegression.default()
        if detector.points not in _LAYOUTS:
            raise SourceError(
                f"detector {detector.name}: gives {detector.points} points of a person; known are "
                f"{', '.join(map(str, _LAYOUTS))}; take a model with as many"
            )
        self._form = self._regression.table.layout(_LAYOUTS[detector.points])
        self.names = keypoint_names(self._form)
        """L names of the points."""
        self._follower = PersonFollower(image_px)
        self._scale = _scale(image_px, camera_px)
        self.image_px = image_px
        """Width and height of the images."""
        self._checked: deque[tuple[Array, Array]] | None = deque()
        self._chosen, self._ambiguous = 0, 32
        self.notices: deque[str] = deque()
        """Sentences that are not told yet."""

    def of(self, image: NDArray[np.uint8], time: float) -> tuple[Array, Array]:
        """Return the person's points (L, 2), px, and confidence (L,); NaN and 0 where not seen.

        `image`: (height, width, 3), BGR, upright. time: of the image, s.
        """
        people = [person for person in self._detector.find(image, time) if np.any(person.points[:, 2] > 0)]
        person = self._follow(people, time)
        if person is None:
            return self._nobody()
        found = of_body(Detections.of_frames({0: [person]}))
        uv, confidence = found.uv_px[:, 0], found.confidence[:, 0]
        self._check(uv, confidence)
        try:
            landmarks = self._regression.apply(self._form.name, uv, confidence)
        except InvalidInputError:  # too few points in this image
            return self._nobody()
        points, sure = with_own_points(self._form, landmarks, uv, confidence)
        return points[0] * self._scale, sure[0]

    def _nobody(self) -> tuple[Array, Array]:
        return np.full((len(self.names), 2), np.nan), np.zeros(len(self.names))

    def _follow(self, people: Sequence[Person], time: float) -> Person | None:
        follower = self._follower
        index = follower.follow(people, time)
        if follower.chosen > self._chosen:
            self._chosen = follower.chosen
            others = f", the largest and most central of {len(people)}" if len(people) > 1 else ""
            if follower.chosen > 1:
                self.notices.append(
                    f"the person was out of sight for a second: from {time:.1f} s on whoever is there now "
                    f"is followed{others}"
                )
            elif others:
                self.notices.append(f"one person is followed{others}; keep others out of the picture")
        if follower.ambiguous >= self._ambiguous:
            self._ambiguous = 2 * follower.ambiguous
            self.notices.append(
                f"in {follower.ambiguous} images another person was as near as the one who is followed; "
                "keep others away"
            )
        return None if index is None else people[index]

    def _check(self, uv: Array, confidence: Array) -> None:
        """Confirm layout and place in the image by the first persons (1, K, 2)."""
        if self._checked is None:
            return
        self._checked.append((uv, confidence))
        if len(self._checked) < _CHECKED:
            return
        points, sure = (np.concatenate(part) for part in zip(*self._checked, strict=True))
        self._checked = None
        seen = sure > 0
        outside = np.any((points < 0) | (points > self.image_px), axis=-1)[seen]
        if outside.mean() > MOST_OUTSIDE:
            self.notices.append(f"{100 * outside.mean():.0f} % of the points lie outside of the image")
        try:
            likeliest = recognise(points, sure, regression=self._regression).layout
        except InvalidInputError as error:
            self.notices.append(f"the detector's points are doubtful: {error}")
            return
        if likeliest is not self._form:
            self.notices.append(
                f"the detector's points are taken as {self._form.title}, but look like {likeliest.title}"
            )


def _scale(image_px: tuple[int, int], camera_px: tuple[int, int] | None) -> float:
    """Return pixels of the camera per pixel of the image."""
    if camera_px is None or camera_px == image_px:
        return 1.0
    wide, high = (own / wanted for own, wanted in zip(camera_px, image_px, strict=True))
    if abs(wide / high - 1) > 0.01:
        raise SourceError(
            f"the images have {image_px[0]} x {image_px[1]} px, those of the calibrated camera "
            f"{camera_px[0]} x {camera_px[1]} px, which is another form: give the camera that was "
            "calibrated, held the same way, or make a setup with this one (rtof-kin run --only recording)"
        )
    return wide
