"""Analysis of a reconstructed motion in a folder: `analyse`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.analysis import MotionAnalysis, analyse_motion
from rtof_kin.clinical.files import MARKER, write_analysis
from rtof_kin.clinical.repetitions import Kind
from rtof_kin.core.files.folder import check_replaceable, new_folder
from rtof_kin.core.packages import can_draw
from rtof_kin.reporting.document import Document, write_files
from rtof_kin.reporting.summary_file import SUMMARY, read_summary


@dataclass(frozen=True)
class AnalysisSettings:
    """What is analysed."""

    weight_kg: float | None = None
    """Body mass, kg, for joint torques; default: that of the recording."""
    sex: Literal["male", "female"] | None = None
    """Sex of the subject, of the tables of body mass."""
    height: float | None = None
    """Standing height, m, that the size of the skeleton is checked with."""
    repetitions: Kind | None = None
    """Movement that is counted."""
    from_standing: bool = False
    """Angles of trunk and legs relative to half a second or more of the person's quiet standing."""


def analyse(
    motion: str | Path | Motion,
    output: str | Path | None = None,
    settings: AnalysisSettings | None = None,
    *,
    figures: bool = True,
    overwrite: bool = False,
    documents: Sequence[Document] = (),
    inputs: Mapping[str, str] | None = None,
) -> MotionAnalysis:
    """Analyse a motion: joint angles by clinical names, ranges of motion, gait, repetitions and torques.

    >>> found = analyse("motion")
    >>> found.ranges[0].name
    'pelvis_tilt'
    >>> found.gait.is_gait
    False

    Args:
        motion: output folder of `reconstruct` or `run`, its motion file, or a motion.
        output: folder to write: tables of angles, ranges, gait cycles and torques, and figures.
        figures: draw figures, where matplotlib is installed. overwrite: replace an earlier analysis there.
        documents: of the same motion, such as its gait scores, that are written below it.
        inputs: fingerprints for the folder's manifest.

    Raises:
        OutputExistsError: the folder may not be replaced. Errors of `analyse_motion` and of the files.
    """
    settings = settings or AnalysisSettings()
    if output is not None:
        check_replaceable(output, MARKER, overwrite)
    weight, sex = settings.weight_kg, settings.sex
    if isinstance(motion, Motion):
        analysis = _analysed(motion, settings, weight, sex)
    else:
        path = motion_path(motion)
        summary = path.parent / SUMMARY
        subject = read_summary(summary).subject if summary.exists() else {}
        weight = weight if weight is not None else subject.get("mass_kg")
        sex = sex or (subject.get("sex") if weight is not None else None)
        with MotionReader(path) as reader:
            analysis = _analysed(reader, settings, weight, sex)
    if output is not None:
        with new_folder(output, MARKER, overwrite, inputs) as folder:
            write_analysis(analysis, folder)
            if figures and can_draw():
                from rtof_kin.reporting.clinical_figures import write_clinical_figures

                write_clinical_figures(analysis, folder / "figures")
            for document in documents:
                (folder / document.name).mkdir()
                write_files(document if figures else replace(document, figures=()), folder / document.name)
    return analysis


def _analysed(
    motion: Motion | MotionSource, settings: AnalysisSettings, weight_kg: float | None, sex: str | None
) -> MotionAnalysis:
    return analyse_motion(
        motion,
        weight_kg=weight_kg,
        height=settings.height,
        sex=sex,
        repetitions=settings.repetitions,
        from_standing=settings.from_standing,
    )
