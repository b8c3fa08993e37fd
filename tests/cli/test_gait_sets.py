"""References from public sets, of files in their formats: tables, SciPy's .mat, ezc3d's C3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from clinical_support import walking
from scipy.io import savemat

from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.gait_scores import side_curves
from rtof_kin.clinical.gait_variables import gait_cycles
from rtof_kin.data.gait_reference import NAMES
from rtof_kin.formats.gait_reference import read_gait_reference
from rtof_kin.markers.marker_sets import places_of

PHASE = np.linspace(0, 2 * np.pi, 101)
HEALTHY = {
    "PelvisAngleZ": 10 + np.sin(2 * PHASE),
    "HipAngleZ": 10 + 20 * np.cos(PHASE),
    "KneeAngleZ": 30 - 25 * np.sin(PHASE),
    "AnkleAngleZ": 12 * np.sin(PHASE + 0.3),
}
"""Angles with the signs of healthy gait, deg, at 0, 1, ..., 100 %."""


def write_fukuchi(folder: Path, person: int, sign: float = 1.0, offset: float = 0.0, rows: int = 101) -> None:
    columns = {f"{side}{name}": sign * curve + offset for side in "RL" for name, curve in HEALTHY.items()}
    columns |= {f"{side}HipAngleX": np.full(101, np.nan) for side in "RL"}
    lines = ["\t".join(["Time", *columns])]
    table = np.column_stack([np.arange(101), *columns.values()])[:rows]
    lines += ["\t".join("" if np.isnan(cell) else f"{cell:.6f}" for cell in row) for row in table]
    (folder / f"WBDS{person:02d}walkOCang.txt").write_text("\r\n".join(lines) + "\r\n")


def test_angles_of_fukuchi_are_means_with_licence_and_citation(cli: Any, tmp_path: Path) -> None:
    for person in (1, 2, 3):
        write_fukuchi(tmp_path, person, offset=person)
    write_fukuchi(tmp_path, 4, rows=90)
    arguments = ("gait-reference", tmp_path, "--set", "fukuchi2018-angles", "-o", tmp_path / "r.json")
    done = cli.ok(*arguments)
    done.says("reference of 3 people", "left out: WBDS04: ", "at 101 instants", "GDI will not be computed")
    found = read_gait_reference(tmp_path / "r.json")
    np.testing.assert_allclose(
        np.degrees(found.mean[NAMES.index("hip_flexion")]), HEALTHY["HipAngleZ"][::2] + 2, atol=1e-4
    )
    np.testing.assert_allclose(np.degrees(found.sd[NAMES.index("knee_flexion")]), 1.0, atol=1e-4)
    assert set(found.missing) == set(NAMES) - {"pelvic_tilt", "hip_flexion", "knee_flexion", "ankle_dorsiflexion"}
    assert found.licence == "CC-BY-4.0"
    assert "Fukuchi" in found.source
    assert "e4640" in found.source
    assert not found.is_own
    assert "--licence" in cli.refused(*arguments, "--licence", "mine", "--overwrite").err
    assert "--from-standing" in cli.refused(*arguments, "--from-standing", "--overwrite").err
    assert "--walking-speed" in cli.refused(*arguments, "--walking-speed", 1, 2, "--overwrite").err
    assert "expected names as" in cli.refused(*arguments[:3], "lencioni2019", *arguments[4:], "--overwrite").err
    write_fukuchi(tmp_path, 5, sign=-9.0)
    assert "another sign?" in cli.refused(*arguments, "--overwrite").err


def write_lencioni(path: Path, offset: float) -> None:
    """Two strides of walking at different speeds, and one on the toes, as published: names padded to one length."""
    names = np.array(["PelvisX", "HipFlx", "HipAbd", "KneeFlx", "AnkleFlx"])
    angles = np.stack([0 * PHASE, *(HEALTHY[f"{name}AngleZ"] for name in ("Hip", "Hip", "Knee", "Ankle"))]) + offset
    trials = np.zeros(3, dtype=[("Task", object), ("Foot", object), ("Ang", object), ("speed", object)])
    for k, (task, foot, speed) in enumerate(
        (("Walking", "RX", 1.2), ("Walking", "LX", 0.5), ("ToeWalking", "RX", 1.2))
    ):
        trials[k] = (task.ljust(12), foot, angles + 10 * k, speed)
    savemat(path, {"s": {"AngVarName": names, "Data": trials, "KinFreq": 200}})


def test_strides_of_lencioni_are_chosen_by_task_and_speed(cli: Any, tmp_path: Path) -> None:
    for person in (1, 2):
        write_lencioni(tmp_path / f"Subject{person}.mat", offset=float(person))
    arguments = ("gait-reference", tmp_path, "--set", "lencioni2019", "-o", tmp_path / "r.json", "--overwrite")
    hip = NAMES.index("hip_flexion")
    for options, expected in (((), 1.5 + 5), (("--walking-speed", 1, 1.5), 1.5)):
        cli.ok(*arguments, *options)
        found = read_gait_reference(tmp_path / "r.json")
        np.testing.assert_allclose(np.degrees(found.mean[hip]), HEALTHY["HipAngleZ"][::2] + expected, atol=1e-4)
    assert found.people == 2
    assert "plantarflexed" in found.zero
    (tmp_path / "Subject3.mat").unlink(missing_ok=True)
    savemat(tmp_path / "Subject3.mat", {"s": {"Data": 1.0}})
    cli.ok(*arguments).says("left out: 3: ", "is not as the set publishes it")


SIDED = ("IAS", "IPS", "FTC", "FLE", "FME", "FAX", "TTC", "FAL", "TAM", "FCC", "FM1", "FM2", "FM5", "SAJ", "HLE", "RSP")
MARKERS = [f"{side}_{name}" for side in "RL" for name in SIDED] + ["CV7", "SXS"]


def write_c3d(path: Path, motion: Motion) -> None:
    """Markers on a motion in mm, z up, as ezc3d writes them."""
    places = places_of(MARKERS)
    index = [motion.skeleton.names.index(segment) for segment in places.segments]
    p, R = motion.poses.p_world_joint[:, index], motion.poses.R_world_bone[:, index]
    points = 1000 * (p + np.einsum("tkij,kj->tki", R, places.p_bone_marker))
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [60.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(places.names)
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    file["data"]["points"] = np.concatenate([points.transpose(2, 1, 0), np.ones((1, len(MARKERS), len(points)))])
    path.parent.mkdir(parents=True, exist_ok=True)
    file.write(str(path))


def test_markers_become_a_reference_with_our_own_definitions(cli: Any, tmp_path: Path) -> None:
    """Passes with fewer strides than a motion needs to be called gait."""
    people = {"2014001": walking(2.9, speed=1.0), "2014002": walking(2.9, speed=1.3)}
    for person, motion in people.items():
        for number in range(2):
            write_c3d(tmp_path / person / f"{person}_C4_{number:02d}.c3d", motion)
        write_c3d(tmp_path / person / f"{person}_C1_01.c3d", motion)
    done = cli.ok("gait-reference", tmp_path, "--set", "schreiber2019", "--strides", 2, "-o", tmp_path / "r.json")
    done.says("reference of 2 people", "on the optical markers of schreiber2019")
    found = read_gait_reference(tmp_path / "r.json")
    assert found.is_own
    assert found.missing == ()
    assert found.curves is not None
    assert found.names == tuple(people)
    assert found.strides == ((4, 2), (4, 2))
    for k, motion in enumerate(people.values()):
        truth = side_curves(gait_cycles(motion, few=True), "right").mean
        error = np.degrees(found.curves[k, 0] - truth)
        worst = {one: float(np.sqrt(np.mean(error[v] ** 2))) for v, one in enumerate(NAMES)}
        assert max(worst.values()) < 3.0
