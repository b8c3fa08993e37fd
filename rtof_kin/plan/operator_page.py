"""Page for the operator: one A4 sheet that opens and prints offline."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from typing import Final

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.plan.movements import MovementInfo
from rtof_kin.plan.placing import Framing
from rtof_kin.reporting.html import bullets, fill, source_hash

MOST_LINES: Final = 29
"""Lines of all texts together that fit on the sheet beside the drawing."""
_LINE: Final = 100  # characters, of a wide font

_STYLE: Final = """
@page { size: A4; margin: 10mm }
body { font: 9pt/1.28 system-ui, sans-serif; color: #111; max-width: 190mm; margin: 0 auto }
h1 { font-size: 15pt; margin: 0 0 1mm } h2 { font-size: 11pt; margin: 2mm 0 .7mm }
p, ol, ul { margin: 0 0 1.5mm } ol, ul { padding-left: 6mm }
img { width: 100%; max-height: 92mm; object-fit: contain; display: block }
.person { border-left: 1.2mm solid #2e8b57; padding: 1mm 3mm }
.doubts { border: .4mm solid #c0392b; padding: 1.5mm 3mm; break-inside: avoid } .doubts h2 { margin-top: 0 }
footer { font-size: 7pt; color: #555; margin-top: 2mm }
"""

_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src '{{style_hash}}'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{title}}</title><style>{{style}}</style></head><body>
<h1>{{title}}</h1>
{{doubts}}
<img alt="Set-up to scale: floor with the camera, sensors on the body, picture of the camera"
 src="{{drawing}}">
<h2>What to do</h2>
<ol>{{steps}}</ol>
<h2>What to say to the person</h2>
<p class="person">{{person}}</p>
<h2>What not to do</h2>
{{never}}
<footer>{{foot}}</footer>
</body></html>
"""

_NEVER: Final = (
    "Do not move, zoom or turn the camera, and do not touch sensors or straps, before the recording is over.",
    "Nobody else in the picture; no loose clothes over sensors; no mirror behind the person.",
    "Do not switch a sensor on or off between the first still seconds and the end.",
)


def operator_page(
    title: str, movement: MovementInfo, steps: Sequence[str], drawing_svg: str, doubts: Sequence[str]
) -> str:
    """Return the sheet as HTML in one file, without network access.

    Args:
        steps: what the operator does, in order, e.g. of `operator_steps`.
        drawing_svg: text of the SVG of `draw_setup`.
        doubts: what is wrong or unsure about this set-up, with its remedy; shown first.

    Raises:
        InvalidInputError: more text than fits on the sheet.
    """
    person = movement.instructions[:1].upper() + movement.instructions[1:] + "."
    lines = sum(1 + len(text) // _LINE for text in (title, person, *steps, *doubts))
    if lines > MOST_LINES:
        raise InvalidInputError(
            f"operator's page: {lines} lines do not fit on one sheet; shorten steps and doubts to "
            f"{MOST_LINES} lines of {_LINE} characters together with the title and the words to the person"
        )
    drawing = base64.b64encode(drawing_svg.encode()).decode()
    warnings = f'<div class="doubts"><h2>Before you begin</h2>{bullets(doubts)}</div>' if doubts else ""
    parts = {
        "title": escape(title),
        "style": _STYLE,
        "style_hash": source_hash(_STYLE),
        "doubts": warnings,
        "drawing": f"data:image/svg+xml;base64,{drawing}",
        "person": escape(person),
        "steps": "\n".join(f"<li>{escape(step)}</li>" for step in steps),
        "never": bullets(_NEVER),
        "foot": escape(f"The drawn movement: {movement.description} {movement.acknowledgement}"),
    }
    return fill(_PAGE, parts)


def operator_steps(
    movement: MovementInfo, place: Framing, sensors: dict[str, str], repetitions: int, seconds: float
) -> list[str]:
    """Return what the operator does, in order.

    Args:
        sensors: of `sensor_places`, maybe none. seconds: length of the movement, s.
    """
    tilt = f"tilted {abs(place.tilt_deg):.0f}° {'downwards' if place.tilt_deg > 0 else 'upwards'}"
    tilt = "pointing level" if abs(place.tilt_deg) < 1 else tilt
    steps = [
        f"Camera on a tripod: lens {place.height:.2f} m over the floor, {place.distance:.2f} m from the "
        f"cross in the drawing, {place.side}, {tilt}, its picture's horizon level.",
        f"Lens: horizontal field of view {place.field_deg[0]:.0f}°; lock zoom, focus and exposure; switch "
        "stabilisation off.",
        f"Check in the picture: {place.view}.",
    ]
    if sensors:
        names = "; ".join(f"{name}: {where}" for name, where in sensors.items())
        steps += [
            f"Strap on {len(sensors)} sensor(s), tight, on skin or tight clothes. {names}.",
            "Switch all sensors on together, then start the video; the person keeps still for 2 s.",
        ]
    else:
        steps.append("Start the video; the person keeps still for 2 s.")
    count = "time" if repetitions == 1 else "times"
    steps += [
        f"The person does the movement {repetitions} {count} ({movement.repetition}), {seconds:.0f} s in all "
        "if it is done as in the prediction.",
        "The person keeps still for 2 s; then stop the video and the sensors.",
        "Head, hands and feet must be visible from the first still second to the last.",
    ]
    return steps
