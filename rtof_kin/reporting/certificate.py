"""What left-out sensors certify, in words, figures and files: see `rtof_kin.reconstruction.certificate`.

``summary.json`` has the facts, from which page and terminal speak; ``certificate.csv`` the errors of every frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, Field, NonNegativeFloat

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import CERTIFICATE, AuditResult
from rtof_kin.reporting.document import Cell, Table, number, sentence, write_csv

if TYPE_CHECKING:
    from rtof_kin.reconstruction.certificate import Certificate, LeftOut

TABLE: Final = "certificate.csv"
WORSE, MUCH_WORSE = 1.8, 2.5
"""[1] Certified relative to stated error, all sensors, that warns and fails: at most 1.6 in 40 recordings of held-out
people and rigs without a fault (benchmarks/results/certificate.md)."""
UNSTATED: Final = "without a camera no error is stated to compare a left-out sensor with: film it too"
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
        "movement_deg": _degrees(_length(one.moved)),
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
    yield f"tested from {found.start:.1f} to {found.stop:.1f} s"
    for joint, why in found.untested:
        yield f"{joint} was not tested: {why}"
    yield from limits(found, skeleton)
    limb, alike = found.limb(skeleton), dict[tuple[str, ...], list[str]]()
    for joint, _ in skeleton.sensors.values():
        near = tuple(one.joint for one in found.neighbours(joint, skeleton))
        if joint not in near and joint not in dict(found.untested) and (not limb or joint in limb):
            alike.setdefault(near, []).append(joint)
    for near, joints in alike.items():
        worst = max(_length(one.certified) for one in found.left_out if one.joint in near)
        names, nearest = ", ".join(joints), ", ".join(near)
        yield f"no sensor measured {names}: the nearest ({nearest}) can be predicted to {_angle(worst)}"
    still = [one.joint for one in found.left_out if not one.moves]
    if 0 < len(still) < len(found.left_out):
        yield f"{', '.join(still)} hardly moved: posture is certified there, not movement"
    if estimated := [one.joint for one in found.left_out if one.found]:
        what = "all segments" if len(estimated) == len(found.left_out) else ", ".join(estimated)
        yield f"how the sensors sit on {what} was found from this motion: constant errors are not certified there"


def limits(found: Certificate, skeleton: SkeletonModel) -> Iterator[str]:
    """Yield why a certificate proves no angles of the whole body, or no movement."""
    if found.left_out and found.limb(skeleton):
        yield "all sensors that were tested are on one limb: nothing is certified of the other segments"
    if found.left_out and not any(one.moves for one in found.left_out):
        yield "no sensor moved: posture is certified, not movement"


def _angle(radians: float) -> str:
    degrees = math.degrees(radians)
    return f"{degrees:.1f} deg" if degrees < 10 else f"{degrees:.0f} deg"


def results(found: Certificate, skeleton: SkeletonModel) -> Iterator[AuditResult]:
    """Yield the certificate as results of the audit."""
    if found.reason:
        yield AuditResult.not_checked(CERTIFICATE, "sensors", found.reason)
        return
    if math.isnan(found.ratio):
        yield AuditResult.not_checked(CERTIFICATE, "sensors", UNSTATED, _RATIO)
    else:
        of = {one.joint: _length(one.certified) / max(_length(one.expected), 1e-9) for one in found.left_out}
        worst = max(of, key=lambda joint: np.nan_to_num(of[joint]))
        note = f"worst {worst}: mounting, headings, clock or bones may be wrong, or the person is unusual"
        source = "held-out people and rigs, benchmarks/results/certificate.md"
        yield AuditResult(CERTIFICATE, _RATIO, "all sensors", found.ratio, "times", WORSE, MUCH_WORSE, source, note)
    weak = tuple(limits(found, skeleton))
    for said in sentences(found, skeleton):
        yield AuditResult.remark(CERTIFICATE, "recording", said, weak=said in weak)
    for one in found.left_out:
        size = float(np.degrees(_length(one.certified)))
        yield AuditResult(CERTIFICATE, _ALONE, one.joint, size, "deg", source="for information")


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


_Size = Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] | None


class CertifiedSegment(BaseModel):
    """A left-out sensor in ``summary.json``."""

    segment: str
    error_deg: _Size
    below_90_deg: _Size
    stated_deg: _Size
    movement_deg: _Size
    rate_error_deg_s: _Size


class CertificateSummary(BaseModel):
    """The certificate in ``summary.json``, as far as a page shows it."""

    sentences: Annotated[tuple[str, ...], Field(min_length=1)]
    sensors: tuple[CertifiedSegment, ...]
    error_deg: _Size


def section(found: CertificateSummary, words: AngleTable) -> dict[str, Any]:
    """Return what a page shows: sentences in plain words, table and picture."""
    said = [sentence(plain_words(one, words)) for one in found.sentences]
    return {"sentences": said, "table": table(found, words), "bars": bars(found, words)}


def table(found: CertificateSummary, words: AngleTable) -> Table:
    """Return the table of a page."""
    columns = ("segment", "error [deg]", "90 % below [deg]", "stated [deg]", "movement [deg]", "rate error [deg/s]")
    rows = [
        (plain_words(s.segment, words), s.error_deg, s.below_90_deg, s.stated_deg, s.movement_deg, s.rate_error_deg_s)
        for s in found.sensors
    ]
    return Table(columns, rows, digits=(None, 1, 1, 1, 1, 0), row_headers=True)


def bars(found: CertificateSummary, words: AngleTable) -> list[tuple[str, float | None, float | None]]:
    """Return the segments of the picture with their certified and stated errors, deg."""
    return [(plain_words(one.segment, words), one.error_deg, one.stated_deg) for one in found.sensors]
