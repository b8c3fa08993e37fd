"""A result for a hospital or a study: FHIR, REDCap and DICOM of its summary and report, Motion-BIDS of its numbers.

The person is a code: the one that is given, else the label of the session where it has a digit and no blank, such as
P07, else 01. Names in sentences of the summary are left out as in an archive (`reporting.archive`).
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple
from uuid import NAMESPACE_OID, UUID, uuid5

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_folder, motion_path
from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.comparison import HEADINGS
from rtof_kin.clinical.comparison_change import LEVEL, Measured
from rtof_kin.clinical.follow_up import measurement_errors
from rtof_kin.clinical.laboratory import means
from rtof_kin.clinical.visits import SCALES, measures_of, trial
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.folder import new_file, new_folder
from rtof_kin.core.files.manifest import file_digest
from rtof_kin.core.files.text import load_json, write_text
from rtof_kin.core.packages import optional
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.formats.bids import DESCRIPTION, motion_system, sensor_systems, write_bids
from rtof_kin.recording.index import index_of
from rtof_kin.recording.sensor_files import maker_log
from rtof_kin.reporting.archive import LEFT_OUT, identifying, recording_of
from rtof_kin.reporting.audit_results import Grade, headline
from rtof_kin.reporting.document import Table, write_csv
from rtof_kin.reporting.summary_file import SUMMARY, Summary, read_summary
from rtof_kin.reporting.summary_lines import is_second_sequence

CODES: Final = "urn:oid:2.25.4604052808977289117835689821819633856"
"""System of FHIR's codes: the names of quantities, and 'interval_95' and 'repeats' of components."""
ROW: Final = "redcap.csv"
DICTIONARY: Final = "redcap_data_dictionary.csv"
SOFTWARE: Final = f"rtof_kin {version('rtof_kin')}"
_CATEGORY: Final = "http://terminology.hl7.org/CodeSystem/observation-category"
_GAIT: Final = {"gait_speed": "m/s", "gait_cadence": "steps/min"}
_OF_SIDE: Final = {"step_length": "m", "stride_length": "m", "stride_time": "s", "stance_share": "%"}
_SHORT: Final = {"right": "r", "left": "l", "range": "rom"}
_COLUMNS: Final = (
    *("Variable / Field Name", "Form Name", "Section Header", "Field Type", "Field Label"),
    *("Choices, Calculations, OR Slider Labels", "Field Note", "Text Validation Type OR Show Slider Number"),
    *("Text Validation Min", "Text Validation Max", "Identifier?", "Branching Logic (Show field only if...)"),
    *("Required Field?", "Custom Alignment", "Question Number (surveys only)", "Matrix Group Name", "Matrix Ranking?"),
    "Field Annotation",
)  #: Of a data dictionary of REDCap


class Quantity(NamedTuple):
    """One quantity of a summary, in the unit of output; NaN where it is not known."""

    name: str  #: E.g. 'right_knee_flexion_range', 'gait_speed', 'left_step_length'
    unit: str
    value: float
    half: float  #: Half of the 95 % interval
    repeats: int  #: Strides that it is the mean of; 1 of the whole recording


def quantities(folder: Path) -> list[Quantity]:
    """Return all quantities of a motion, the same of every one: measures of gait and ranges of all angles. Intervals
    contain the bands, and the variation of strides.
    """
    with MotionReader(motion_path(folder)) as reader:
        found = trial("", reader)
    gait, known = found.analysis.gait, {one.name: own for one, own in measures_of(found, "range").items()}
    if gait.is_gait:
        known |= {one.name: own for one, own in measures_of(found, "cycle").items() if one.is_gait}
        steps = {side: value for name, side, _, value in means(gait) if name == "Step Length"}
        known |= {f"{side}_step_length": Measured(np.array([value]), 0.0) for side, value in steps.items()}
    units = _GAIT | {f"{side}_{name}": unit for side in SIDES for name, unit in _OF_SIDE.items()}
    rows = [row.name for row in found.analysis.angles.rows if not (row.about_vertical or row.name in HEADINGS)]
    units |= {f"{name}_range": "deg" for name in rows if not is_second_sequence(name)}
    out = []
    for name, unit in units.items():
        own = known.get(name, Measured(np.array([np.nan]), 0.0))
        half = measurement_errors([own]).of_means(own).half_width(LEVEL)
        out.append(Quantity(name, unit, SCALES[unit] * own.mean, SCALES[unit] * half, len(own.values)))
    return out


