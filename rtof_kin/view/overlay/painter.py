"""`Painter`: draws a motion and its captions on the pictures of a film, one after the other."""

from __future__ import annotations

from typing import Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.view.overlay.angle_labels import UNKNOWN, AngleLabels
from rtof_kin.view.overlay.canvas import Box, Canvas, Image, Stroke
from rtof_kin.view.overlay.captions import Captions, CaptionTexts
from rtof_kin.view.overlay.face import FaceFinder, pixelate
from rtof_kin.view.overlay.label_layout import Label, LabelLayout
from rtof_kin.view.overlay.projected_motion import Moment, ProjectedMotion, ProjectedPose
from rtof_kin.view.overlay.settings import OverlaySettings
from rtof_kin.view.overlay.skeleton_drawing import BLACK, WHITE, SkeletonStyle, draw_bands, draw_detected, draw_skeleton

_LABEL_OPACITY: Final = 0.6
_ALONG: Final = np.linspace(0, 1, 5)
"""Points along each bone that labels should not cover, fractions of its length."""


class Painter:
    """Draws on pictures of one size; labels keep their places from one picture to the next."""

    def __init__(self, projected: ProjectedMotion, angles: AngleLabels, texts: CaptionTexts, settings: OverlaySettings):
        """Take the motion in the pixels of the pictures, labels, captions and what to draw."""
        camera = projected.view.camera
        size = camera.width_px, camera.height_px
        self._projected, self._angles, self._settings = projected, angles, settings
        self._style = SkeletonStyle(*size)
        self._captions = Captions(texts, *size)
        self._layout = LabelLayout()
        width = self._captions.lettering.width
        self._widths = {name: width(angles.widest(a)) for a, name in enumerate(angles.names)}
        self._face = FaceFinder(projected) if settings.blur_face else None

    def paint(self, image: Image, video_time: float) -> bool:
        """Draw on one picture, in place; return whether a person is drawn.

        Args:
            image: (height, width, 3), BGR. video_time: s, in the time of the view's video.
        """
        moment = self._projected.moment(video_time)
        if self._face is not None:
            pixelate(image, self._face.region(moment))
        canvas = Canvas(image)
        time, seen = None, False
        if moment is not None:
            pose = self._projected.pose(moment)
            time, seen = pose.time, bool(np.isfinite(pose.uv_px).any())
            self._draw_person(canvas, pose, moment)
            self._draw_labels(canvas, pose, moment)
        self._captions.draw(canvas, time, video_time, seen)
        return seen

    def _draw_person(self, canvas: Canvas, pose: ProjectedPose, moment: Moment) -> None:
        projected = self._projected
        if self._settings.bands:
            nearest = moment.after if moment.weight > 0.5 else moment.before
            covariance = projected.covariance_px(nearest)
            if covariance is not None:
                J = len(covariance)
                draw_bands(canvas, pose.uv_px[:J], covariance, pose.provenance[:J], self._style)
        draw_skeleton(canvas, pose, projected.bones, projected.names, self._style)
        if self._settings.points:
            draw_detected(canvas, projected.detected(moment), self._style)

    def _draw_labels(self, canvas: Canvas, pose: ProjectedPose, moment: Moment) -> None:
        lettering = self._captions.lettering
        pad = max(lettering.size_px // 4, 2)
        above, below = self._captions.boxes(pose.time)
        free = Box(0, above.bottom, canvas.box.width, below.top - above.bottom)
        labels, joints = self._wanted(pose, free, pad)
        ends = pose.uv_px[np.array(self._projected.bones)]
        avoided = (ends[:, :1] + _ALONG[:, None] * (ends[:, 1:] - ends[:, :1])).reshape(-1, 2)
        for name, box in self._layout.place(labels, free, avoided).items():
            a = self._angles.names.index(name)
            self._draw_leader(canvas, box, pose.uv_px[joints[name]])
            canvas.shade(box, BLACK, _LABEL_OPACITY)
            text = self._angles.text(a, moment)
            colour = (200, 200, 200) if text.endswith(UNKNOWN) else WHITE
            canvas.stamp(box.left + pad, box.top + pad, lettering.mask(text), colour)

    def _wanted(self, pose: ProjectedPose, free: Box, pad: int) -> tuple[list[Label], dict[str, int]]:
        """Return labels of the joints that lie in the free part of the picture, and these joints."""
        lettering, angles = self._captions.lettering, self._angles
        middle = float(np.nanmean(pose.uv_px[:, 0])) if np.isfinite(pose.uv_px).any() else 0.0
        labels, joints = [], {}
        for name, joint in zip(angles.names, angles.joints, strict=True):
            u, v = pose.uv_px[joint]
            if not (0 <= u < free.width and free.top <= v < free.bottom):
                continue
            width = self._widths[name] + 2 * pad
            labels.append(Label(name, u, v, width, lettering.line_height + 2 * pad, bool(u < middle)))
            joints[name] = joint
        return labels, joints

    def _draw_leader(self, canvas: Canvas, box: Box, joint: Array) -> None:
        """Draw a thin line from a joint to the nearest point of its label."""
        end = np.clip(joint, [box.left, box.top], [box.right, box.bottom])
        end[1] = box.top + box.height / 2 if not box.left < joint[0] < box.right else end[1]
        canvas.line(joint, end, Stroke(WHITE, self._style.thin, BLACK, self._style.edge / 2))
