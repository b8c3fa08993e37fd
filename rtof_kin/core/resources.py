"""Files that ship with the package: skeleton tables, the URDF, trained lifters."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.core.errors import FileFormatError

PACKAGED = Path(__file__).parents[1] / "models"
"""Where an installed package carries its models."""
CHECKOUT = Path(__file__).parents[2] / "models"
"""Where a checkout of the source keeps the same files."""
LIFTERS = {"detections": "lifter.pt", "perfect": "lifter_perfect.pt", "causal": "lifter_causal.pt"}
"""Lifters that ship with the package, by name. detections: the default, for real detectors. perfect: for
projected ground truth. causal: without delay, for streaming."""
DEFAULT_LIFTER = "detections"


def model_path(name: str) -> Path:
    """The path of a shipped file or folder, found the same way from an installation and from a checkout.

    Args:
        name: file name inside the models folder, e.g. ``"skeleton.toml"``.

    Raises:
        FileFormatError: neither the package nor the checkout holds it; the message lists what is
            there.
    """
    for folder in (PACKAGED, CHECKOUT):
        path = folder / name
        if path.exists():
            return path
    present = sorted(
        path.name for folder in (PACKAGED, CHECKOUT) if folder.is_dir() for path in folder.iterdir()
    )
    raise FileFormatError(
        PACKAGED / name,
        "no such file ships with this installation (there is: "
        f"{', '.join(present) or 'nothing'}); reinstall the package or give a path of your own",
    )


def lifter_path(lifter: str | Path | None) -> Path:
    """The file of a lifter, however it was named; every command and protocol asks here.

    Args:
        lifter: a name in `LIFTERS`, or a file; the default of these where not given.

    Raises:
        FileFormatError: it is neither.
    """
    name = DEFAULT_LIFTER if lifter is None else str(lifter)
    path = model_path(LIFTERS[name]) if name in LIFTERS else Path(name)
    if not path.is_file():
        raise FileFormatError(
            path, "no such file; give the path of a trained lifter, or the name of a shipped one: "
            + ", ".join(LIFTERS),
        )  # fmt: skip
    return path
