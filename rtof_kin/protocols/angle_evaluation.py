"""Errors of the joint angles of one motion: against the truth of a recording, or coordinates of OpenSim."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_errors import AngleErrors, angle_differences, error_rows
from rtof_kin.clinical.angles import all_observed, clinical_angles, opensim_angles
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.datasets.public_sets import Movement
from rtof_kin.formats.opensim import read_opensim_table
from rtof_kin.protocols.angle_tables import error_table, published_table, write_angle_tables
from rtof_kin.protocols.tables import Table
from rtof_kin.protocols.validation import clock_shift
from rtof_kin.recording.recording import Recording


@dataclass(frozen=True)
class AngleEvaluation:
    """Errors of the angles of one motion."""

    rows: tuple[AngleErrors, ...]
    tables: tuple[Table, ...]
    first: str
    """The sentence that a reader sees first."""

    def write(self, folder: Path) -> list[Path]:
        """Write the tables, CSV, JSON and page; return the files."""
        return write_angle_tables(folder, self.rows, self.tables, self.first, {})


def against_recording(motion: Motion, recording: Recording, movement: Movement = "other") -> AngleEvaluation:
    """Compare with the truth of a recording, on one clock and with one definition of the angles.

    Raises:
        InvalidInputError: the recording has no truth, or no angle is in both.
    """
    if recording.truth is None:
        raise InvalidInputError(f"recording {recording.name}: has no truth to compare with")
    reference = clinical_angles(all_observed(recording.truth), recording.skeleton)
    found, left_out = angle_differences(clinical_angles(motion), reference, movement, recording.name)
    if not found:
        raise InvalidInputError(f"recording {recording.name}: no angle of its truth is observed in the motion")
    names = [name for name, reason in left_out.items() if "estimate" in reason]
    notes = [f"Not observed in the motion: {', '.join(names)}."] if names else []
    rows = error_rows(found, [movement])
    title = f"Joint angles against the truth of {recording.name}"
    return _evaluation(rows, title, f"{title}: {len(found)} angles, on the recording's own clock.", notes)


def against_opensim(motion: Motion, path: Path, movement: Movement = "other", reach: float = 1.0) -> AngleEvaluation:
    """Compare with OpenSim's coordinates, whose zeros are those of their model; the clocks are aligned.

    Args:
        path: a ``.mot`` or ``.sto``. reach: s, largest difference of the clocks that is searched.

    Raises:
        FileFormatError: no such table. InvalidInputError: no angle is in both.
    """
    try:
        reference, _ = opensim_angles(read_opensim_table(path))
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error
    estimate = clinical_angles(motion)
    clock = clock_shift(estimate, reference, reference.names, reach)
    found, left_out = angle_differences(estimate, reference, movement, path.stem, (), clock["shift_s"])
    if not found:
        raise InvalidInputError(f"{path}: no angle is in it and in the motion at the same time")
    names = [name for name, reason in left_out.items() if not reason.startswith("not in the reference")]
    notes = [f"Left out, as not observed in the motion, fixed in the file, or headings: {', '.join(names)}."]
    rows = error_rows(found, [movement])
    title = f"Joint angles against {path.name}"
    said = f"{clock['shift_s']:+.3f} s were added to its times ({clock['how']})"
    return _evaluation(rows, title, f"{title}: {len(found)} angles; {said}.", notes if names else [])


def _evaluation(rows: tuple[AngleErrors, ...], title: str, first: str, notes: list[str]) -> AngleEvaluation:
    return AngleEvaluation(rows, (error_table(rows, title, notes), published_table(rows)), first)