@dataclass(frozen=True)
class Result:
    """What a hospital's file says of a result."""

    folder: Path
    summary: Summary
    code: str  #: Of the person
    grade: Grade
    sentence: str  #: First line of the audit, without names
    recording: Path | None = None  #: What it was made from; default: that in the output of `run`, or the demo
    pdf: Path | None = None  #: The report, printed

    @classmethod
    def of(cls, motion: Path, code: str = "", **files: Path | None) -> Result:
        """Read a result; `InvalidInputError`: no such code; other errors as `read_summary`."""
        if code and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", code):
            raise InvalidInputError(f"--code {code!r}: write letters, digits, - and _, such as P07")
        summary = read_summary((folder := motion_folder(motion)) / SUMMARY)
        label, overall = summary.session.subject, headline(summary.results or ())
        names = identifying(summary.session, (summary.recording,))
        code = code or (label if re.fullmatch(r"[A-Za-z]{0,6}[-_.]?\d[A-Za-z0-9]*", label) else "01")
        return cls(folder, summary, code, overall.grade, names.sub(LEFT_OUT, overall.line), **files)

    def uuid(self, name: str) -> UUID:
        """Return the same for the same motion and name."""
        return uuid5(NAMESPACE_OID, f"{file_digest(motion_path(self.folder))} {name}")


def write_fhir(path: Path, result: Result, overwrite: bool = False) -> None:
    """Write a Bundle of Observations of FHIR R4B that fhir.resources has validated: final where the verdict is a pass,
    else preliminary, with its line as a note. Errors as `new_file`.
    """
    bundle = optional("fhir.resources.R4B.bundle", "clinical", "FHIR")
    common = {
        **{"resourceType": "Observation", "status": "final" if result.grade is Grade.PASS else "preliminary"},
        **{"category": [{"coding": [{"system": _CATEGORY, "code": "exam"}]}], "note": [{"text": result.sentence}]},
        **{"subject": {"identifier": {"value": result.code}}, "device": {"display": SOFTWARE}},
    } | ({"effectiveDateTime": day} if (day := result.summary.session.date) else {})
    entries = []
    for one in (one for one in quantities(result.folder) if np.isfinite(one.value)):
        unit = {"unit": one.unit, "system": "http://unitsofmeasure.org", "code": one.unit.removeprefix("steps")}
        low, value, high = ({"value": round(end, 4), **unit} for end in _ends(one))
        parts: list[dict[str, Any]] = [{"code": _coded("repeats"), "valueInteger": one.repeats}]
        if np.isfinite(one.half):
            parts.append({"code": _coded("interval_95"), "valueRange": {"low": low, "high": high}})
        own = {"code": _coded(one.name), "valueQuantity": value, "component": parts}
        entries.append({"fullUrl": result.uuid(one.name).urn, "resource": common | own})
    whole = {"resourceType": "Bundle", "type": "collection", "entry": entries}
    bundle.Bundle.model_validate(whole)
    write_text(path, json.dumps(whole, indent=2) + "\n", overwrite)


def _coded(name: str) -> dict[str, Any]:
    return {"coding": [{"system": CODES, "code": name}], "text": name.replace("_", " ")}


def _ends(one: Quantity) -> tuple[float, float, float]:
    return max(one.value - one.half, 0.0), one.value, one.value + one.half


