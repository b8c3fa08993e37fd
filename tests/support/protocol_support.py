"""Reading what a protocol wrote, for the tests of the protocols."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rtof_kin.core.jobs import Outcome
from rtof_kin.protocols.tables import Table


def read_json(path: Path) -> Any:
    """Read strict JSON, without NaN."""

    def refuse(text: str) -> None:
        raise AssertionError(f"{path.name}: {text} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def row(table: Table, label: str) -> dict[str, Any]:
    """The cells of the row with a label, by column."""
    (cells,) = [cells for cells in table.rows if cells[0] == label]
    return dict(zip(table.columns, cells, strict=True))


def cells_of(markdown: str) -> list[list[str]]:
    """Heading and rows of a Markdown table."""
    rows = []
    for line in markdown.splitlines():
        if line.startswith("|"):
            assert line.endswith("|")
            text = line.replace("\\|", "\0")[1:-1]
            rows.append([cell.strip().replace("\0", "|") for cell in text.split("|")])
    assert set(rows.pop(1)) == {"---"}
    assert len({len(cells) for cells in rows}) == 1
    return rows


def facts_of(outcome: Outcome) -> dict[str, dict[str, Any]]:
    """All results except times."""
    return {
        key: facts
        | {
            "methods": {
                name: {figure: value for figure, value in figures.items() if figure != "seconds"}
                for name, figures in facts["methods"].items()
            }
        }
        for key, facts in outcome.done.items()
    }
