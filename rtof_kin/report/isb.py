"""What a study with inertial sensors should state, in the spirit of the recommendations of the
International Society of Biomechanics: filled in where the package knows it, else left to the user.

A. Cereatti, R. Gurchiek, A. Muendermann, S. Fantozzi, F. Horak, S. Delp, K. Aminian: ISB recommendations
on the definition, estimation, and reporting of joint kinematics in human motion analysis applications
using wearable inertial measurement technology. Journal of Biomechanics 173, 112225, 2024.

The items, their grouping and their words are ours and follow the steps from sensor to joint angle that
the title names; they have not been held against the article's own list: who must satisfy a journal reads
the article.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

CITATION = (
    "A. Cereatti et al.: ISB recommendations on the definition, estimation, and reporting of joint "
    "kinematics in human motion analysis applications using wearable inertial measurement technology. "
    "Journal of Biomechanics 173, 112225, 2024, doi 10.1016/j.jbiomech.2024.112225"
)
_METHODS = {
    "lift": "a temporal convolution network on 2D keypoints alone",
    "sf2": "a network on 2D keypoints, corrected frame by frame by the sensors' orientations",
    "rto": "a network on 2D keypoints, then a posterior optimised in fragments; no sensors",
    "rtof": "2D keypoints of one camera and sensors fused in a posterior over the skeleton's "
    "configuration, optimised in overlapping fragments; orientation residuals are weighed apart across "
    "the bone and about it, acceleration at the lever arm",
    "imu": "sensors alone: orientation, acceleration at the lever arm, standing feet, prior and hinges",
}


@dataclass(frozen=True)
class Item:
    """One thing to report."""

    topic: str
    """What it belongs to."""
    name: str
    """What is to be stated."""
    known: str | None = None
    """What the package knows of it; None where only the user can tell."""


def isb_items(inputs: Mapping[str, Any], mode: str, bands: bool, gaps: str) -> tuple[Item, ...]:
    """All items in order.

    Args:
        inputs: as `report.provenance` has them. mode: of the reconstruction. bands: whether angles have bands.
        gaps: what was missing, in words.
    """
    sensors: Sequence[Mapping[str, Any]] = inputs.get("sensors") or []
    return (
        *_who(inputs), *_sensors(sensors), *_orientation(inputs, sensors, mode),
        *_joints(inputs, mode), *_quality(inputs, bands, gaps),
    )  # fmt: skip


def _who(inputs: Mapping[str, Any]) -> tuple[Item, ...]:
    subject, session = inputs.get("subject") or {}, inputs.get("session") or {}
    units = {"height_m": "m tall", "mass_kg": "kg"}
    body = [f"{subject[name]:g} {unit}" for name, unit in units.items() if subject.get(name)]
    body += [subject["sex"]] if subject.get("sex") else []
    return (
        Item("Participants and task", "height, mass, sex", ", ".join(body) or None),
        Item("Participants and task", "age, condition, criteria of inclusion"),
        Item("Participants and task", "task, instructions, speed, footwear", session.get("protocol")),
        Item("Participants and task", "place, floor, ferromagnetic surroundings", session.get("place")),
    )


def _sensors(sensors: Sequence[Mapping[str, Any]]) -> tuple[Item, ...]:
    topic = "Sensors"
    rates = sorted({f"{s['rate_hz']:.4g} Hz" for s in sensors if s.get("rate_hz")})
    places = [_place(sensor) for sensor in sensors]
    largest = [s["largest_specific_force_m_s2"] for s in sensors if s.get("largest_specific_force_m_s2")]
    return (
        Item(topic, "manufacturer, model, firmware; which of accelerometer, gyroscope, magnetometer"),
        Item(topic, "ranges, resolution, noise", None if not largest else
             f"the largest specific force seen was {max(largest):.0f} m/s2; the range itself:"),
        Item(topic, "sampling rate", ", ".join(rates) or None),
        Item(topic, "number and placement", "; ".join(places) or "no sensors were used"),
        Item(topic, "how they were fixed (strap, tape, clothing), by whom"),
        Item(topic, "calibration of the sensors themselves (bias, scale), when"),
    )  # fmt: skip


def _place(sensor: Mapping[str, Any]) -> str:
    segment = sensor.get("segment") or "segment not stated"
    lever = sensor.get("lever_arm_m")
    where = f" at ({', '.join(f'{1000 * v:.0f}' for v in lever)}) mm in its frame" if lever else ""
    return f"{sensor.get('name', '')} on {segment}{where}"


def _orientation(
    inputs: Mapping[str, Any], sensors: Sequence[Mapping[str, Any]], mode: str
) -> tuple[Item, ...]:
    topic = "Orientation and alignment"
    found = inputs.get("calibration")
    heading = "constant headings as given with the recording" if sensors else None
    aligned = "as given with the recording; its procedure:" if sensors else None
    delay = "one clock, as given with the recording; how it was made:" if sensors else None
    if found:
        heading = "estimated from the recording itself, see Calibration"
        aligned = "as given, corrected from the recording itself, see Calibration"
        delay = "delay between video and sensors estimated from the recording itself, see Calibration"
    return (
        Item(topic, "orientation filter, its settings, use of the magnetometer"),
        Item(topic, "heading reference and drift", heading),
        Item(topic, "sensor to segment: static pose, functional movement, manual alignment", aligned),
        Item(topic, "synchronisation, between sensors and with the camera", delay),
        Item(topic, "estimation of the motion", _METHODS.get(mode)),
    )


def _joints(inputs: Mapping[str, Any], mode: str) -> tuple[Item, ...]:
    topic = "Joint kinematics"
    subject = inputs.get("subject") or {}
    hinges = "" if mode in ("lift", "sf2") else "; knees and elbows are hinges within their limits"
    return (
        Item(topic, "body model",
             f"tree of rigid segments, {subject.get('bones', 'bones not stated')}{hinges}"),
        Item(topic, "segment frames",
             "x forward, y up, z right in the anatomical standing posture (the ISB's axes)"),
        Item(topic, "joint coordinate systems and sequences",
             "Z-X-Y for spine, hip, knee, ankle, elbow, wrist (Grood and Suntay); shoulder Y-X-Y (Wu "
             "2005) and X-Z-Y; pelvis Y-X-Z (Baker 2001); left mirrored; signs in angles.json"),
        Item(topic, "zero of the angles",
             "anatomical standing posture of the model; nobody's own posture is subtracted"),
        Item(topic, "filters", "none on angles; velocities from angles low-passed at 6 Hz"),
    )  # fmt: skip


def _quality(inputs: Mapping[str, Any], bands: bool, gaps: str) -> tuple[Item, ...]:
    topic = "Quality"
    stated = "95 % bands of the posterior, inflated on other subjects" if bands else None
    return (
        Item(topic, "missing data", gaps),
        Item(topic, "uncertainty of the angles", stated),
        Item(topic, "validation against a reference for this task and population"),
        Item(topic, "repeatability between trials, days and operators"),
        Item(topic, "software and version", inputs.get("software")),
    )