def write_redcap(folder: Path, result: Result, overwrite: bool = False) -> None:
    """Write the row of a record and the data dictionary of the project that imports it; errors as `new_folder`."""
    rows = [  # name, type, label, unit, validation, value
        ("record_id", "text", "code of the person", "", "", result.code),
        ("recorded_on", "text", "day of the recording", "", "date_ymd", result.summary.session.date),
        ("software", "text", "software", "", "", SOFTWARE),
        ("verdict", "text", "verdict of the audit", "", "", result.grade.value),
        ("verdict_sentence", "notes", "why", "", "", result.sentence),
    ]
    for one in quantities(result.folder):
        field = "_".join(_SHORT.get(word, word[:5]) for word in one.name.split("_") if word != "of")
        for end, which, value in zip(("_lo", "", "_hi"), ("least of ", "", "most of "), _ends(one), strict=True):
            said, shown = which + one.name.replace("_", " "), f"{value:.4f}" if np.isfinite(value) else ""
            rows.append((field + end, "text", said, one.unit, "number", shown))
    fields = [(a, "rtof_kin", "", b, c, "", d, e, *[""] * (len(_COLUMNS) - 8)) for a, b, c, d, e, _ in rows]
    rows.append(("rtof_kin_complete", "", "", "", "", "2" if result.grade is Grade.PASS else "1"))  # else unverified
    with new_folder(folder, ROW, overwrite) as new:
        write_csv(new / DICTIONARY, Table(_COLUMNS, fields))
        write_csv(new / ROW, Table([row[0] for row in rows], [[row[-1] for row in rows]]))


def write_dicom(path: Path, result: Result, overwrite: bool = False) -> None:
    """Write the report as an Encapsulated PDF of DICOM (part 3, A.45.1); errors as `new_file`, and
    `InvalidInputError`: no PDF.
    """
    pydicom, uid = (optional(name, "clinical", "DICOM") for name in ("pydicom", "pydicom.uid"))
    if (pdf := result.pdf) is None or not pdf.is_file() or not (document := pdf.read_bytes()).startswith(b"%PDF-"):
        raise InvalidInputError("--to dicom: name a PDF of the report by --pdf, from the application or any browser")
    day, sex = result.summary.session.date.replace("-", ""), result.summary.subject.get("sex") or ""
    study, series, instance = (f"2.25.{result.uuid(name).int}" for name in ("study", "series", file_digest(pdf)))
    data, empty = pydicom.Dataset(), "PatientBirthDate StudyID AccessionNumber ReferringPhysicianName StudyTime"
    for name, value in {
        **{"SOPClassUID": uid.EncapsulatedPDFStorage, "SOPInstanceUID": instance, "InstanceNumber": 1},
        **{"StudyInstanceUID": study, "SeriesInstanceUID": series, "SeriesNumber": 1, "Modality": "DOC"},
        **{"PatientID": result.code, "Manufacturer": SOFTWARE, "StudyDate": day, "ContentDate": day},
        **{"SpecificCharacterSet": "ISO_IR 192", "BurnedInAnnotation": "YES", "VerificationFlag": "UNVERIFIED"},
        **dict.fromkeys(f"PatientName {empty} ContentTime AcquisitionDateTime".split(), ""),
        **{"PatientSex": {"male": "M", "female": "F"}.get(sex, ""), "ConceptNameCodeSequence": []},
        **{"ConversionType": "WSD", "DocumentTitle": f"Human motion. {result.sentence}"[:1024]},
        **{"MIMETypeOfEncapsulatedDocument": "application/pdf", "EncapsulatedDocumentLength": len(document)},
        "EncapsulatedDocument": document + b"\0" * (len(document) % 2),
    }.items():
        setattr(data, name, value)
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = uid.ExplicitVRLittleEndian
    with new_file(path, overwrite) as whole:
        data.save_as(whole, enforce_file_format=True)


def write_motion_bids(folder: Path, result: Result, overwrite: bool = False) -> None:
    """Write a data set of the recorded sensors and the motion, in blocks; errors as `recording_of` and `new_folder`."""
    with recording_of(result.folder, load_json(result.folder / SUMMARY), result.recording) as (source, found):
        index, log = index_of(source).imus, None
        if index is not None and (stream := found.streams.imus) is not None:
            names = stream.part(slice(0, 1)).names
            log = maker_log(index, found.facts.skeleton, names) or SensorLog.of_imus(stream, source)
    with MotionReader(motion_path(result.folder)) as reader, new_folder(folder, DESCRIPTION, overwrite) as new:
        systems = chain(sensor_systems(log) if log is not None else (), [motion_system(reader)])
        write_bids(new, systems, re.sub("[^A-Za-z0-9]", "", result.code), result.summary.subject)


WRITERS: Final = {"bids": write_motion_bids, "fhir": write_fhir, "redcap": write_redcap, "dicom": write_dicom}
"""By the names of `export`."""
