"""Which layout points are in: by its name or their number, and confirmed by their names or by geometry.

Several layouts have the same number of points (BODY_25 and BODY_25B; COCO and Human3.6M; MediaPipe and
the skeleton's own landmarks), so a number alone never decides. Geometry does: how likely the points are
to be a person in a layout, by the same normal distribution that the adapter uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.errors import ShapeError
from rtof_kin.vision.landmark_regression import LEAST_CONFIDENCE, LandmarkRegression
from rtof_kin.vision.layouts import Layout
from rtof_kin.vision.pose_gaussian import FEWEST_POINTS

Array = NDArray[np.float64]
FRAMES = 60
"""So many persons, spread over the recording, are looked at."""
CLEARLY = 1.0
"""Log likelihood per point by which one layout must be better than the next one; between the right one
and a wrong one there are 4 to 8."""
LARGEST_MISFIT = 3.0
"""Median squared distance per degree of freedom from the persons known, above which points are none: it
is 0.6 to 2.7 for persons, on real detections too, and 3 to 5 for points in a wrong order."""
LARGEST_MISFIT_NAMED = 3.4
"""The same where the layout is named: people also sit cross-legged and curl up."""


@dataclass(frozen=True)
class Recognition:
    """A layout, and why."""

    layout: Layout
    """The layout."""
    reason: str
    """A sentence that says how it was recognised and confirmed."""
    order: tuple[int, ...]
    """(K,) where its points stand among those of the file."""


@dataclass(frozen=True)
class _Fit:
    layout: str
    log_likelihood: float
    misfit: float


def recognise(
    uv_px: Array,
    confidence: Array,
    names: Sequence[str] | None = None,
    layout: str | None = None,
    adapter: LandmarkRegression | None = None,
) -> Recognition:
    """The layout of points of one or more people.

    Args:
        uv_px: (..., K, 2) pixels, NaN where unseen. confidence: (..., K), 0 where unseen.
        names: what the file calls the points, where it does.
        layout: its name, where it is known: it is then only confirmed.
        adapter: whose layouts and geometry; the shipped one where not given.

    Raises:
        UnknownNameError: no layout has that name.
        ShapeError: the number or the names of the points are another layout's, they do not lie to each
            other as those of a person, or it cannot be told which of two layouts they are in.
    """
    adapter = adapter or LandmarkRegression.default()
    table = adapter.table
    K = uv_px.shape[-2]
    wanted = [table.layout(layout)] if layout is not None else list(table.layouts.values())
    if names is not None:
        found = _by_names(names, wanted)
        if found is not None:
            return found
        if layout is not None or not _only_numbers(names):
            raise ShapeError(_no_such_names(names, wanted, layout))
    same = [form for form in table.layouts.values() if len(form) == K]
    if layout is not None and len(wanted[0]) != K:
        others = ", ".join(form.name for form in same) or "none of those known"
        raise ShapeError(
            f"layout {layout} has {len(wanted[0])} points, but there are {K} here; so many have: {others}"
        )
    if not same:
        known = ", ".join(f"{form.name} ({len(form)})" for form in table.layouts.values())
        raise ShapeError(f"no layout has {K} points; known: {known}; or name each point in landmarks")
    fits = _fits(adapter, same, uv_px, confidence)
    return _decided(fits, {form.name: form for form in same}, layout)


def _by_names(names: Sequence[str], wanted: Sequence[Layout]) -> Recognition | None:
    """The layout with most points all of which are named."""
    found = [(form, form.order(names)) for form in wanted]
    named = [(form, order) for form, order in found if order is not None]
    if not named:
        return None
    form, order = max(named, key=lambda pair: len(pair[0]))
    return Recognition(form, f"{form.title}: its {len(form)} points are named", tuple(order))


def _only_numbers(names: Sequence[str]) -> bool:
    return all(name.strip().isdigit() for name in names)


def _no_such_names(names: Sequence[str], wanted: Sequence[Layout], layout: str | None) -> str:
    said = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    if layout is None:
        known = ", ".join(form.name for form in wanted)
        return f"the points are named {said}, which is no layout; known: {known}"
    have = set(names)
    form = wanted[0]
    lacking = [name for name in form.names if name not in have]
    return f"layout {layout}: the points are named {said}; there is no {', '.join(lacking[:5])}"


def _fits(
    adapter: LandmarkRegression, forms: Sequence[Layout], uv_px: Array, confidence: Array
) -> list[_Fit]:
    """How well each layout fits, the best first.

    Raises:
        ShapeError: nowhere are enough points seen.
    """
    K = len(forms[0])
    uv, confidence = uv_px.reshape(-1, K, 2), confidence.reshape(-1, K)
    seen = np.isfinite(uv).all(axis=-1) & (confidence >= LEAST_CONFIDENCE)
    count = seen.sum(axis=1)
    if count.max(initial=0) < min(2 * FEWEST_POINTS, K):
        raise ShapeError(
            f"nowhere are more than {count.max(initial=0)} of {K} points seen (confidence of at least "
            f"{LEAST_CONFIDENCE:g}), so there is nobody to tell the layout by; look at the detector's "
            "own output"
        )
    # Those with most points seen tell most; among them, spread over the recording.
    good = np.flatnonzero(count >= 0.8 * count.max())
    rows = good[np.unique(np.linspace(0, len(good) - 1, FRAMES).astype(int))]
    fits = []
    for form in forms:
        log_p, misfit = [], []
        for row in rows:
            points = [p for p, is_seen in zip(form.points, seen[row], strict=True) if is_seen]
            _, one = adapter.gaussian.given(points).turned_upright(uv[row][seen[row]][None])
            log_p.append(one.per_point[0])
            misfit.append(one.misfit[0])
        fits.append(_Fit(form.name, float(np.median(log_p)), float(np.median(misfit))))
    return sorted(fits, key=lambda fit: -fit.log_likelihood)


def _decided(fits: Sequence[_Fit], forms: dict[str, Layout], layout: str | None) -> Recognition:
    best = fits[0]
    margin = best.log_likelihood - fits[1].log_likelihood if len(fits) > 1 else np.inf
    asked = next((fit for fit in fits if fit.layout == layout), best)
    largest = LARGEST_MISFIT if layout is None else LARGEST_MISFIT_NAMED
    if best.misfit > largest:
        tried = " or ".join(fit.layout for fit in fits)
        raise ShapeError(
            f"{len(forms[best.layout])} points do not lie to each other as a person's in layout {tried} "
            f"(misfit {best.misfit:.1f}, {largest:g} at most); check their order, and that x and "
            "y are pixels with y down"
        )
    if asked is not best and best.log_likelihood - asked.log_likelihood > CLEARLY:
        raise ShapeError(
            f"layout {layout}: the points lie to each other as those of {best.layout} do (misfit "
            f"{best.misfit:.1f} instead of {asked.misfit:.1f}); name that layout"
        )
    if layout is None and margin < CLEARLY:
        raise ShapeError(f"the points may be in layout {best.layout} or {fits[1].layout}; name the layout")
    form = forms[asked.layout]
    others = ", ".join(f"{fit.misfit:.1f} as {fit.layout}" for fit in fits if fit is not asked)
    how = f"misfit {asked.misfit:.1f}" + (f" against {others}" if others else "")
    return Recognition(form, f"{form.title}: confirmed by geometry ({how})", tuple(range(len(form))))
