"""Visits in folders: ``DIR/VISIT/TRIAL/motion.h5``, and what ``DIR/follow.toml`` says about them.

A folder in DIR with one output of reconstruct or run, or more, at any depth, is a visit, and each output a
trial. Visits are ordered by their day: that of ``follow.toml``, else the one in the name of the folder
(2026-01-31), else that of the recordings' sessions; by name if one has no day. ``follow.toml`` may have

::

    baseline = "before"          # name of the visit that the others are compared with; default: the first
    by = "cycle"                 # or repetition, range; default: chosen from the data, and said
    repetitions = "squat"        # kind
    measures = ["gait_speed"]    # to follow; fewer are tested more sharply

    [[visit]]                    # in order; folders that are not listed are left out
    folder = "2026-01-31"
    name = "before"              # default: the folder
    date = "2026-01-31"

    [better]                     # direction that is better: up, down, or (towards) zero
    right_knee_flexion_range = "up"
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Strict

from rtof_kin.body.motion_file import EARLIER, MOTION, MotionReader, file_in
from rtof_kin.clinical.visits import Better, Movement, Setup, Trial, Visit, trial
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.input_table import InputTable, Names
from rtof_kin.formats.measurements_file import MeasurementsReader, measurements_path
from rtof_kin.reporting.audit_results import Grade, headline
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary

PLAN: Final = "follow.toml"
_DAY: Final = re.compile(r"(?<!\d)(\d{4})[-_.]?(\d{2})[-_.]?(\d{2})(?!\d)")
_OF_RUN: Final = "motion"  # folder of the motion in the output of `run`
_SETTINGS: Final = ("space", "energy", "lifter", "lift_with_sensors", "calibrate")
_STEADY: Final = 0.8  # length of the mean of unit vectors along the heading, from which on it has a mean
Progress = Callable[[int, int], None]


class VisitTable(InputTable):
    """A table ``[[visit]]``."""

    folder: str
    name: str | None = None
    date: Any = None
    """A day of TOML, or its text."""

    @property
    def day(self) -> date:
        """The date."""
        if isinstance(self.date, date):
            return self.date.date() if isinstance(self.date, datetime) else self.date
        try:
            return date.fromisoformat(str(self.date))
        except ValueError as error:
            raise self.error("date", "not a day; write year, month and day, as 2026-01-31") from error


class Plan(InputTable):
    """The file ``follow.toml``."""

    baseline: str = ""
    by: Movement | None = None
    repetitions: str = ""
    measures: Names = ()
    visit: Annotated[tuple[VisitTable, ...], Strict(False)] = ()
    better: dict[str, Better] = {}

    @property
    def names(self) -> dict[str, str]:
        """Folder of each visit that is listed -> its name."""
        return {one.folder: one.folder if one.name is None else one.name for one in self.visit}

    @property
    def days(self) -> dict[str, date]:
        """Folder -> day."""
        return {one.folder: one.day for one in self.visit if one.date is not None}


@dataclass(frozen=True)
class FoundVisits:
    """Visits in a folder."""

    visits: tuple[Visit, ...]
    baseline: int
    plan: Plan
    notes: tuple[str, ...]  #: What to be careful about: their order, and folders that are left out


def read_plan(folder: str | Path) -> Plan:
    """Read ``follow.toml``; without one nothing is declared. `FileFormatError`: a field is of the wrong kind;
    `UnknownNameError`: there is no such field or choice.
    """
    path = Path(folder) / PLAN
    if not path.exists():
        return Plan()
    plan = Plan.read(path)
    _ = plan.days  # raises if one is wrong
    return plan


def read_visits(folder: str | Path | Sequence[str | Path], progress: Progress | None = None) -> FoundVisits:
    """Read all visits, and analyse their motions. `FileFormatError`: fewer than two visits, one without a motion, or a
    damaged file.

    Args:
        folder: that has a folder for each visit, or the folders of the visits.
        progress: called with the number of trials done, and of all.
    """
    if isinstance(folder, str | Path):
        folder = Path(folder)
        plan, folders = read_plan(folder), _folders(folder)
    else:
        plan, folders, folder = Plan(), {Path(one).resolve().name: Path(one) for one in folder}, Path()
    motions = {name: sorted([*visit.rglob(MOTION), *visit.rglob(EARLIER)]) for name, visit in folders.items()}
    found = {name: own for name, own in motions.items() if own}
    wanted = tuple(plan.names or found)
    if missing := [name for name in wanted if name not in found]:
        raise FileFormatError(
            folder / PLAN, f"visit {missing[0]!r} has no {MOTION}; there are {', '.join(found) or 'none'}"
        )
    if len(wanted) < 2:
        raise FileFormatError(
            folder,
            f"has {len(wanted)} visit(s); give a folder that has a folder with outputs of "
            "reconstruct for each of two visits or more",
        )
    total, done, visits, notes = sum(len(found[name]) for name in wanted), 0, list[Visit](), list[str]()
    for name in wanted:
        trials = []
        for path in found[name]:
            trials.append(_trial(path, folders[name]))
            done += 1
            if progress is not None:
                progress(done, total)
        visits.append(Visit(plan.names.get(name, name), tuple(trials), _day(name, trials, plan, notes)))
    if unlisted := [name for name in found if name not in wanted]:
        notes.append(f"Left out, as {PLAN} does not list them: {', '.join(unlisted)}")
    if not plan.visit:
        visits = _ordered(visits, notes)
    baseline = 0
    if plan.baseline:
        names, first = [visit.name for visit in visits], plan.names.get(plan.baseline, plan.baseline)
        baseline = indices_of(f"visit in {folder / PLAN}, baseline", [first], names)[0]
    return FoundVisits(tuple(visits), baseline, plan, tuple(notes))


def _folders(folder: Path) -> dict[str, Path]:
    """Name of each visit -> its folder."""
    if not folder.is_dir():
        raise FileFormatError(folder, "there is no such folder")
    if file_in(folder):
        raise FileFormatError(folder, "is one motion; give the folder that has a folder for each visit")
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "."}


def _trial(path: Path, visit: Path) -> Trial:
    output = path.parent.parent if path.parent.name == _OF_RUN and path.parent != visit else path.parent
    name = output.relative_to(visit).as_posix()
    summary = read_summary(path.parent / SUMMARY) if (path.parent / SUMMARY).is_file() else None
    with MotionReader(path) as reader:
        found = trial(visit.name if name == "." else name, reader)
        mode = reader.mode
    return replace(found, setup=setup_of(summary, mode, _view(found, measurements_path(path.parent))))


def setup_of(summary: Summary | None, mode: str = "", view: float = math.nan) -> Setup:
    """Return how a motion was recorded and reconstructed; view: of `Setup`, rad."""
    if summary is None:
        return Setup(mode=mode, view=view)
    inputs, session, settings, found = summary.inputs, summary.session, summary.settings or {}, summary.certificate
    camera: dict[str, Any] = inputs.get("camera") or {}
    segments = (sensor.get("segment") for sensor in inputs.get("sensors") or [])
    overall = None if summary.results is None else headline(summary.results)
    sizes = [camera.get(name) for name in ("height_m", "distance_m")]
    height, distance = (math.nan if size is None else float(size) for size in sizes)
    return Setup(
        subject=session.subject,
        date=session.date,
        protocol=session.protocol,
        mode=summary.mode or mode,
        software=str(inputs.get("software") or ""),
        model=", ".join(f"{name} {settings[name]}" for name in _SETTINGS if name in settings),
        sensors=tuple(sorted(str(segment) for segment in segments if segment)),
        points=tuple(camera.get("landmarks") or ()),
        cameras=int(inputs.get("cameras") or 0),
        camera_height=height,
        camera_distance=distance,
        view=view,
        certified=math.nan if found is None or found.error_deg is None else found.error_deg,
        failed=overall.text if overall is not None and overall.grade is Grade.FAIL else "",
        person=summary.person,
        calibrated=bool(settings.get("calibrate")),
    )


def _view(found: Trial, path: Path) -> float:
    """Mean heading from the direction of the first camera, rad; NaN where unknown."""
    heading = found.analysis.paths.heading
    mean = np.mean(np.exp(1j * heading[np.isfinite(heading)])) if np.isfinite(heading).any() else 0.0
    if abs(mean) < _STEADY or not path.is_file():
        return float("nan")
    with MeasurementsReader(path) as reader:
        views = reader.read(0, 1).views
    if not views:
        return float("nan")
    ahead = views[0].camera.R_camera_world[2]
    return float(np.angle(mean * np.exp(-1j * np.arctan2(ahead[1], ahead[0]))))


def _day(name: str, trials: Sequence[Trial], plan: Plan, notes: list[str]) -> date | None:
    """Day of a visit."""
    recorded = sorted({one.setup.date for one in trials} - {""})
    day = plan.days.get(name)
    if day is None and (match := _DAY.search(name)) is not None:
        try:
            day = date(*map(int, match.groups()))
        except ValueError:
            day = None
    if day is None:
        return date.fromisoformat(recorded[0]) if recorded else None
    if other := [text for text in recorded if text != day.isoformat()]:
        notes.append(f"{name} is of {day}, but its recordings say {', '.join(other)}")
    return day


def _ordered(visits: list[Visit], notes: list[str]) -> list[Visit]:
    if any(visit.day is None for visit in visits):
        notes.append(f"Not all visits have a day: they are in the order of their names ({PLAN} may list them)")
        return sorted(visits, key=lambda visit: _natural(visit.name))
    return sorted(visits, key=lambda visit: (visit.day or date.min, _natural(visit.name)))


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which visit 10 comes after visit 2."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
