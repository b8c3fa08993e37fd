"""Page for the operator: one A4 sheet that opens and prints offline."""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.text import write_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.movements import MovementInfo
from rtof_kin.plan.protocol import Framing, direction, framing, sensor_places
from rtof_kin.plan.setup import Setup
from rtof_kin.reporting.document import sentence
from rtof_kin.reporting.html import render

INSTRUCTIONS: Final = "instructions.html"
BODY, LEFT, RIGHT, CAMERA, SENSOR = "#555555", "#c0392b", "#0072b2", "#2e8b57", "#e69f00"
_LABEL_WIDTH: Final = 26
_LABEL_STEP: Final = 0.275  #: [m] on the page between two labels of sensors


def write_instructions(
    setup: Setup, movement: MovementInfo, repetitions: int, further: Sequence[str], doubts: Sequence[str], folder: Path
) -> None:
    """Write the sheet and its drawing of the set-up into a folder, with steps after the usual ones."""
    drawing = folder / "setup.svg"
    framed = draw_setup(setup.poses, setup.skeleton, setup.camera, setup.sensors, drawing)
    seconds = float(setup.poses.times[-1] - setup.poses.times[0])
    places = sensor_places(setup.skeleton, setup.sensors)
    who = f" of {setup.subject.subject}" if setup.subject is not None else ""
    title = f"Recording{who}: {movement.name.replace('_', ' ')}"
    svg, how = drawing.read_text(encoding="utf-8"), (repetitions, seconds)
    write_text(folder / INSTRUCTIONS, operator_page(title, movement, how, framed, places, svg, doubts, further))


def draw_setup(
    poses: PoseSequence, skeleton: SkeletonModel, camera: Camera, sensors: Sequence[str], path: Path
) -> Framing:
    """Draw a set-up to scale: plan of the floor, front and back of the body with sensors, the picture.

    The movement is on the floor z = 0; an .svg file is replaced. Returns the numbers written in the drawing.
    `UnknownNameError`: a sensor that the skeleton does not have.
    """
    places = sensor_places(skeleton, sensors)
    place = framing(poses, skeleton, camera)
    figure = Figure(figsize=(12.4, 6.0), layout="constrained")
    figure.set_canvas(FigureCanvasAgg(figure))  # no global pyplot state
    grid = figure.add_gridspec(2, 3, height_ratios=(1.9, 1), width_ratios=(1.0, 1.2, 1.2))
    _floor(figure.add_subplot(grid[0, 0]), poses, camera, place)
    front = {name: text for name, text in places.items() if skeleton.sensors[name][0] != skeleton.names[0]}
    back = {name: text for name, text in places.items() if name not in front}
    _body(figure.add_subplot(grid[:, 1]), skeleton, front, -1.0, "front")
    _body(figure.add_subplot(grid[:, 2]), skeleton, back, 1.0, "back")
    _picture(figure.add_subplot(grid[1, 0]), poses, skeleton, camera, place)
    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "rtof_kin"}
    with matplotlib.rc_context(settings), new_file(path, overwrite=True) as whole:
        figure.savefig(whole, format="svg", metadata={"Date": None})
    return place


def _floor(ax: Any, poses: PoseSequence, camera: Camera, place: Framing) -> None:
    """Draw the plan with the path, the person's facing and the camera's field of view."""
    path, start = poses.p_world_joint[:, 0, :2], poses.p_world_joint[0, 0, :2]
    at, axis = camera.center_world[:2], camera.R_camera_world[2, :2]
    reach = place.distance + np.linalg.norm(path - place.middle, axis=1).max() + 0.5
    half = np.radians(place.field_deg[0] / 2)
    bearing = np.arctan2(axis[1], axis[0])
    edges = [at + reach * np.array([np.cos(bearing + s * half), np.sin(bearing + s * half)]) for s in (-1, 1)]
    ax.add_patch(Polygon([at, *edges], facecolor=CAMERA, alpha=0.13, edgecolor=CAMERA))
    if np.ptp(path, axis=0).max() > 0.3:
        ax.plot(*path.T, color=BODY, lw=1.2)
    facing = poses.R_world_bone[0, 0, :2, 0] * 0.55
    ax.add_patch(Circle(start.tolist(), 0.22, facecolor="#dddddd", edgecolor=BODY))
    ax.annotate("", start + facing, start, arrowprops={"arrowstyle": "-|>", "color": BODY, "lw": 1.6}, zorder=4)
    ax.plot(*at, "s", color=CAMERA, ms=9)
    ax.plot(*np.stack([at, place.middle]).T, "--", color=CAMERA, lw=1)
    ax.plot(*place.middle, "+", color=CAMERA, ms=9)
    style: Any = {"textcoords": "offset points", "color": CAMERA}
    lens = f"lens {place.height:.2f} m high,\n{place.tilt}"
    ax.annotate(lens, at, (0, -8), ha="center", va="top", fontsize=7.5, **style)
    ax.annotate(f"{place.distance:.2f} m", (at + place.middle) / 2, (4, 4), fontsize=8, **style)
    ax.set_title(
        f"Camera {place.distance:.2f} m from the cross,\n{direction(place.angle_deg)},\n"
        f"field of view {place.field_deg[0]:.0f}°; arrow: facing at the start",
        fontsize=8.5,
    )
    points = np.stack([*path, at])
    low, high = points.min(axis=0) - 1.2, points.max(axis=0) + 1.2
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m", anchor="N")
    for axis_ in (ax.xaxis, ax.yaxis):
        axis_.set_major_locator(matplotlib.ticker.MultipleLocator(1.0))
    ax.grid(color="#dddddd", lw=0.6)
    ax.set_axisbelow(True)


