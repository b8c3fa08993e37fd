"""`Painter`: draws a motion and its captions on the pictures of a film, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_table import SIDES, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import Provenance
from rtof_kin.view.canvas import Box, Canvas, Image, Label, LabelLayout, Lettering, Stroke
from rtof_kin.view.face import FaceFinder, pixelate
from rtof_kin.view.legend import COLOURS, WORDS, Rgb
from rtof_kin.view.overlay_settings import OverlaySettings
from rtof_kin.view.projected_motion import Moment, ProjectedMotion, ProjectedPose

USUAL: Final = tuple(f"{side}_{joint}_flexion" for joint in ("knee", "hip", "elbow") for side in SIDES)
"""Angles that are shown unless others are chosen."""
UNKNOWN: Final = "-"
"""Value of an angle that is not observed, or unreliable."""


@dataclass(frozen=True)
class AngleLabels:
    """Chosen angles of a motion, their joints and their texts."""

    names: tuple[str, ...]
    """A names, e.g. 'right_knee_flexion'."""
    titles: tuple[str, ...]
    """A short names, e.g. 'R knee'."""
    joints: tuple[int, ...]
    """A joints of the skeleton beside which they stand."""
    values_deg: Array
    """(T, A) deg; NaN where not observed or unreliable."""
    half_deg: Array
    """(T, A) deg, half width of the 95 % band; NaN where unknown."""

    def widest(self, index: int) -> str:
        """Return a text as wide as any of an angle."""
        values, half = self.values_deg[:, index], self.half_deg[:, index]
        if not np.isfinite(values).any():
            return f"{self.titles[index]} {UNKNOWN}"
        digits = [len(str(round(float(np.nanmax(np.abs(x)))))) if np.isfinite(x).any() else 0 for x in (values, half)]
        sign = "−" if np.nanmin(values) < 0 else ""
        band = f"  ± {'8' * digits[1]}°" if digits[1] else ""
        return f"{self.titles[index]} {sign}{'8' * digits[0]}°{band}"

    def text(self, index: int, moment: Moment) -> str:
        """Return the title and the value of an angle at an instant."""
        frames = moment.frames
        value = float(moment.mix(self.values_deg[frames, index]))
        half = float(moment.mix(self.half_deg[frames, index]))
        return f"{self.titles[index]} {value_text(value, half)}"


def value_text(value_deg: float, half_deg: float) -> str:
    """Return an angle in words, e.g. '45°  ± 4°'.

    Args:
        value_deg: deg; NaN where unknown. half_deg: half width of its 95 % band, deg; NaN where unknown.
    """
    if not np.isfinite(value_deg):
        return UNKNOWN
    band = f"  ± {max(half_deg, 1):.0f}°" if np.isfinite(half_deg) else ""
    return f"{round(value_deg)}°{band}".replace("-", "−")


def angle_labels(motion: Motion, chosen: Sequence[str] | None = None) -> AngleLabels:
    """Return the labels of chosen angles.

    Args:
        chosen: names of angles; by default `USUAL`, those with a value at any time.

    Raises:
        UnknownNameError: there is no such angle.
    """
    angles = clinical_angles(motion)
    names = tuple(dict.fromkeys(_observed(angles) if chosen is None else chosen))
    angles = angles.select(names)
    table = angle_table(motion.skeleton.table)
    child = {row.name: joint.child for joint in table.joints for row in joint.angles}
    half = np.full(angles.values.shape, np.nan) if angles.sigma is None else BAND_95 * angles.sigma
    return AngleLabels(
        names,
        tuple(map(short_name, names)),
        tuple(motion.skeleton.index(*(child[name] for name in names))),
        np.degrees(angles.trusted_values),
        np.degrees(half),
    )


def _observed(angles: ClinicalAngles) -> list[str]:
    """Return those of the usual angles that have a reliable value at any time."""
    known: Mask = np.asarray(np.isfinite(angles.trusted_values).any(axis=0))
    return [name for name in USUAL if name in angles.names and known[angles.names.index(name)]]


def short_name(name: str) -> str:
    """Return a short title of an angle: 'R knee', 'L hip adduction'."""
    side, _, rest = name.partition("_")
    title = f"{side[0].upper()} {rest}" if side in SIDES else name
    return title.replace("_", " ").removesuffix(" flexion")


_SMALLEST_PX: Final = 11
_SIZE: Final = 0.0165
"""Size of the font over the square root of the picture's area."""
_OPACITY: Final = 0.75
_FAULT_LINES: Final = 2
"""Most lines of a fault."""
_FAULTS: Final = 2
"""Most faults that are named at a time."""
_FAULT: Final[Rgb] = (255, 205, 90)
_NOWHERE: Final = "no motion here"
_UNSEEN: Final = "not observed"


