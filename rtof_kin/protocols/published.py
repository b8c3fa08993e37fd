"""Published figures: the tables of the RTOF paper (Bao, Zhao, Qian, 2024), and errors of joint angles, degrees.

They are in ``published.toml``, which says what the columns are, their units and where they come from.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

Metric = Literal["rmse", "mae", "median"]
METRICS: Final[dict[Metric, str]] = {"rmse": "RMSE", "mae": "mean absolute error", "median": "median absolute error"}


class PublishedError(NamedTuple):
    """One published error of joint angles from one camera."""

    system: str
    angle: str  #: Joint angle of this package, or `clinical.angle_errors.ALL`
    metric: Metric
    degrees: float
    source: str


_FILE: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _rows(name: str) -> dict[str, Any]:
    return {key: tuple(row) for key, row in _FILE[name].items()}


NAMES_1: Final[tuple[str, ...]] = tuple(_FILE["columns_1"])
TABLE_1: Final[dict[str, tuple[float | None, ...]]] = {
    name: (None,) * (len(NAMES_1) - len(row)) + row for name, row in _rows("table_1").items()
}
INERTIAL_ONLY: Final[dict[str, tuple[float, float]]] = _rows("inertial_only")
ABLATION: Final[dict[str, tuple[float, float, float]]] = _rows("ablation")
FRAGMENT_LENGTH: Final[dict[int, tuple[float, float, float]]] = {
    int(N): row for N, row in _rows("fragment_length").items()
}
VISUAL_WEIGHT: Final[dict[float, tuple[float, float]]] = {
    float(k_V): row for k_V, row in _rows("visual_weight").items()
}
HUMAN36M: Final[dict[str, tuple[float, float, float]]] = _rows("human36m")
TOTAL_CAPTURE_CAVEATS: Final[tuple[str, ...]] = tuple(_FILE["total_capture_caveats"])
HUMAN36M_CAVEATS: Final[tuple[str, ...]] = tuple(_FILE["human36m_caveats"])
PUBLISHED: Final = tuple(PublishedError(**row) for row in _FILE["angles"])
WITHOUT_METRIC: Final[str] = _FILE["without_metric"]
