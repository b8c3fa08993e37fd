"""What left-out sensors certify, in words, figures and files: see `rtof_kin.reconstruction.certificate`.

``summary.json`` has the facts, from which page and terminal speak; ``certificate.csv`` the errors of every frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from pydantic import BaseModel

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core.checks import some
from rtof_kin.reconstruction.certificate import Certificate, LeftOut
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.document import Cell, Table, number, write_csv

TABLE: Final = "certificate.csv"
SECTION: Final = "certificate"
WORSE, MUCH_WORSE = 1.8, 2.5
"""[1] Certified relative to stated error, all sensors, that warns and fails: 1 and 0 % of the recordings of held-out
people and rigs without a fault have more (benchmarks/results/certificate.md)."""
_RATIO: Final = "error of segments without their sensor, relative to what was stated of it"
_ALONE: Final = "error without its sensor, RMS"


def facts(found: Certificate, skeleton: SkeletonModel) -> dict[str, Any]:
    """Return a certificate as JSON data, angles in degrees, with its sentences."""
    return {
        "sentences": list(sentences(found, skeleton)),
        "start_s": found.start,
        "stop_s": found.stop,
        "error_deg": _degrees(found.error),
        "below_90_deg": _degrees(found.below_90),
        "stated_deg": _degrees(found.expected),
        "ratio": number(found.ratio),
        "sensors": [_sensor(one) for one in found.left_out],
        "points": [
            {"what": one.what, "error_mm": number(1000 * one.rms), "stated_mm": number(1000 * one.expected)}
            for one in found.points
        ],
    }


def _sensor(one: LeftOut) -> dict[str, Any]:
    low, high = one.interval(one.error)
    swing, twist = one.certified
    (rate, own_rate), (force, own_force) = one.rate_rms, one.force_rms
    return {
        "sensor": one.sensor,
        "segment": one.joint,
        "error_deg": _degrees(_length(one.certified)),
        "swing_deg": _degrees(swing),
        "twist_deg": _degrees(twist),
        "below_90_deg": _degrees(one.below(0.9)),
        "stated_deg": _degrees(_length(one.expected)),
        "measured_deg": _degrees(_length(one.measured)),
        "measured_interval_deg": [_degrees(low), _degrees(high)],
        "movement_deg": _degrees(float(np.sqrt(np.nanmean(np.sum(one.movement**2, axis=1))))),
        "drift_deg_per_min": _degrees(60 * one.drift[0]),
        "drift_sd_deg_per_min": _degrees(60 * one.drift[1]),
        "rate_error_deg_s": _degrees(rate),
        "rate_deg_s": _degrees(own_rate),
        "acceleration_error_m_s2": number(force),
        "acceleration_m_s2": number(own_force),
        "moves": one.moves,
        "mounting_found_from_this_motion": one.found,
    }


def _length(parts: Any) -> float:
    return float(np.linalg.norm(parts))


def _degrees(radians: float) -> float | None:
    return number(np.degrees(radians), 4)


def sentences(found: Certificate, skeleton: SkeletonModel) -> Iterator[str]:
    """Yield what is certified, and what is not."""
    if found.reason:
        yield f"nothing is certified: {found.reason}"
        return
    stated = f"; its own stated error was {_angle(found.expected)}" if math.isfinite(found.expected) else ""
    yield (
        f"in this recording a segment without a sensor is predicted to {_angle(found.error)} "
        f"(90 % of the time below {_angle(found.below_90)}){stated}"
    )
    if found.ratio > WORSE:
        yield f"errors are {found.ratio:.1f} times what is stated: this recording is worse than usual"
    yield "a segment with its sensor is not expected to be worse than without it; how much better is not certified"
    never = [joint for joint, _ in skeleton.sensors.values() if found.of(joint) is None]
    for joint in never:
        near = found.neighbours(joint, skeleton)
        names, worst = some([one.joint for one in near], 3), max(_length(one.certified) for one in near)
        yield f"{joint} had no sensor: nothing measured it; the nearest, {names}, are predicted to {_angle(worst)}"
    if still := [one.joint for one in found.left_out if not one.moves]:
        yield f"{some(still, 4)} hardly moved: posture is certified there, not movement"
    if estimated := [one.joint for one in found.left_out if one.found]:
        what = "all segments" if len(estimated) == len(found.left_out) else some(estimated, 4)
        yield f"how the sensors sit on {what} was found from this motion: constant errors are not certified there"


def _angle(radians: float) -> str:
    degrees = math.degrees(radians)
    return f"{degrees:.1f} deg" if degrees < 10 else f"{degrees:.0f} deg"


def results(found: Certificate, skeleton: SkeletonModel) -> Iterator[AuditResult]:
    """Yield the certificate as results of the audit."""
    said = list(sentences(found, skeleton))
    if found.reason:
        yield AuditResult.not_checked(SECTION, "sensors", found.reason)
        return
    worst = max(found.left_out, key=lambda one: _length(one.measured) / max(_length(one.expected), 1e-9))
    if math.isnan(found.ratio):
        yield AuditResult.not_checked(SECTION, "sensors", "without a camera no error is stated to compare with", _RATIO)
    else:
        note = f"worst {worst.joint}: mounting, headings, clock or bones may be wrong, or the person is unusual"
        source = "held-out people and rigs, benchmarks/results/certificate.md"
        yield AuditResult(SECTION, _RATIO, "all sensors", found.ratio, "times", WORSE, MUCH_WORSE, source, note)
    for one in found.left_out:
        size = float(np.degrees(_length(one.certified)))
        yield AuditResult(SECTION, _ALONE, one.joint, size, "deg", source="for information")
    for sentence in said:
        yield AuditResult.remark(SECTION, "recording", sentence)


def write_frames(found: Certificate, folder: Path) -> None:
    """Write ``certificate.csv``: a row for every frame and sensor."""

    def rows() -> Iterator[list[Cell]]:
        for one in found.left_out:
            columns = np.degrees(np.hstack([one.error, one.movement, one.stated]))
            for time, values in zip(one.times, columns, strict=True):
                yield [one.sensor, one.joint, f"{time:.4f}", *(f"{v:.3f}" if np.isfinite(v) else "" for v in values)]

    kinds = ("measured", "movement", "stated")
    names = (f"{kind}_{part}_deg" for kind in kinds for part in ("swing", "twist"))
    write_csv(folder / TABLE, Table(("sensor", "segment", "time_s", *names), rows()))


class CertifiedSegment(BaseModel):
    """A left-out sensor in ``summary.json``."""

    segment: str
    error_deg: float | None
    below_90_deg: float | None
    stated_deg: float | None
    movement_deg: float | None
    rate_error_deg_s: float | None


class CertificateSummary(BaseModel):
    """The certificate in ``summary.json``, as far as a page shows it."""

    sentences: tuple[str, ...]
    sensors: tuple[CertifiedSegment, ...]
    error_deg: float | None


def table(found: CertificateSummary, words: AngleTable) -> Table:
    """Return the table of a page."""
    columns = ("segment", "error [deg]", "90 % below [deg]", "stated [deg]", "movement alone [deg]", "rate [deg/s]")
    rows = [
        (plain_words(s.segment, words), s.error_deg, s.below_90_deg, s.stated_deg, s.movement_deg, s.rate_error_deg_s)
        for s in found.sensors
    ]
    return Table(columns, rows, digits=(None, 1, 1, 1, 1, 0), row_headers=True)


_ROW, _LEFT, _WIDE, _MOST = 22, 130, 420, 30.0  # px of the picture; [deg] end of the scale


def picture(found: CertificateSummary, words: AngleTable) -> Markup:
    """Return bars of the certified errors with the stated ones as ticks, SVG."""
    scale, bars = _WIDE / _MOST, Markup()
    for i, one in enumerate(found.sensors):
        y, end = 8 + _ROW * i, scale * min(one.error_deg or 0.0, _MOST)
        name = plain_words(one.segment, words)
        bars += Markup('<text x="{}" y="{}" text-anchor="end">{}</text>').format(_LEFT - 8, y + 11, name)
        bars += Markup('<rect x="{}" y="{}" width="{:.1f}" height="12"/>').format(_LEFT, y, end)
        if one.stated_deg is not None:
            x = _LEFT + scale * min(one.stated_deg, _MOST)
            bars += Markup('<path d="M{:.1f} {}v18"/>').format(x, y - 3)
    bottom = 14 + _ROW * len(found.sensors)
    ticks = Markup().join(
        Markup('<text x="{:.0f}" y="{}" text-anchor="middle">{}</text>').format(_LEFT + scale * d, bottom + 12, d)
        for d in range(0, int(_MOST) + 1, 10)
    )
    label = "Error of each segment without its sensor, degrees; the line is what was stated"
    return Markup('<svg class="certificate" viewBox="0 0 {} {}" role="img" aria-label="{}">{}{}</svg>').format(
        _LEFT + _WIDE + 20, bottom + 20, label, bars, ticks
    )
