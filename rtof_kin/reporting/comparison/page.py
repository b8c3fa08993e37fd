"""Page of a comparison: sentences, tables and charts in one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Final

from rtof_kin.clinical.comparison import AngleComparison, Comparison
from rtof_kin.clinical.comparison_change import LEVEL, Change, Verdict
from rtof_kin.reporting.angle_names import label
from rtof_kin.reporting.comparison.plot_data import comparison_data
from rtof_kin.reporting.comparison.sentences import cautions, degrees, difference_text, opening, place
from rtof_kin.reporting.html import asset, bullets, self_contained, table

_SCRIPTS: Final = ("unpack.js", "charts.js", "comparison.js")
_STYLES: Final = ("page.css", "comparison.css")
_DIFFERENCES: Final = ("angle", "measure", "B - A", "verdict", "95 % interval", "detectable", "p (Holm)", "A", "B")
_ERRORS: Final = (
    "angle",
    "RMSE",
    "MAE",
    "median",
    "without offset",
    "largest",
    "at",
    "correlation",
    "outside band",
    "compared",
)
_MARKS: Final = {Verdict.CHANGED: "warn", Verdict.NOT_SHOWN: "not-checked", Verdict.NOT_TESTED: "not-checked"}
_RANGES: Final = "The two have no common axis, so there are no curves: see the ranges above."


def page(found: Comparison, why: str = "") -> str:
    """Return the self-contained HTML page of a comparison."""
    careful = cautions(found)
    parts = {
        "title": escape(f"{found.a.name} and {found.b.name}: comparison of joint angles"),
        "opening": "\n".join(f"<p>{escape(line)}</p>" for line in opening(found, why)),
        "cautions": f"<h2>What to be careful about</h2>{bullets(careful)}" if careful else "",
        "name_a": escape(found.a.name),
        "name_b": escape(found.b.name),
        "differences": table(_DIFFERENCES, _difference_rows(found), "differences"),
        "level": f"{100 * LEVEL:.0f} %",
        "errors": _errors(found),
        "curves": "" if found.axis is not None else f"<p>{_RANGES}</p>",
        "left_out": _left_out(found),
    }
    style = "".join(map(asset, _STYLES))
    return self_contained("comparison.html", style, _SCRIPTS, parts, comparison_data(found))


def _difference_rows(found: Comparison) -> Iterator[tuple[str, ...]]:
    for one in found.angles:
        for number, change in enumerate(one.changes):
            name = f"{escape(label(one.name))} <small>{escape(one.positive)}</small>"
            yield name if number == 0 else f'<span class="again">{name}</span>', *_change_cells(change)


def _change_cells(change: Change) -> tuple[str, ...]:
    size, *half = difference_text(change).partition(" ")
    low, high = (degrees(end, True) for end in change.interval)
    p = f"{change.p_adjusted:.3f}" if change.p_adjusted == change.p_adjusted else ""
    difference = f"<b>{size}</b>{escape(''.join(half))}"
    return (
        change.measure,
        difference,
        f'<span class="grade {_MARKS[change.verdict]}">{change.verdict.value}</span>',
        f"{low} to {high}" if low else "",
        degrees(change.detectable),
        "&lt; 0.001" if p == "0.000" else p,
        degrees(change.a),
        degrees(change.b),
    )


def _errors(found: Comparison) -> str:
    rows = [_error_cells(found, one) for one in found.angles if one.errors is not None]
    if not rows:
        return f"<p>{_RANGES}</p>"
    return table(_ERRORS, rows, "errors")


def _error_cells(found: Comparison, one: AngleComparison) -> tuple[str, ...]:
    errors = one.errors
    assert errors is not None
    sizes = (errors.rmse, errors.mae, errors.median, errors.offset_removed)
    r = f"{errors.correlation:.2f}" if errors.correlation == errors.correlation else ""
    outside = f"{100 * one.outside:.0f} %" if one.outside == one.outside else ""
    share = f"{100 * one.share:.0f} %"
    if found.by != "time":
        share += f" ({one.repeats[0]} and {one.repeats[1]})"
    return (
        escape(label(one.name)),
        *map(degrees, sizes),
        degrees(errors.largest, True),
        place(found, errors.at),
        r,
        outside,
        share,
    )


def _left_out(found: Comparison) -> str:
    if not found.left_out:
        return "<p>Every angle that is observed in either is compared.</p>"
    reasons: dict[str, list[str]] = {}
    for name, reason in found.left_out.items():
        reasons.setdefault(reason, []).append(label(name))
    return bullets(f"{reason}: {', '.join(names)}" for reason, names in reasons.items())
