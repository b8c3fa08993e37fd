"""Public data sets that the user has: the papers' protocols and errors of joint angles, one `run` for all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from rtof_kin.core.jobs import Outcome
    from rtof_kin.reporting.document import Document

SETS: Final = {
    "total-capture": "the paper's protocol and tables on Total Capture",
    "human36m": "the paper's protocol and table on Human3.6M, vision alone",
    "opencap": "joint angles on OpenCap's laboratory validation",
    "vidimu": "joint angles on VIDIMU",
    "movi": "joint angles on BML-MoVi",
    "gaitex": "joint angles on GAITEX",
}
"""Name of a data set -> what `run` measures on it; layouts: docs/datasets.md and docs/validate.md."""


class Measured(NamedTuple):
    """What was measured on a data set."""

    document: Document
    outcome: Outcome
    written: list[Path]  #: Files
    problem: str  #: Why nothing could be measured; '' if something was


def protocol_of(name: str) -> type[Any]:
    """Return the settings' class of the protocol of one of `SETS`; its first field is the data set's folder.
    `UnknownNameError`: there is no such data set.
    """
    from rtof_kin.core.checks import indices_of

    indices_of("data set", [name], list(SETS))
    if name == "total-capture":
        from rtof_kin.protocols.total_capture import TotalCaptureProtocol

        return TotalCaptureProtocol
    if name == "human36m":
        from rtof_kin.protocols.human36m import Human36MProtocol

        return Human36MProtocol
    from rtof_kin.protocols.validation import ValidationProtocol

    return ValidationProtocol


def run(
    name: str,
    root: str | Path,
    folder: str | Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    json_file: Path | None = None,
    **settings: Any,
) -> Measured:
    """Measure on a data set what has no result yet, and write tables, figures and JSON.

    Args:
        name: one of `SETS`. root: folder of the data set.
        folder: for the results; a run of the same settings is resumed.
        overwrite: whether results of other settings may be replaced.
        workers: number of processes, one per core by default. progress: see `rtof_kin.core.jobs.Progress`.
        json_file: a copy of the JSON.
        settings: fields of `protocol_of`.

    Raises:
        UnknownNameError: there is no such data set, or a name in the settings. InvalidInputError: of a setting.
        FileFormatError: the folder has no such data set. OutputExistsError: other results or files are there.
    """
    from rtof_kin.protocols.tables import CALIBRATION, check_json_file, write_results

    folder = Path(folder)
    if json_file is not None:
        check_json_file(folder, json_file, overwrite)
    own = {} if name in ("total-capture", "human36m") else {"dataset": name}
    protocol = protocol_of(name)(Path(root), **own, **settings)
    outcome = protocol.run(folder, overwrite=overwrite, workers=workers, progress=progress)
    document = protocol.document(outcome)
    written = write_results(document, folder, json_file, overwrite)
    problem = ""
    if outcome.failed and all(facts["methods"].keys() <= CALIBRATION for facts in outcome.done.values()):
        problem = f"nothing could be measured; first of all: {next(iter(outcome.failed.values()))}"
    return Measured(document, outcome, written, problem)