def _body(ax: Any, skeleton: SkeletonModel, places: dict[str, str], sign: float, view: str) -> None:
    """Draw the body from the front (sign -1: its left is on the right) or the back, with sensors."""
    p, R = skeleton.forward_kinematics(skeleton.n_pose()[None])
    floor = skeleton.landmark_positions(p, R)[0, :, 2].min()

    def flat(points: Array) -> Array:
        return np.stack([(-sign) * points[..., 1], points[..., 2] - floor], axis=-1)

    _sticks(ax, flat(p[0]), skeleton, 3.5)
    head = flat(p[0, skeleton.index("Head")[0]] + [0, 0, 0.08])
    ax.add_patch(Circle(head.tolist(), 0.10, facecolor="white", edgecolor=BODY, lw=1.5))
    spots = {}
    for name in places:
        joint, offset = skeleton.sensors[name]
        (j,) = skeleton.index(joint)
        spots[name] = flat(p[0, j] + R[0, j] @ offset)
    style: Any = {"arrowprops": {"arrowstyle": "-", "color": SENSOR, "lw": 0.8}, "in_layout": False}
    for side in (-1, 1):
        align = "left" if side > 0 else "right"
        own = sorted((n for n in spots if (spots[n][0] >= 0) == (side > 0)), key=lambda n: -spots[n][1])
        heights = _spread([float(spots[name][1]) for name in own])
        for name, height in zip(own, heights, strict=True):
            text = "\n".join([name, *textwrap.wrap(places[name], _LABEL_WIDTH)])
            ax.annotate(text, spots[name], (side * 0.36, height), va="center", ha=align, fontsize=7.5, **style)
        if own:
            ax.plot(*np.stack([spots[n] for n in own]).T, "s", color=SENSOR, ms=6, mec="k", mew=0.5)
    ax.text(-0.26, -0.08, "L" if sign > 0 else "R", color=LEFT if sign > 0 else RIGHT, fontsize=9)
    ax.text(0.22, -0.08, "R" if sign > 0 else "L", color=RIGHT if sign > 0 else LEFT, fontsize=9)
    ax.set(xlim=(-0.98, 0.98), ylim=(-0.12, 1.85), aspect="equal", anchor="N")
    title = f"Sensors, {view} of the body" if places else f"{view} of the body: no sensor"
    ax.set_title(title.capitalize(), fontsize=9)
    ax.set_axis_off()


def _spread(heights: Sequence[float]) -> Array:
    """Return heights, highest first, moved apart by `_LABEL_STEP` at least, on the page."""
    out = np.array(heights)
    for k in range(1, len(out)):
        out[k] = min(out[k], out[k - 1] - _LABEL_STEP)
    low = _LABEL_STEP / 2
    for k in reversed(range(len(out))):
        out[k] = max(out[k], low)
        low = out[k] + _LABEL_STEP
    return out


def _picture(ax: Any, poses: PoseSequence, skeleton: SkeletonModel, camera: Camera, place: Framing) -> None:
    """Draw the picture of the camera at the start and where the body is nearest to its borders."""
    size = np.array([camera.width_px, camera.height_px])
    points = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    uv = camera.project(points)
    least = np.nan_to_num(np.minimum(uv, size - uv).min(axis=(1, 2)), nan=-np.inf)
    ax.add_patch(Rectangle((0, 0), *size, facecolor="#f4f8f5", edgecolor=CAMERA, lw=2))
    edge = 0.05 * size[1]
    ax.add_patch(Rectangle((edge, edge), *(size - 2 * edge), fill=False, edgecolor=CAMERA, ls=":", lw=0.8))
    joints = camera.project(poses.p_world_joint)
    for frame, width in ((int(np.argmin(least)), 0.8), (0, 1.8)):
        _sticks(ax, joints[frame], skeleton, width)
    ax.set(xlim=(-0.02 * size[0], 1.02 * size[0]), ylim=(1.03 * size[1], -0.03 * size[1]), aspect="equal")
    text = "\n".join(textwrap.wrap(f"The camera's picture: {place.view}.", 58))
    ax.set_title(f"{text}\nThick: at the start; thin: nearest to the border", fontsize=8)
    ax.set_axis_off()


def _sticks(ax: Any, points: Array, skeleton: SkeletonModel, width: float) -> None:
    """Draw the bones between joints (J, 2)."""
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            name = skeleton.names[j]
            colour = LEFT if name.startswith("Left") else RIGHT if name.startswith("Right") else BODY
            ax.plot(*points[[parent, j]].T, color=colour, lw=width, solid_capstyle="round", alpha=0.75, zorder=1)


def operator_page(
    title: str,
    movement: MovementInfo,
    how: tuple[int, float],
    place: Framing,
    sensors: dict[str, str],
    drawing_svg: str,
    doubts: Sequence[str] = (),
    further: Sequence[str] = (),
) -> str:
    """Return the sheet as HTML in one file, without network access.

    Args:
        how: repetitions of the movement, and how long they take, s. sensors: name -> place, maybe none.
        doubts: what is wrong or unsure about this set-up, with its remedy; shown first.
        further: steps after the usual ones.
    """
    drawing = base64.b64encode(drawing_svg.encode()).decode()
    return render(
        "instructions.html",
        styles=("instructions.css",),
        title=title,
        doubts=doubts,
        images={"setup": f"data:image/svg+xml;base64,{drawing}"},
        place=place,
        direction=direction(place.angle_deg),
        sensors=sensors,
        repetitions=how[0],
        seconds=how[1],
        further=further,
        movement=movement,
        person=sentence(movement.instructions),
    )
