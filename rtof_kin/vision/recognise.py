"""Recognition of a detector's layout, by the names of its points or by geometry.

Several layouts have the same number of points (BODY_25 and BODY_25B; COCO and Human3.6M; MediaPipe and the
skeleton's own landmarks). Without names, the layout is the one under which the points are most likely to be
a person's, by the distribution of `rtof_kin.vision.pose_gaussian`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.vision.landmark_regression import LEAST_CONFIDENCE, LandmarkRegression
from rtof_kin.vision.layouts import Layout
from rtof_kin.vision.pose_gaussian import FEWEST_POINTS

_FRAMES = 60  # persons, spread over the recording, that are tested
_LEAST_MARGIN = 1.0  # log-likelihood per point over the next layout; wrong ones are 4 to 8 worse
_LARGEST_MISFIT = 3.0  # median squared distance per degree of freedom; persons 0.6 to 2.7, wrong order 3 to 5
_LARGEST_MISFIT_NAMED = 3.4  # for a layout that was named: postures may be unusual


@dataclass(frozen=True)
class Recognition:
    """A layout and the evidence for it."""

    layout: Layout
    reason: str
    order: tuple[int, ...]
    """(K,) index of each of its points among those of the file."""


class _Fit(NamedTuple):
    layout: Layout
    log_likelihood: float
    misfit: float


def recognise(
    uv_px: Array,
    confidence: Array,
    names: Sequence[str] | None = None,
    layout: str | None = None,
    regression: LandmarkRegression | None = None,
) -> Recognition:
    """Recognise or verify the layout of the points of one or more people.

    Args:
        uv_px: (..., K, 2) px, NaN where not detected. confidence: (..., K), 0 where not detected.
        names: K names of the points in the file, if it has them.
        layout: name of the layout to verify; None to recognise it.
        regression: layouts and geometry; the shipped ones if None.

    Raises:
        UnknownNameError: unknown `layout`.
        InvalidInputError: number or names of the points do not match, the geometry is not a person's, or
            two layouts are equally likely.
    """
    regression = regression or LandmarkRegression.default()
    table, K = regression.table, uv_px.shape[-2]
    wanted = [table.layout(layout)] if layout is not None else list(table.layouts.values())
    if names is not None:
        found = _by_names(names, wanted)
        if found is not None:
            return found
        if layout is not None or not all(name.strip().isdigit() for name in names):
            raise InvalidInputError(_no_such_names(names, wanted, layout))
    same = [form for form in table.layouts.values() if len(form) == K]
    if layout is not None and len(wanted[0]) != K:
        others = ", ".join(form.name for form in same) or "none of those known"
        raise InvalidInputError(f"layout {layout} has {len(wanted[0])} points, but there are {K} here, as in: {others}")
    if not same:
        known = ", ".join(f"{form.name} ({len(form)})" for form in table.layouts.values())
        raise InvalidInputError(f"no layout has {K} points; known: {known}; or name each point in landmarks")
    return _decided(_fits(regression, same, uv_px, confidence), layout)


def _by_names(names: Sequence[str], wanted: Sequence[Layout]) -> Recognition | None:
    """Return the largest layout all of whose points are named."""
    found = [(form, order) for form in wanted if (order := form.order(names)) is not None]
    if not found:
        return None
    form, order = max(found, key=lambda pair: len(pair[0]))
    return Recognition(form, f"{form.title}: its {len(form)} points are named", tuple(order))


def _no_such_names(names: Sequence[str], wanted: Sequence[Layout], layout: str | None) -> str:
    given = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    if layout is None:
        known = ", ".join(form.name for form in wanted)
        return f"the points are named {given}, which is no layout; known: {known}"
    lacking = [name for name in wanted[0].names if name not in names]
    return f"layout {layout}: the points are named {given}; there is no {', '.join(lacking[:5])}"


def _fits(regression: LandmarkRegression, forms: Sequence[Layout], uv_px: Array, confidence: Array) -> list[_Fit]:
    """Return the fit of each layout, the best first."""
    K = len(forms[0])
    uv, confidence = uv_px.reshape(-1, K, 2), confidence.reshape(-1, K)
    seen = np.isfinite(uv).all(axis=-1) & (confidence >= LEAST_CONFIDENCE)
    count = seen.sum(axis=1)
    most = count.max(initial=0)
    if most < min(2 * FEWEST_POINTS, K):
        raise InvalidInputError(
            f"nowhere are more than {most} of {K} points detected (confidence of at least "
            f"{LEAST_CONFIDENCE:g}), too few to recognise the layout; check the detector's output"
        )
    # Persons with most points detected, spread over the recording.
    good = np.flatnonzero(count >= 0.8 * most)
    rows = good[np.unique(np.linspace(0, len(good) - 1, _FRAMES).astype(int))]
    fits = []
    for form in forms:
        log_p, misfit = [], []
        for row in rows:
            points = [p for p, is_seen in zip(form.points, seen[row], strict=True) if is_seen]
            _, one = regression.gaussian.given(points).turned_upright(uv[row][seen[row]][None])
            log_p.append(one.per_point[0])
            misfit.append(one.misfit[0])
        fits.append(_Fit(form, float(np.median(log_p)), float(np.median(misfit))))
    return sorted(fits, key=lambda fit: -fit.log_likelihood)


def _decided(fits: Sequence[_Fit], layout: str | None) -> Recognition:
    best = fits[0]
    named = next((fit for fit in fits if fit.layout.name == layout), best)
    largest = _LARGEST_MISFIT if layout is None else _LARGEST_MISFIT_NAMED
    if best.misfit > largest:
        tried = " or ".join(fit.layout.name for fit in fits)
        raise InvalidInputError(
            f"{len(best.layout)} points are not arranged as a person's in layout {tried} (misfit "
            f"{best.misfit:.1f}, {largest:g} at most); check their order, and that y points down"
        )
    if best.log_likelihood - named.log_likelihood > _LEAST_MARGIN:
        raise InvalidInputError(
            f"layout {layout}: the points are arranged as those of {best.layout.name} (misfit "
            f"{best.misfit:.1f} instead of {named.misfit:.1f}); name that layout"
        )
    if layout is None and len(fits) > 1 and best.log_likelihood - fits[1].log_likelihood < _LEAST_MARGIN:
        either = f"{best.layout.name} or {fits[1].layout.name}"
        raise InvalidInputError(f"the points may be in layout {either}; name the layout")
    form = named.layout
    others = ", ".join(f"{fit.misfit:.1f} as {fit.layout.name}" for fit in fits if fit is not named)
    how = f"misfit {named.misfit:.1f}" + (f" against {others}" if others else "")
    return Recognition(form, f"{form.title}: confirmed by geometry ({how})", tuple(range(len(form))))
