"""Tables of a validation: errors of angles, published values, every take with its clock or its failure."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rtof_kin.clinical.angle_errors import AngleDifferences, AngleErrors, angle_errors, error_rows
from rtof_kin.core.files.text import write_text
from rtof_kin.datasets.public_sets import MOVEMENTS
from rtof_kin.protocols.angle_tables import error_table, plain_rows, published_table, write_angle_tables
from rtof_kin.protocols.tables import Table
from rtof_kin.protocols.validation import HARDLY, SETS, Validation, ValidationProtocol

TAKES: Final = "angle_errors_by_take.csv"
_NEEDS_SENSORS: Final = ("sf2", "rtof", "imu")


def first_line(protocol: ValidationProtocol, found: Validation) -> str:
    """Return the sentence that a reader sees first: how many takes were measured, and which failed."""
    done, failed = found.outcome.done, found.outcome.failed
    mode = protocol.own_mode
    text = f"{SETS[protocol.dataset].title}, mode {mode}: {len(done)} of {len(found.takes)} takes measured"
    if failed:
        named = "; ".join(f"{key}: {reason}" for key, reason in list(failed.items())[:3])
        more = f"; and {len(failed) - 3} more, see the table of takes" if len(failed) > 3 else ""
        text += f", {len(failed)} FAILED and are in no error below ({named}{more})"
    circular = sum(bool(facts["of_sensors"]) for facts in done.values())
    if circular and mode in _NEEDS_SENSORS:
        text += (
            f". NOT ACCURACY: the reference of {circular} takes was computed from the same sensors that "
            f"this mode uses; use --mode rto, or a reference of markers"
        )
    if apart := [key for key, facts in done.items() if HARDLY in facts["clock"]["how"]]:
        named = ", ".join(apart[:5]) + (", ..." if len(apart) > 5 else "")
        text += (
            f". IN DOUBT: in {len(apart)} takes {HARDLY}, so that their errors may be those of the clock, or "
            f"of another movement: {named}; leave them out by --takes"
        )
    return text + "."


def all_tables(protocol: ValidationProtocol, found: Validation) -> tuple[tuple[AngleErrors, ...], tuple[Table, ...]]:
    """Return the rows of errors, and all tables."""
    rows = error_rows(found.differences(), MOVEMENTS)
    adapter = SETS[protocol.dataset]
    references = sorted({facts["reference"] for facts in found.outcome.done.values()})
    notes = [f"Reference: {'; '.join(references)}."] if references else []
    notes += [f"Of this set: {adapter.caution}."] if adapter.caution else []
    title = f"Joint angles on {adapter.title}, mode {protocol.own_mode}"
    tables = (error_table(rows, title, notes), published_table(rows), takes_table(found))
    return rows, tables


def takes_table(found: Validation) -> Table:
    """Return one row for each take: what its clock was shifted by, or why it failed."""
    cells: list[tuple[str | float | None, ...]] = []
    for take in found.takes:
        facts = found.outcome.done.get(take.key)
        if facts is None:
            reason = found.outcome.failed.get(take.key, "not run")
            cells.append((take.key, take.kind, None, None, f"FAILED: {reason}"))
            continue
        clock = facts["clock"]
        said = "; ".join((clock["how"], *_left_out(facts), *facts["notes"]))
        cells.append((take.key, take.kind, clock["shift_s"], clock.get("agreement"), said))
    columns = ("take", "movement", "shift [s]", "agreement", "clock, and what was left out or is in doubt")
    notes = (
        "Shift: added to the times of the reference; takes and references start together by the set's own account.",
    )
    return Table("takes", "Takes", columns, (0, 0, 3, 2, 0), tuple(cells), notes)


def _left_out(facts: dict[str, Any]) -> list[str]:
    reasons: dict[str, list[str]] = {}
    for name, reason in facts["left_out"].items():
        reasons.setdefault(reason, []).append(name)
    return [
        f"left out, as it {reason}: {', '.join(names)}"
        if reason.startswith(("does", "depends"))
        else f"left out, {reason}: {', '.join(names)}"
        for reason, names in reasons.items()
    ]


def write_validation(
    folder: Path, protocol: ValidationProtocol, found: Validation
) -> tuple[str, Sequence[Table], list[Path]]:
    """Write all tables; return the first sentence, the tables and the files."""
    rows, tables = all_tables(protocol, found)
    first = first_line(protocol, found)
    _write_takes(folder / TAKES, found.differences())
    facts = {"settings": protocol.settings(), "takes": found.outcome.done, "failed": found.outcome.failed}
    return first, tables, [*write_angle_tables(folder, rows, tables, first, facts), folder / TAKES]


def _write_takes(path: Path, differences: Sequence[AngleDifferences]) -> None:
    """Write the errors of every angle of every take, so that others can average as they publish."""
    rows = [{"take": one.take} | plain_rows([angle_errors([one], one.angle, one.movement)])[0] for one in differences]
    text = io.StringIO(newline="")
    lines = csv.DictWriter(text, list(rows[0]) if rows else ["take"], lineterminator="\n")
    lines.writeheader()
    lines.writerows(rows)
    write_text(path, text.getvalue(), overwrite=True)
