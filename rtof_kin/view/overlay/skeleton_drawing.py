"""Drawing of a person: bones and joints by provenance, 95 % ellipses, detected points.

The colour of a bone is that of its child's provenance; pink is bridged. What was not observed is not drawn.
Bones of the right side have a white edge, all others a black one.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.data.poses import Provenance
from rtof_kin.view.overlay.canvas import Canvas, Stroke
from rtof_kin.view.overlay.projected_motion import ProjectedPose
from rtof_kin.view.provenance_colours import COLOURS, Rgb

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
