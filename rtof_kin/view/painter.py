"""`Painter`: draws a motion and its captions on the pictures of a film, one after the other.

The colour of a bone is that of its child's provenance; pink is bridged. What was not observed is not drawn.
Bones of the right side have a white edge, all others a black one. Captions have time, title, faults while they last
and a legend; labels beside the joints have angles with their 95 % bands.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.clinical.angle_table import SIDES, angle_table
from rtof_kin.clinical.angles import angles_and_paths
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import indices_of
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.imu_stream import StreamFault
from rtof_kin.data.poses import COLOURS, Provenance, Rgb
from rtof_kin.view.canvas import Box, Canvas, Image, Label, LabelLayout, Lettering, Stroke
from rtof_kin.view.legend import WORDS
from rtof_kin.view.overlay_settings import OverlaySettings
from rtof_kin.view.projected_motion import Moment, ProjectedMotion, ProjectedPose

_HEAD: Final = "Head"
_RADIUS: Final = 0.24 / 1.75
"""Radius around the middle of the head that contains it with hair and chin, over the body height."""
_SIGMAS: Final = 3.0  # Standard deviations of the head's position by which the region is larger
_UNKNOWN: Final = 0.5  # Radii by which it is larger without a confidence
_MOST: Final = 1.5
"""Largest such margin, radii; a detected point of the head that lies elsewhere than expected counts too."""
_BLOCKS: Final = 6  # Blocks across a region: about two across a face
_BLOCKS_OF_ALL: Final = 12  # Blocks across the shorter side where the whole picture is blurred
_SLACK: Final = 1  # Frames of the motion before and after, whose regions are added
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) / np.sqrt(3)
_DIRECTIONS: Final = np.vstack([np.eye(3), -np.eye(3), _CORNERS])  # (14, 3) unit vectors in all directions


@dataclass(frozen=True)
class FaceRegion:
    """Where the face of the tracked person may be."""

    box: Box | None  #: Pixels to be blurred; None: all of the picture
    block: int  #: Size of the blocks, px


class FaceFinder:
    """Regions of the face of the tracked person in a picture."""

    def __init__(self, projected: ProjectedMotion):
        skeleton = projected.motion.skeleton
        camera = projected.view.camera
        self._projected, self._picture = projected, Box(0, 0, camera.width_px, camera.height_px)
        self._joint = skeleton.names.index(_HEAD) if _HEAD in skeleton.names else None
        self._offset = 0.5 * skeleton.landmarks.get("HeadTop", (_HEAD, np.zeros(3)))[1]
        self._radius = _RADIUS * skeleton.height
        names = projected.view.names
        own = {name: offset for name, (joint, offset) in skeleton.landmarks.items() if joint == _HEAD}
        self._detected = [i for i, name in enumerate(names) if name in own]
        self._offsets = np.array([own[names[i]] for i in self._detected]).reshape(-1, 3)
        self._largest = -(-min(self._picture.width, self._picture.height) // _BLOCKS_OF_ALL)

    def region(self, moment: Moment | None) -> FaceRegion:
        """Return what to blur at an instant. `moment`: of the motion; None where there is none."""
        whole = FaceRegion(None, self._largest)
        if moment is None or self._joint is None:
            return whole
        last = len(self._projected.motion.times) - 1
        frames = range(max(moment.before - _SLACK, 0), min(moment.after + _SLACK, last) + 1)
        circles = [self._circle(frame) for frame in frames]
        if any(circle is None for circle in circles):
            return whole
        boxes = np.array([(*(c - r), *(c + r)) for c, r in filter(None, circles)])
        left, top = np.floor(boxes[:, :2].min(axis=0)).astype(int)
        right, bottom = np.ceil(boxes[:, 2:].max(axis=0)).astype(int) + 1
        box = Box(int(left), int(top), int(right - left), int(bottom - top))
        block = -(-max(box.width, box.height) // _BLOCKS)
        self._largest = max(self._largest, block)
        return FaceRegion(box, block)

    def _circle(self, frame: int) -> tuple[Array, float] | None:
        """Return middle and radius, px, of a region with the head in a frame; None where that is unknown."""
        j, projected = self._joint, self._projected
        if j is None or projected.provenance[frame, j] < Provenance.IMU:
            return None
        motion, own = projected.nearby.at(np.array([frame]))
        p, R = motion.poses.p_world_joint[own[0], j], motion.poses.R_world_bone[own[0], j]
        around = p + R @ self._offset + self._radius * np.vstack([np.zeros(3), _DIRECTIONS])
        points = np.vstack([around, p + self._offsets @ R.T])
        uv = projected.view.project(points[None], np.array([frame]))[0]
        if not np.isfinite(uv).all():
            return None
        uv, expected = uv[: len(around)], uv[len(around) :]
        radius = float(np.linalg.norm(uv[1:] - uv[0], axis=1).max())
        margin = _UNKNOWN * radius
        covariance = projected.covariance_px(frame)
        if covariance is not None and np.isfinite(covariance[j]).all():
            margin = _SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance[j])[-1]))
        detected = projected.view.in_video(np.array([frame]))[0, self._detected]
        apart = np.linalg.norm(detected - expected, axis=1)
        margin = max(margin, float(apart[np.isfinite(apart)].max(initial=0.0)))
        return (uv[0], radius + margin) if margin <= _MOST * radius else None


def pixelate(image: Image, region: FaceRegion) -> None:
    """Replace a region of an image, in place, by the mean colours of its blocks. `image`: (height, width, 3)."""
    height, width = image.shape[:2]
    box = region.box or Box(0, 0, width, height)
    left, top = max(box.left, 0), max(box.top, 0)
    right, bottom = min(box.right, width), min(box.bottom, height)
    if right <= left or bottom <= top:
        return
    patch = image[top:bottom, left:right]
    counts = [max(size // region.block, 1) for size in patch.shape[:2]]  # blocks that are none smaller than that
    rows, columns = (np.arange(n) * size // n for n, size in zip(counts, patch.shape[:2], strict=True))
    heights, widths = np.diff([*rows, patch.shape[0]]), np.diff([*columns, patch.shape[1]])
    sums = np.add.reduceat(np.add.reduceat(patch, rows, axis=0, dtype=np.int64), columns, axis=1)
    means = (sums // np.outer(heights, widths)[..., None]).astype(np.uint8)
    patch[:] = means.repeat(heights, axis=0).repeat(widths, axis=1)


USUAL: Final = tuple(f"{side}_{joint}_flexion" for joint in ("knee", "hip", "elbow") for side in SIDES)
"""Angles that are shown unless others are chosen."""
UNKNOWN: Final = "-"  #: Value of an angle that is not observed, or unreliable
BLACK: Final[Rgb] = (20, 20, 20)
WHITE: Final[Rgb] = (255, 255, 255)
CROSSES: Final[Rgb] = (240, 228, 66)  #: Crosses at detected points; yellow of Okabe and Ito
_GREY, _PALE, _FAULT = (120, 120, 120), (200, 200, 200), (255, 205, 90)
_SQUARED_95: Final = 5.991  # 95 % quantile of chi-squared with two degrees of freedom
_FILL, _LABEL_OPACITY, _CAPTION_OPACITY = 0.18, 0.6, 0.75
_SMALLEST_PX: Final = 11
_SIZE: Final = 0.0165  # Size of the font over the square root of the picture's area
_FAULT_LINES, _FAULTS = 2, 2  # Most lines of a fault; most faults that are named at a time
_ALONG: Final = np.linspace(0, 1, 5)  # Points along each bone that labels should not cover, fractions of its length


@dataclass(frozen=True)
class AngleLabels:
    """Chosen angles of a motion, their joints and their texts."""

    names: tuple[str, ...]  #: A names, e.g. 'right_knee_flexion'.
    titles: tuple[str, ...]  #: A short names, e.g. 'R knee'.
    joints: tuple[int, ...]  #: A joints of the skeleton beside which they stand
    values_deg: Array  #: (T, A) deg; NaN where not observed or unreliable
    half_deg: Array  #: (T, A) deg, half width of the 95 % band; NaN where unknown

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
        """Return the title and the value of an angle at an instant, e.g. 'R knee 45°  ± 4°'."""
        value, half = (float(moment.mix(x[moment.frames, index])) for x in (self.values_deg, self.half_deg))
        if not np.isfinite(value):
            return f"{self.titles[index]} {UNKNOWN}"
        band = f"  ± {max(half, 1):.0f}°" if np.isfinite(half) else ""
        return f"{self.titles[index]} {round(value)}°{band}".replace("-", "−")


def angle_labels(motion: MotionSource, chosen: Sequence[str] | None = None) -> AngleLabels:
    """Return the labels of chosen angles.

    `chosen`: names of angles; by default `USUAL`, those with a value at any time. `UnknownNameError`: there is no such
    angle.
    """
    table = angle_table(motion.skeleton.table)
    child = {row.name: joint.child for joint in table.joints for row in joint.angles}
    indices_of("clinical angle", chosen or (), list(child))
    wanted = set(USUAL if chosen is None else chosen)
    own = tuple(joint for joint in table.joints if wanted & {row.name for row in joint.angles})
    (angles,), _ = angles_and_paths(motion, replace(table, joints=own or table.joints[:1]))
    known: Mask = np.asarray(np.isfinite(angles.trusted_values).any(axis=0))
    usual = [name for name in USUAL if name in angles.names and known[angles.names.index(name)]]
    names = tuple(usual if chosen is None else dict.fromkeys(chosen))
    angles = angles.select(names)
    half = np.full(angles.values.shape, np.nan) if angles.sigma is None else BAND_95 * angles.sigma
    joints = tuple(motion.skeleton.index(*(child[name] for name in names)))
    return AngleLabels(names, tuple(map(_short, names)), joints, np.degrees(angles.trusted_values), np.degrees(half))


def _short(name: str) -> str:
    """Return a short title of an angle: 'R knee', 'L hip adduction'."""
    side, _, rest = name.partition("_")
    title = f"{side[0].upper()} {rest}" if side in SIDES else name
    return title.replace("_", " ").removesuffix(" flexion")


class Style:
    """Strokes whose widths follow the size of a picture."""

    def __init__(self, width_px: int, height_px: int):
        size = float(np.sqrt(width_px * height_px))
        self.bone = max(size / 520, 1.0)
        """Half width of a bone, px."""
        self.edge = max(size / 1400, 0.7)
        """Width of the edge around bones and joints, px."""
        self.thin = max(size / 2200, 0.6)
        """Half width of crosses, of leaders and of the borders of ellipses, px."""
        self.cross = 2.2 * self.bone
        """Half the width of a cross, px."""

    def stroke(self, colour: Rgb, right: bool = False, radius: float | None = None) -> Stroke:
        """Return how a bone is drawn, or a joint of a radius, px."""
        return Stroke(colour, self.bone if radius is None else radius, WHITE if right else BLACK, self.edge)


def draw_skeleton(
    canvas: Canvas, pose: ProjectedPose, bones: Sequence[tuple[int, int]], names: Sequence[str], style: Style
) -> None:
    """Draw bones and joints of a person. `bones`: pairs of points of the pose. `names`: of the points."""
    colours = [COLOURS[Provenance(int(kind))] for kind in pose.provenance]
    right = [name.startswith("Right") or (name[:1] == "R" and name[1:2].isupper()) for name in names]
    for parent, child in sorted(bones, key=lambda bone: pose.provenance[bone[1]]):
        canvas.line(pose.uv_px[parent], pose.uv_px[child], style.stroke(colours[child], right[child]))
    for i, uv in enumerate(pose.uv_px):
        canvas.disc(uv, style.stroke(colours[i], right[i], 1.7 * style.bone))


class Captions:
    """Captions above and below the pictures of a film.

    `title`: one line beside the time. `faults`: shown while they last.
    """

    def __init__(
        self, projected: ProjectedMotion, title: str, faults: Sequence[StreamFault], settings: OverlaySettings
    ):
        self._title, self._faults = title, faults
        camera = projected.view.camera
        self._width, self._height = camera.width_px, camera.height_px
        self._style = Style(self._width, self._height)
        self.lettering = Lettering(max(round(_SIZE * float(np.sqrt(self._width * self._height))), _SMALLEST_PX))
        self._pad = max(self.lettering.size_px // 3, 3)
        self._swatch = 2 * self.lettering.size_px
        self._legend = self._legend_rows(projected, settings)

    def boxes(self, time: float | None) -> tuple[Box, Box]:
        """Return the boxes above and below that captions cover. `time`: s, of the motion; None where there is none."""
        line, pad = self.lettering.line_height, 2 * self._pad
        below = (len(self._fault_lines(time)) + len(self._legend)) * line + pad
        return Box(0, 0, self._width, line + pad), Box(0, self._height - below, self._width, below)

    def draw(self, canvas: Canvas, time: float | None, video_time: float, seen: bool = True) -> None:
        """Draw captions. `time`: s, of the motion; None where there is none. video_time: s, of the video."""
        above, below = self.boxes(time)
        for box in (above, below):
            canvas.shade(box, BLACK, _CAPTION_OPACITY)
        lettering, line, pad = self.lettering, self.lettering.line_height, self._pad
        now, colour = f"no motion here (video: {video_time:.2f} s)", _FAULT
        if time is not None:
            now, colour = f"{time:.2f} s{'' if seen else ', not observed'}", WHITE
        canvas.stamp(pad, above.top + pad, lettering.mask(now), colour)
        left = 2 * pad + line + lettering.width(now)
        title = lettering.shortened(self._title, self._width - left - pad)
        canvas.stamp(left, above.top + pad, lettering.mask(title), WHITE)
        top = below.top + pad
        for text in self._fault_lines(time):
            canvas.stamp(pad, top, lettering.mask(text), _FAULT)
            top += line
        for row in self._legend:
            for left, text, stroke in row:
                ends = np.array([left + self._style.bone, left + self._swatch - self._style.bone])
                middle = top + line / 2
                if stroke is None:
                    canvas.cross((float(ends.mean()), middle), self._style.cross, self.crosses)
                else:
                    canvas.line((ends[0], middle), (ends[1], middle), stroke)
                canvas.stamp(left + self._swatch + pad, top, lettering.mask(text), WHITE)
            top += line

    @property
    def crosses(self) -> Stroke:
        """How crosses at detected points are drawn."""
        return Stroke(CROSSES, self._style.thin, BLACK, self._style.edge)

    def _fault_lines(self, time: float | None) -> list[str]:
        """Return the sentences of the faults at an instant, s."""
        if time is None:
            return []
        now = [fault for fault in self._faults if fault.start <= time <= fault.stop]
        lines = []
        for fault in now[:_FAULTS]:
            text = f"{fault.what}: {fault.kind.value}"
            lines += self.lettering.wrap(text, self._width - 2 * self._pad, _FAULT_LINES)
        return lines + ([f"and {len(now) - _FAULTS} more faults"] if len(now) > _FAULTS else [])

    def _legend_rows(
        self, projected: ProjectedMotion, settings: OverlaySettings
    ) -> list[list[tuple[int, str, Stroke | None]]]:
        """Return rows of entries: left end, px, text, and stroke, None for a detected point."""
        style, bands = self._style, settings.bands and projected.covariance_px(0) is not None
        items: list[tuple[str, Stroke | None]] = [
            (WORDS[how], style.stroke(COLOURS[how])) for how in sorted(projected.provenances, reverse=True)
        ]
        items += [("right", style.stroke(_GREY, right=True)), ("left, middle", style.stroke(_GREY))]
        items += [("detected point", None)] if settings.points else []
        items += [("95 % of the joint's position", Stroke(WHITE, style.thin))] if bands else []
        rows: list[list[tuple[int, str, Stroke | None]]] = [[]]
        left = self._pad
        for text, stroke in items:
            size = self._swatch + self._pad + self.lettering.width(text)
            if rows[-1] and left + size > self._width - 2 * self._pad:
                rows.append([])
                left = self._pad
            rows[-1].append((left, text, stroke))
            left += size + 2 * self._pad + self.lettering.size_px // 2
        return rows


class Painter:
    """Draws on pictures of one size; labels keep their places from one picture to the next."""

    def __init__(
        self, projected: ProjectedMotion, title: str, faults: Sequence[StreamFault], settings: OverlaySettings
    ):
        """Take what captions say. `title`: one line beside the time. `faults`: shown while they last."""
        self._projected, self._settings = projected, settings
        self._angles = angles = angle_labels(projected.motion, settings.angles)
        self._captions, self._layout = Captions(projected, title, faults, settings), LabelLayout()
        self._style = Style(projected.view.camera.width_px, projected.view.camera.height_px)
        self._widths = [self._captions.lettering.width(angles.widest(a)) for a in range(len(angles.names))]
        self._face = FaceFinder(projected) if settings.blur_face else None

    def paint(self, image: Image, video_time: float) -> bool:
        """Draw on one picture, in place; return whether a person is drawn.

        `image`: (height, width, 3), BGR. video_time: s, in the time of the view's video.
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
        projected, style = self._projected, self._style
        if self._settings.bands:
            covariance = projected.covariance_px(moment.after if moment.weight > 0.5 else moment.before)
            for uv, C, kind in zip(pose.uv_px, [] if covariance is None else covariance, pose.provenance, strict=False):
                canvas.ellipse(uv, _SQUARED_95 * C, Stroke(COLOURS[Provenance(int(kind))], style.thin), _FILL)
        draw_skeleton(canvas, pose, projected.bones, projected.names, style)
        if self._settings.points:
            for uv in projected.detected(moment):
                canvas.cross(uv, style.cross, self._captions.crosses)

    def _draw_labels(self, canvas: Canvas, pose: ProjectedPose, moment: Moment) -> None:
        """Draw the angles of the joints that lie in the free part of the picture, each with a line to its joint."""
        lettering, angles, style = self._captions.lettering, self._angles, self._style
        pad = max(lettering.size_px // 4, 2)
        above, below = self._captions.boxes(pose.time)
        free = Box(0, above.bottom, canvas.box.width, below.top - above.bottom)
        middle = float(np.nanmean(pose.uv_px[:, 0])) if np.isfinite(pose.uv_px).any() else 0.0
        labels = []
        for name, joint, width in zip(angles.names, angles.joints, self._widths, strict=True):
            u, v = pose.uv_px[joint].tolist()
            if 0 <= u < free.width and free.top <= v < free.bottom:
                labels.append(Label(name, u, v, width + 2 * pad, lettering.line_height + 2 * pad, u < middle))
        ends = pose.uv_px[np.array(self._projected.bones)]
        avoided = (ends[:, :1] + _ALONG[:, None] * (ends[:, 1:] - ends[:, :1])).reshape(-1, 2)
        for name, box in self._layout.place(labels, free, avoided).items():
            a = angles.names.index(name)
            joint = pose.uv_px[angles.joints[a]]
            end = np.clip(joint, [box.left, box.top], [box.right, box.bottom])
            if not box.left < joint[0] < box.right:
                end[1] = box.top + box.height / 2
            canvas.line(joint, end, Stroke(WHITE, style.thin, BLACK, style.edge))
            canvas.shade(box, BLACK, _LABEL_OPACITY)
            text = angles.text(a, moment)
            colour = _PALE if text.endswith(UNKNOWN) else WHITE
            canvas.stamp(box.left + pad, box.top + pad, lettering.mask(text), colour)
