"""`export --to fhir, redcap, dicom and bids`, read by fhir.resources, csv, pydicom and pypdf; the person is a code."""

from __future__ import annotations

import csv
import importlib
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pypdf
import pytest
from clinical_support import walking

from rtof_kin.body.motion_file import MOTION, MotionWriter
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.recording.recording import Recording
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.hospital import DICTIONARY, ROW

SESSION = {"subject": "Jane Roe", "operator": "Otto Mann", "date": "2026-01-31", "place": "Gait Lab 4"}
NAMES = re.compile("jane|roe|otto|mann|gait lab", re.IGNORECASE)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Five seconds of walking at 1.1 m/s; the audit warns, in words that name the person."""
    folder = tmp_path / "walk"
    folder.mkdir()
    motion = walking(5.0)
    with MotionWriter(folder / MOTION, motion.skeleton, mode="rtof") as writer:
        writer.append(motion)
    write_summary(folder, AuditResult.warning("streams", "keypoints", "Jane is far away"))
    return folder


def write_summary(folder: Path, result: AuditResult) -> None:
    inputs = {"session": SESSION, "subject": {"sex": "female", "height_m": 1.72}}
    about = {"recording": "Roe left knee", "mode": "rtof", "inputs": inputs, "audit": [result.plain()]}
    (folder / "summary.json").write_text(json.dumps(about))


@pytest.mark.parametrize("release", ["fhir.resources.R4B.bundle", "fhir.resources.bundle"])
def test_fhir_resources_reads_observations_with_units_intervals_and_status(
    cli: Any, walk: Path, tmp_path: Path, release: str
) -> None:
    cli.ok("export", walk, tmp_path / "a.json", "--to", "fhir", "--code", "P07")
    text = (tmp_path / "a.json").read_text()
    assert not NAMES.search(text.replace("warn: keypoints: [left out] is far away", ""))
    bundle = importlib.import_module(release).Bundle.model_validate_json(text)
    found = {one.resource.code.coding[0].code: one.resource for one in bundle.entry}
    speed = found["gait_speed"]
    assert (float(speed.valueQuantity.value), speed.valueQuantity.code) == (pytest.approx(1.1, abs=0.01), "m/s")
    parts = {one.code.coding[0].code: one for one in speed.component}
    low, high = (
        float(end.value) for end in (parts["interval_95"].valueRange.low, parts["interval_95"].valueRange.high)
    )
    assert 1.0 < low <= float(speed.valueQuantity.value) <= high < 1.2
    assert parts["repeats"].valueInteger == 6
    assert (speed.subject.identifier.value, str(speed.effectiveDateTime)) == ("P07", "2026-01-31")
    assert (speed.status, speed.note[0].text) == ("preliminary", "warn: keypoints: [left out] is far away")
    assert found["gait_cadence"].valueQuantity.code == "/min"
    assert float(found["left_step_length"].valueQuantity.value) == pytest.approx(0.66, abs=0.05)
    knee = found["right_knee_flexion_range"].valueQuantity
    assert (knee.code, 30 < float(knee.value) < 80) == ("deg", True)
    write_summary(walk, AuditResult("truth", "error", "joints", 0.5, "deg", 1.0, 2.0))
    cli.ok("export", walk, tmp_path / "b.json", "--to", "fhir")
    assert '"final"' in (tmp_path / "b.json").read_text()
    assert '"value": "01"' in (tmp_path / "b.json").read_text()  # a name is no code


def test_redcap_has_the_row_and_the_dictionary_of_every_person(
    cli: Any, walk: Path, reconstructed: Path, tmp_path: Path
) -> None:
    dictionaries = []
    for folder, code in ((walk, "P07"), (reconstructed, "P08")):
        cli.ok("export", folder, tmp_path / code, "--to", "redcap", "--code", code)
        dictionaries.append((tmp_path / code / DICTIONARY).read_text())
        with (tmp_path / code / ROW).open(newline="") as stream:
            (row,) = csv.DictReader(stream)
        assert row["record_id"] == code
        if folder == walk:
            walked = row
    assert dictionaries[0] == dictionaries[1]
    fields = list(csv.DictReader(io.StringIO(dictionaries[0])))
    names = [one["Variable / Field Name"] for one in fields]
    assert len(fields[0]) == 18
    assert [*walked] == [*names, "rtof_kin_complete"]
    assert len({*names}) == len(names)
    assert all(re.fullmatch("[a-z][a-z0-9_]{0,25}", name) for name in names)
    speed = fields[names.index("gait_speed")]
    assert (speed["Field Note"], speed["Text Validation Type OR Show Slider Number"]) == ("m/s", "number")
    assert float(walked["gait_speed_lo"]) <= float(walked["gait_speed"]) == pytest.approx(1.1, abs=0.01)
    assert 30 < float(walked["r_knee_flexi_rom"]) < 80
    assert (walked["verdict"], walked["recorded_on"], walked["rtof_kin_complete"]) == ("warn", "2026-01-31", "1")
    assert not NAMES.search(" ".join(walked.values()))


def test_pydicom_reads_the_report_in_the_file_and_uids_are_the_same_again(cli: Any, walk: Path, tmp_path: Path) -> None:
    writer = pypdf.PdfWriter()
    writer.add_blank_page(width=210, height=297)
    writer.write(tmp_path / "report.pdf")
    files = [tmp_path / "a.dcm", tmp_path / "b.dcm"]
    for file in files:
        cli.ok("export", walk, file, "--to", "dicom", "--pdf", tmp_path / "report.pdf", "--code", "P07")
    assert files[0].read_bytes() == files[1].read_bytes()
    found = pydicom.dcmread(files[0], force=False)
    assert found.SOPClassUID == found.file_meta.MediaStorageSOPClassUID == "1.2.840.10008.5.1.4.1.1.104.1"
    assert all(uid.is_valid and uid.startswith("2.25.") for uid in (found.StudyInstanceUID, found.SOPInstanceUID))
    document = found.EncapsulatedDocument[: found.EncapsulatedDocumentLength]
    assert document == (tmp_path / "report.pdf").read_bytes()
    assert len(pypdf.PdfReader(io.BytesIO(document)).pages) == 1
    assert (found.PatientID, str(found.PatientName), found.PatientSex, found.StudyDate) == ("P07", "", "F", "20260131")
    assert not NAMES.search(str(found))
    said = "name a PDF of the report by --pdf"
    assert said in cli.refused("export", walk, tmp_path / "c.dcm", "--to", "dicom").err
    wrong = ("--to", "dicom", "--pdf", walk / "summary.json")
    assert said in cli.refused("export", walk, tmp_path / "c.dcm", *wrong).err
    assert "write letters" in cli.refused("export", walk, tmp_path / "c.dcm", "--to", "fhir", "--code", "Jane Roe").err


def test_bids_has_the_sensors_of_the_recording_and_refuses_another(
    cli: Any, short: Path, reconstructed: Path, tmp_path: Path
) -> None:
    command = ("export", reconstructed, tmp_path / "bids", "--to", "bids")
    assert "name its folder by --recording" in cli.refused(*command).err
    cli.ok(*command, "--recording", short, "--code", "P-07")
    log = read_sensor_log(tmp_path / "bids/sub-P07/motion/sub-P07_task-motion_tracksys-imu_motion.tsv")
    imus = Recording.load(short).imus
    assert imus is not None
    assert log.names == imus.names
    for s, stream in enumerate(log.streams):
        np.testing.assert_allclose(stream.times, imus.times, atol=1e-6)
        np.testing.assert_allclose(stream.f_sensor, imus.f_sensor[:, s], atol=1e-6)
        np.testing.assert_allclose(stream.R_inertial_sensor, imus.R_inertial_sensor[:, s], atol=1e-6)
