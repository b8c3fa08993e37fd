"""``[imus] file`` takes the files of sensors' makers: names, clocks, rates, orientations and errors."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from scipy.spatial.transform import Rotation, Slerp
from sensor_files import RATE, SERIALS, WRITERS, Truth, dot_text, mt_text, truth, write_mt

from rtof_kin import Recording, SkeletonModel
from rtof_kin.core.errors import FileFormatError, UnitError, UnknownNameError
from rtof_kin.data.imu import ImuSequence
from rtof_kin.formats.sensors.files import FORMATS

TRUTHS = [truth(6), truth(7)]
PELVIS = f'\n[imus.map]\n{SERIALS[0]} = "pelvis"\n{SERIALS[1]} = "left shank"\n'


def load(folder: Path, table: str, file: str = "trial") -> Recording:
    text = f'schema_version = 1\n[imus]\nfile = "{file}"\n{table}'
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    return Recording.load(folder)


def imus(folder: Path, table: str = "", file: str = "trial") -> ImuSequence:
    found = load(folder, table, file).imus
    assert found is not None
    return found


def trial(folder: Path, truths: list[Truth] = TRUTHS) -> Path:
    (folder / "trial").mkdir()
    return write_mt(folder / "trial", truths)


@pytest.mark.parametrize("title", [kind.title for kind in FORMATS])
def test_every_format_is_read_and_saved_exactly(title: str, tmp_path: Path) -> None:
    (tmp_path / "trial").mkdir()
    truths = [truth(6, T=80), truth(7, T=80)]  # over a second, for the orientation filter
    place = WRITERS[title](tmp_path / "trial", truths)
    file = str(place.relative_to(tmp_path))
    recording = load(tmp_path, "", file)
    assert recording.calibration is None
    assert recording.imus is not None
    assert [name.removeprefix("s") for name in recording.imus.names] == list(SERIALS)
    if title != "Noraxon CSV":  # its orientation is an estimate
        R = np.stack([one.R.as_matrix() for one in truths], axis=1)
        np.testing.assert_allclose(recording.imus.R_inertial_sensor, R, atol=1e-9)
    f = np.stack([one.f for one in truths], axis=1)
    f = np.full_like(f, np.nan) if title == "OpenSense .sto" else f
    np.testing.assert_allclose(recording.imus.f_sensor, f, atol=1e-8)
    recording.save(tmp_path / "saved")
    again = Recording.load(tmp_path / "saved").imus
    assert again is not None
    assert again.names == recording.imus.names
    for name in ("times", "R_inertial_sensor", "f_sensor"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording.imus, name))


def test_sensors_get_the_names_of_their_places(tmp_path: Path) -> None:
    trial(tmp_path)
    assert imus(tmp_path, PELVIS).names == ("pelvis", "left shank")
    (tmp_path / "map.csv").write_text(f"serial,segment\n{SERIALS[1]},tibia_l_imu\n{SERIALS[0]},pelvis\n")
    named = imus(tmp_path, 'sensor_map = "map.csv"')
    assert named.names == ("tibia_l_imu", "pelvis")
    np.testing.assert_allclose(named.f_sensor[:, 0], TRUTHS[1].f)
    only = imus(tmp_path, f'names = ["left shank"]{PELVIS}')
    assert only.names == ("left shank",)
    with pytest.raises(FileFormatError, match=r"sensor_map: stands beside \[imus.map\]"):
        imus(tmp_path, f'sensor_map = "map.csv"{PELVIS}')
    with pytest.raises(
        UnknownNameError, match=r"unknown segment in .*toml, line \d+ 'left foo'\. Did you mean 'left foot'"
    ):
        imus(tmp_path, PELVIS.replace("left shank", "left foo"))
    with pytest.raises(FileFormatError, match="the map has 99, which the trial has not"):
        imus(tmp_path, '\n[imus.map]\n99 = "pelvis"\n')
    with pytest.raises(FileFormatError, match=r"\[imus\] sensor_map: there is no file"):
        imus(tmp_path, 'sensor_map = "no.csv"')


def test_a_spare_sensor_is_left_out_with_a_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trial(tmp_path)
    with caplog.at_level(logging.INFO):
        assert imus(tmp_path, f'\n[imus.map]\n{SERIALS[0]} = "pelvis"\n').names == ("pelvis",)
    assert f"the map of sensors leaves out {SERIALS[1]}" in caplog.text


def test_calibration_is_that_of_the_place_and_stays_exact(tmp_path: Path) -> None:
    trial(tmp_path)
    identity = "quat_wxyz_world_inertial = [1, 0, 0, 0]\nquat_wxyz_sensor_bone = [1, 0, 0, 0]\n"
    tables = "".join(
        f'[imus.sensors."{name}"]\njoint = "{joint}"\nlever_arm_m = [0.1, 0, 0]\n{identity}'
        for name, joint in (("belt", "Hips"), ("left shank", "LeftLeg"))
    )
    recording = load(tmp_path, PELVIS.replace("pelvis", "belt") + tables)  # a word of this recording's own
    bones = recording.bone_imus()
    assert bones is not None
    assert bones.joints == ("Hips", "LeftLeg")
    with pytest.raises(UnknownNameError, match=r"no table \[imus.sensors.*'00B40001'"):
        load(tmp_path, tables)


def test_times_are_put_on_the_recordings_clock(tmp_path: Path) -> None:
    trial(tmp_path)
    own = imus(tmp_path).times
    np.testing.assert_allclose(imus(tmp_path, "start_s = -1.5").times, own - 1.5)
    drifted = imus(tmp_path, "start_s = 3.0\nclock_drift = 1e-4").times
    np.testing.assert_allclose(drifted, own * 1.0001 + 3.0, rtol=0, atol=1e-12)
    first = imus(tmp_path, "first_sample_s = 1.2\nclock_drift = 1e-4").times
    np.testing.assert_allclose(first, 1.2 + 1.0001 * (own - own[0]), rtol=0, atol=1e-12)
    with pytest.raises(FileFormatError, match="first_sample_s: stands beside start_s"):
        imus(tmp_path, "start_s = 1\nfirst_sample_s = 1")
    with pytest.raises(FileFormatError, match="clock_drift: 20 s/s is no clock's"):
        imus(tmp_path, "clock_drift = 20")


def test_the_packages_own_arrays_have_a_clock_too(tmp_path: Path) -> None:
    recording = replace(planted.recording(planted.moving(SkeletonModel.default(), 12)), keypoints=None, truth=None)
    recording.save(tmp_path / "own")
    index = tmp_path / "own" / "recording.toml"
    text = index.read_text().replace("[imus]\n", "[imus]\nstart_s = 2.0\nclock_drift = -1e-3\n")
    index.write_text(text)
    assert recording.imus is not None
    again = Recording.load(tmp_path / "own").imus
    assert again is not None
    np.testing.assert_allclose(again.times, recording.imus.times * 0.999 + 2.0, rtol=0, atol=1e-12)


def test_sensors_of_different_rates_share_even_times_of_the_fastest(tmp_path: Path) -> None:
    (tmp_path / "trial").mkdir()
    w = np.array([0.3, -1.0, 2.0])  # a constant turn is what slerp reproduces
    every = {"fast": np.arange(0, 2_000_000, 8333), "slow": np.arange(100_000, 1_900_000, 33333)}
    for name, stamps in every.items():
        one = truth(8, T=len(stamps))
        turned = Rotation.from_rotvec(w * stamps[:, None] / 1e6)
        ramp = stamps[:, None] / 1e6 * [1.0, 2.0, 3.0] + [0, 0, 9.0]
        text = dot_text(replace(one, R=turned, f=ramp), 7_000_000 + stamps, raw=True)
        (tmp_path / "trial" / f"{name}_20210820_202113.csv").write_text(text, encoding="utf-8")
    found = imus(tmp_path, "start_s = -7.0")
    np.testing.assert_allclose(np.diff(found.times), 8333e-6, rtol=1e-3)
    inside = (found.times > 0.11) & (found.times < 1.85)
    for s in range(2):
        R = Rotation.from_rotvec(w * found.times[inside, None]).as_matrix()
        np.testing.assert_allclose(found.R_inertial_sensor[inside, s], R, atol=1e-6)
        f = found.times[inside, None] * [1.0, 2.0, 3.0] + [0, 0, 9.0]
        np.testing.assert_allclose(found.f_sensor[inside, s], f, atol=1e-6)
    outside = found.times < 0.05
    assert np.isnan(found.f_sensor[outside, found.names.index("slow")]).all()  # nothing is extrapolated


def test_a_declaration_replaces_the_formats_own(tmp_path: Path) -> None:
    in_g = [replace(one, f=one.f / 9.80665) for one in TRUTHS]
    trial(tmp_path, in_g)
    with pytest.raises(UnitError, match=r"trial: IMU .*gravity\s+in g"):
        imus(tmp_path)
    found = imus(tmp_path, 'acceleration_unit = "g"\nrate_hz = 30')
    np.testing.assert_allclose(found.f_sensor[:, 0], TRUTHS[0].f)
    assert np.median(np.diff(found.times)) == pytest.approx(1 / 30)
    with pytest.raises(FileFormatError, match="acceleration_unit: 'feet' is not one of m/s2, g, mg"):
        imus(tmp_path, 'acceleration_unit = "feet"')


def test_an_orientation_that_is_missing_is_estimated(tmp_path: Path) -> None:
    (tmp_path / "trial").mkdir()
    times = np.arange(0, 6, 1 / RATE)
    keys = Rotation.from_euler("xyz", np.random.default_rng(1).uniform(-60, 60, (7, 3)), degrees=True)
    R = Slerp(np.arange(7), keys)(times)
    w = (R[:-1].inv() * R[1:]).as_rotvec() * RATE
    f = R.inv().apply([0, 0, 9.80665])
    one = replace(truth(9, T=len(times)), R=R, f=f, w=np.vstack([w, w[-1:]]), a=np.zeros_like(f))
    text = mt_text(one, np.arange(len(times)))
    head, *rows = text.split("\n")[2:]
    kept = [cell for cell in head.split("\t") if not cell.startswith(("Quat", "Mag"))]
    at = [head.split("\t").index(cell) for cell in kept]
    lines = ["\t".join(row.split("\t")[i] for i in at) for row in rows if row]
    content = "\n".join(["// Update Rate: 60.0Hz", "\t".join(kept), *lines, ""])
    (tmp_path / "trial" / f"MT_1_{SERIALS[0]}.txt").write_text(content)
    found = imus(tmp_path).R_inertial_sensor[:, 0]
    tilt = np.degrees(np.arccos(np.clip(np.sum(found[:, 2] * R.as_matrix()[:, 2], axis=1), -1, 1)))
    assert np.median(tilt) < 3.0


@pytest.mark.parametrize(
    ("table", "file", "error", "problem"),
    [
        ("", "nowhere", FileFormatError, r"\[imus\] file: there is no file"),
        ("", "../trial", FileFormatError, "leads out of the folder"),
        ("", "recording.toml", FileFormatError, "no file of sensors that is known"),
        ("sensor = 1", "trial", UnknownNameError, "unknown field in .*'sensor'"),
        ('names = ["x"]', "trial", UnknownNameError, r"unknown sensor in .*\[imus\] names 'x'"),
        ("rate_hz = -3", "trial", FileFormatError, r"\[imus\] rate_hz: -3 is not a positive"),
        ("map = 3", "trial", FileFormatError, r"\[imus\] map: not a table"),
    ],
)
def test_errors_name_field_and_remedy(
    tmp_path: Path, table: str, file: str, error: type[Exception], problem: str
) -> None:
    trial(tmp_path)
    with pytest.raises(error, match=problem):
        imus(tmp_path, table, file)
