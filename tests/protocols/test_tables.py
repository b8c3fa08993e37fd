"""Tables: the paper's own figures, ours pooled over frames, and every reservation where it belongs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from protocol_support import row

from rtof_kin.core.jobs import Outcome
from rtof_kin.protocols import published
from rtof_kin.protocols.tables import LOW_PASSED, STILL, Table, pooled
from rtof_kin.protocols.total_capture import TotalCaptureProtocol

FRAMES = {
    "walking2": (3189, 3575, 3239, 3376, 3738),
    "acting3": (2770, 4828, 4293, 3577, 3006),
    "freestyle3": (2040, 3178, 3931, 2826, 3561),
}
"""Frames of the test takes of S1 to S5, counted in the files."""
GROUPS = [(take, unseen) for unseen in (False, True) for take in FRAMES]
"""Takes of the subjects seen and unseen, in the order of table 1's columns."""
FIGURES = (
    "mpjpe_mm",
    "mpjpe_rr_mm",
    "mpjpe_pa_mm",
    "mpjae",
    "mpjje",
    "angle_deg",
    "flexion_deg",
    "coverage",
    "sixteen_mm",
)
MODES = ("lift", "rtof")


def scores(value: float = 1.0, frames: int = 100, **figures: Any) -> dict[str, Any]:
    """Every figure of one method; all of one value but those given."""
    about = dict.fromkeys(FIGURES, value) | {"frames": frames, "sixteen_frames": frames // 16}
    return about | figures


def measured(subject: str, take: str, camera: int | None, **methods: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The facts of one job by its key; names of methods with a blank in them are calibration rows."""
    key = f"{subject}_{take}" + (f"_cam{camera}" if camera is not None else "")
    return {
        key: {"subject": subject, "take": take, "camera": camera, "methods": methods, "failed_checks": [], "notes": []}
    }


def calibration(subject: str, take: str) -> dict[str, dict[str, Any]]:
    """The facts of the job that needs no camera."""
    rows = {STILL: scores(146), LOW_PASSED: scores(123, angle_deg=None)}
    return measured(subject, take, None, **rows)


def protocol(**changed: Any) -> TotalCaptureProtocol:
    """One take of S1, cameras 1 and 3, two modes, no studies."""
    usual = {"subjects": ("S1",), "takes": ("walking2",), "cameras": (1, 3), "modes": MODES}
    return TotalCaptureProtocol(Path("data"), **(usual | {"studies": False} | changed))


def tables_of(
    about: TotalCaptureProtocol, done: dict[str, Any], failed: dict[str, str] | None = None
) -> dict[str, Table]:
    """Every table by its name."""
    outcome = Outcome(Path("nowhere"), done, failed or {})
    return {table.name: table for table in about.tables(outcome)}


def test_an_average_over_frames_reproduces_that_of_the_paper() -> None:
    """So the paper's average is one over frames; its takes have 51,127 of them."""
    assert sum(map(sum, FRAMES.values())) == 51127
    names = {"RTOF-GT, the paper's (1 camera + IMUs)": 23.2, "RTOF-SN, the paper's (1 camera + IMUs)": 33.7}
    for name, average in names.items():
        cells = dict(zip(GROUPS, published.TABLE_1[name], strict=False))
        done: dict[str, Any] = {}
        for take, frames in FRAMES.items():
            for s, count in enumerate(frames):
                value = cells[take, s >= 3]
                done |= measured(f"S{s + 1}", take, 1, rtof=scores(value, count))
        about = protocol(subjects=("S1", "S2", "S3", "S4", "S5"), takes=tuple(FRAMES), cameras=(1,), modes=("rtof",))
        ours = row(tables_of(about, done)["by_take"], "rtof, ours, root-relative")
        assert ours["average"] == pytest.approx(average, abs=0.06)  # cells are rounded to 0.1
        assert list(ours.values())[1:7] == pytest.approx(list(published.TABLE_1[name][:6]))
        plain = np.mean([cell for cell in published.TABLE_1[name][:6] if cell is not None])
        assert abs(plain - average) > 1


@given(st.lists(st.tuples(st.one_of(st.none(), st.floats(0, 1e3), st.just(np.nan)), st.integers(0, 50)), max_size=8))
def test_the_pooled_figure_is_the_mean_over_all_frames(parts: list[tuple[float | None, int]]) -> None:
    rows = [{"error": value, "frames": frames} for value, frames in parts]
    values = [[v] * frames for v, frames in parts if v is not None and np.isfinite(v)]
    frames = np.concatenate([[], *values])
    expected = pytest.approx(frames.mean(), rel=1e-9, abs=1e-9) if len(frames) else None
    assert pooled(rows, "error") == expected


def complete(cameras: Iterable[int] = (1, 3), modes: Sequence[str] = MODES, **figures: Any) -> dict[str, Any]:
    """What the jobs of `protocol` found when nothing failed."""
    done = calibration("S1", "walking2")
    for camera in cameras:
        done |= measured("S1", "walking2", camera, **{m: scores(10.0, **figures) for m in modes})
    return done


def test_table_1_has_columns_for_seen_and_unseen_subjects() -> None:
    done = measured("S1", "walking2", 1, lift=scores(10, 100), rtof=scores(1, 100))
    done |= measured("S3", "walking2", 1, lift=scores(40, 200), rtof=scores(4, 200))
    done |= measured("S4", "walking2", 1, lift=scores(70, 100, mpjpe_mm=700))
    done |= measured("S5", "freestyle3", 1, lift=scores(90, 400))
    about = protocol(subjects=("S1", "S3", "S4", "S5"), takes=("walking2", "freestyle3"))
    lift = row(tables_of(about, done)["by_take"], "lift, ours, root-relative")
    assert lift == {
        "method": "lift, ours, root-relative",
        "seen W2": pytest.approx(30),
        "seen A3": None,
        "seen FS3": None,
        "unseen W2": pytest.approx(70),
        "unseen A3": None,
        "unseen FS3": pytest.approx(90),
        "average": pytest.approx((10 * 100 + 40 * 200 + 70 * 100 + 90 * 400) / 800),
    }
    absolute = row(tables_of(about, done)["by_take"], "lift, ours, absolute")
    assert absolute["unseen W2"] == pytest.approx(700)
    labels = [cells[0] for cells in tables_of(about, done)["by_take"].rows]
    assert labels[: len(published.TABLE_1)] == list(published.TABLE_1)


def test_the_ablation_has_the_papers_figures_and_the_calibration_rows() -> None:
    table = tables_of(protocol(), complete(mpjae=2.5, coverage=0.987))["ablation"]
    assert [cells[0] for cells in table.rows] == ["lift", "rtof", STILL, LOW_PASSED]
    ours = row(table, "rtof")
    assert (ours["paper: MPJPE [mm]"], ours["paper: MPJAE"], ours["paper: MPJJE"]) == (23.2, 1.54, 63.8)
    assert ours["MPJAE [m/s2]"] == pytest.approx(2.5)
    assert ours["valid"] == "99 %"
    still = row(table, STILL)
    assert still["MPJJE [m/s3]"] == pytest.approx(146)
    assert (still["paper: MPJPE [mm]"], still["valid"]) == (None, None)
    low_passed = row(table, LOW_PASSED)
    assert low_passed["MPJJE [m/s3]"] == pytest.approx(123)
    assert low_passed["joint angle [deg]"] is None  # its orientations are the truth's own
    inertial = tables_of(protocol(), complete())["inertial_only"]
    labels = [cells[0] for cells in inertial.rows]
    assert labels == [*published.INERTIAL_ONLY, "rtof, ours", STILL, LOW_PASSED]
    assert row(inertial, "DIP (6 IMUs)")["MPJJE [m/s3]"] == 159.1


def test_the_multi_view_table_has_its_own_cameras_and_frames() -> None:
    done = measured("S1", "walking2", 1, lift=scores(0, 1000, sixteen_mm=10, sixteen_frames=1))
    done |= measured("S1", "walking2", 3, lift=scores(0, 10, sixteen_mm=40, sixteen_frames=2))
    done |= measured("S1", "walking2", 4, lift=scores(0, 10, sixteen_mm=999, sixteen_frames=9))
    table = tables_of(protocol(cameras=(1, 3, 4), modes=("lift",)), done)["sixteen_joints"]
    assert row(table, "lift, ours, each camera alone")["absolute MPJPE [mm]"] == pytest.approx(30)


WHY = "gt_skel_gbl_pos.txt is damaged"
WALK = "S1 walking2"


@pytest.mark.parametrize(
    ("takes", "done", "failed", "missing", "state"),
    [
        ((), complete(), {}, None, ()),
        (
            ("acting3",),
            complete(),
            {f"S1_acting3{job}": WHY for job in ("", "_cam1", "_cam3")},
            "S1 acting3, S1 acting3 camera 1, S1 acting3 camera 3",
            (("S1 acting3", "not measured", WHY),),
        ),
        (
            (),
            complete(cameras=(1,)),
            {"S1_walking2_cam3": WHY},
            f"{WALK} camera 3",
            ((f"{WALK} camera 3", "not measured", WHY),),
        ),
        ((), complete() | complete(modes=("lift",)), {}, f"{WALK} camera 1 (rtof), {WALK} camera 3 (rtof)", ()),
        ((), complete() | measured("S1", "walking2", 3, lift=scores()), {}, f"{WALK} camera 3 (rtof)", ()),
        (
            (),
            {k: v for k, v in complete().items() if v["camera"]},
            {"S1_walking2": WHY},
            WALK,
            ((WALK, "not measured", WHY),),
        ),
    ],
)
def test_missing_results_are_named_under_every_table(
    takes: tuple[str, ...], done: dict[str, Any], failed: dict[str, str], missing: str | None, state: Any
) -> None:
    tables = tables_of(protocol(takes=("walking2", *takes)), done, failed)
    expected = [] if missing is None else [f"INCOMPLETE, without: {missing}. The last table says why."]
    for name in ("by_take", "inertial_only", "ablation", "sixteen_joints"):
        assert [note for note in tables[name].notes if note.startswith("INCOMPLETE")] == expected
    assert tuple(tables["state_of_data"].rows if "state_of_data" in tables else ()) == state


def test_the_study_of_fragment_length_has_speeds() -> None:
    methods = {"as printed, N = 50": scores(5.0, 100, seconds=2.0), "as printed, N = 20": scores(6.0, 100, seconds=0.5)}
    done = measured("S1", "walking2", 1, rtof=scores(), **methods)
    done |= measured("S1", "walking2", 3, rtof=scores(), **{"as printed, N = 50": scores(8.0, 200, seconds=1.0)})
    tables = tables_of(protocol(modes=("rtof",), studies=True), done)
    fifty = row(tables["fragment_length"], "50")
    assert fifty["frames/s"] == pytest.approx(300 / 3.0)
    assert fifty["root-relative [mm]"] == pytest.approx(7.0)
    assert (fifty["paper: frames/s"], fifty["paper: MPJJE"]) == (743, 63.84)
    assert row(tables["fragment_length"], "200")["frames/s"] is None
    assert [cells[0] for cells in tables["fragment_length"].rows] == ["200", "100", "50", "20"]