@dataclass(frozen=True)
class CaptionTexts:
    """What captions say in all pictures of a film."""

    title: str
    """One line beside the time."""
    faults: tuple[StreamFault, ...] = ()
    """Shown while they last."""
    provenances: tuple[Provenance, ...] = ()
    """For the legend."""
    detected: bool = False
    """Whether detected points are drawn."""
    bands: bool = False
    """Whether 95 % ellipses are drawn."""


@dataclass(frozen=True)
class _Item:
    """An entry of the legend; without a stroke a detected point."""

    text: str
    stroke: Stroke | None


@dataclass(frozen=True)
class _Line:
    """A line of text at a place."""

    text: str
    left: int
    top: int
    colour: Rgb


class Captions:
    """Captions of the pictures of a film."""

    def __init__(self, texts: CaptionTexts, width_px: int, height_px: int):
        """Take the texts and the size of the pictures."""
        self._texts = texts
        self._width, self._height = width_px, height_px
        self._style = SkeletonStyle(width_px, height_px)
        self.lettering = Lettering(font_size(width_px, height_px))
        self._pad = max(self.lettering.size_px // 3, 3)
        inner = width_px - 2 * self._pad
        self._legend = self._legend_rows(_items(texts, self._style), inner)

    def boxes(self, time: float | None) -> tuple[Box, Box]:
        """Return the boxes above and below that captions cover.

        Args:
            time: s, of the motion; None where there is none.
        """
        line = self.lettering.line_height
        above = line + 2 * self._pad
        below = (len(self._fault_lines(time)) + len(self._legend)) * line + 2 * self._pad
        return Box(0, 0, self._width, above), Box(0, self._height - below, self._width, below)

    def draw(self, canvas: Canvas, time: float | None, video_time: float, seen: bool = True) -> None:
        """Draw captions.

        Args:
            time: s, of the motion; None where there is none. video_time: s, of the video.
        """
        above, below = self.boxes(time)
        for box in (above, below):
            canvas.shade(box, BLACK, _OPACITY)
        line, pad = self.lettering.line_height, self._pad
        now, colour = f"{_NOWHERE} (video: {video_time:.2f} s)", _FAULT
        if time is not None:
            now, colour = f"{time:.2f} s{'' if seen else f', {_UNSEEN}'}", WHITE
        canvas.stamp(pad, above.top + pad, self.lettering.mask(now), colour)
        left = 2 * pad + self.lettering.line_height + self.lettering.width(now)
        title = self.lettering.shortened(self._texts.title, self._width - left - pad)
        canvas.stamp(left, above.top + pad, self.lettering.mask(title), WHITE)
        faults = self._fault_lines(time)
        for i, text in enumerate(faults):
            canvas.stamp(pad, below.top + pad + i * line, self.lettering.mask(text), _FAULT)
        for i, row in enumerate(self._legend):
            self._draw_legend(canvas, row, below.top + pad + (len(faults) + i) * line)

    def _fault_lines(self, time: float | None) -> list[str]:
        """Return the sentences of the faults at an instant."""
        if time is None:
            return []
        now = [fault for fault in self._texts.faults if fault.start <= time <= fault.stop]
        lines = []
        for fault in now[:_FAULTS]:
            text = f"{fault.what}: {fault.kind.value}"
            lines += self.lettering.wrap(text, self._width - 2 * self._pad, _FAULT_LINES)
        return lines + ([f"and {len(now) - _FAULTS} more faults"] if len(now) > _FAULTS else [])

    # --- legend ----------------------------------------------------------------------------------

    def _legend_rows(self, items: Sequence[_Item], width: int) -> list[list[tuple[int, _Item]]]:
        """Return rows of entries with their left ends, px."""
        rows: list[list[tuple[int, _Item]]] = [[]]
        left = self._pad
        for item in items:
            size = self._swatch + self._pad + self.lettering.width(item.text)
            if rows[-1] and left + size > width:
                rows.append([])
                left = self._pad
            rows[-1].append((left, item))
            left += size + 2 * self._pad + self.lettering.size_px // 2
        return rows

    @property
    def _swatch(self) -> int:
        return 2 * self.lettering.size_px

    def _draw_legend(self, canvas: Canvas, row: Sequence[tuple[int, _Item]], top: int) -> None:
        middle = top + self.lettering.line_height / 2
        radius = self._style.bone
        for left, item in row:
            if item.stroke is None:
                stroke = Stroke(DETECTED, self._style.thin, BLACK, self._style.edge / 2)
                canvas.cross((left + self._swatch / 2, middle), self._style.cross, stroke)
            else:
                ends = (left + radius, middle), (left + self._swatch - radius, middle)
                canvas.line(ends[0], ends[1], item.stroke)
            canvas.stamp(left + self._swatch + self._pad, top, self.lettering.mask(item.text), WHITE)


def font_size(width_px: int, height_px: int) -> int:
    """Return the size of the font for a picture, px."""
    return max(round(_SIZE * float(np.sqrt(width_px * height_px))), _SMALLEST_PX)


def _items(texts: CaptionTexts, style: SkeletonStyle) -> list[_Item]:
    """Return the entries of a legend."""
    shown = sorted(texts.provenances, reverse=True)
    items = [_Item(WORDS[how], style.bone_stroke(how, right=False)) for how in shown]
    for text, edge in (("right", WHITE), ("left, middle", BLACK)):
        items.append(_Item(text, Stroke((120, 120, 120), style.bone, edge, style.edge)))
    if texts.detected:
        items.append(_Item("detected point", None))
    if texts.bands:
        items.append(_Item("95 % of the joint's position", Stroke(WHITE, style.thin)))
    return items


BLACK: Final[Rgb] = (20, 20, 20)
WHITE: Final[Rgb] = (255, 255, 255)
DETECTED: Final[Rgb] = (240, 228, 66)
"""Of the crosses at detected points; yellow of Okabe and Ito."""
_SQUARED_95: Final = 5.991
"""95 % quantile of chi-squared with two degrees of freedom."""
_FILL: Final = 0.18


class SkeletonStyle:
    """Widths of lines that follow the size of a picture."""

    def __init__(self, width_px: int, height_px: int):
        """Take the size of the picture."""
        size = float(np.sqrt(width_px * height_px))
        self.bone = max(size / 520, 1.0)
        """Half width of a bone, px."""
        self.edge = max(size / 1400, 0.7)
        """Width of the edge around bones and joints, px."""
        self.joint = 1.7 * self.bone
        """Radius of a joint, px."""
        self.thin = max(size / 2200, 0.6)
        """Half width of crosses and of the borders of ellipses, px."""
        self.cross = 2.2 * self.bone
        """Half the width of a cross, px."""

    def bone_stroke(self, provenance: int, right: bool) -> Stroke:
        """Return how a bone is drawn."""
        return Stroke(COLOURS[Provenance(provenance)], self.bone, WHITE if right else BLACK, self.edge)


def draw_skeleton(
    canvas: Canvas,
    pose: ProjectedPose,
    bones: tuple[tuple[int, int], ...],
    names: tuple[str, ...],
    style: SkeletonStyle,
) -> None:
    """Draw bones and joints."""
    for parent, child in sorted(bones, key=lambda bone: pose.provenance[bone[1]]):
        stroke = style.bone_stroke(int(pose.provenance[child]), is_right(names[child]))
        canvas.line(pose.uv_px[parent], pose.uv_px[child], stroke)
    for i, uv in enumerate(pose.uv_px):
        colour = COLOURS[Provenance(int(pose.provenance[i]))]
        canvas.disc(uv, Stroke(colour, style.joint, WHITE if is_right(names[i]) else BLACK, style.edge))


def draw_bands(
    canvas: Canvas, uv_px: Array, covariance_px: Array, provenance: NDArray[np.uint8], style: SkeletonStyle
) -> None:
    """Draw the 95 % ellipses of joints.

    Args:
        uv_px: (J, 2). covariance_px: (J, 2, 2) px^2; NaN where unknown. provenance: (J,) of the joints.
    """
    for uv, covariance, how in zip(uv_px, covariance_px, provenance, strict=True):
        stroke = Stroke(COLOURS[Provenance(int(how))], style.thin)
        canvas.ellipse(uv, _SQUARED_95 * covariance, stroke, _FILL)


def draw_detected(canvas: Canvas, uv_px: Array, style: SkeletonStyle) -> None:
    """Draw a cross at each detected point.

    Args:
        uv_px: (L, 2); NaN where not detected.
    """
    stroke = Stroke(DETECTED, style.thin, BLACK, style.edge / 2)
    for uv in uv_px:
        canvas.cross(uv, style.cross, stroke)


def is_right(name: str) -> bool:
    """Return whether a joint or landmark is of the right side."""
    return name.startswith("Right") or (len(name) > 1 and name[0] == "R" and name[1].isupper())


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
