"""Files that ship with the package: skeleton tables, the URDF, trained lifters."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.errors import FileFormatError

PACKAGED = Path(__file__).parent / "models"
"""Where an installed package carries its models."""
CHECKOUT = Path(__file__).parent.parent / "models"
"""Where a checkout of the source keeps the same files."""


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
