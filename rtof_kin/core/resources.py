"""Files that ship with the package: skeleton tables, URDFs, trained lifters."""

from __future__ import annotations

import os
from pathlib import Path

from rtof_kin.core.errors import FileFormatError

PACKAGED = Path(__file__).parents[1] / "models"  #: Models folder of an installed package
CHECKOUT = Path(__file__).parents[2] / "models"  #: Models folder of a source checkout
LIFTERS = {"detections": "lifter.npz", "live": "lifter_live.npz"}
"""Shipped lifters. detections: of recordings, sees 81 frames. live: sees 27 as the paper's, with less delay."""
DEFAULT_LIFTER, LIVE_LIFTER = "detections", "live"


def cache_folder() -> Path:
    """Return the folder of compiled functions and downloaded models.

    It is ``RTOF_KIN_CACHE``, or in the user's cache folder, which the system defines.
    """
    from platformdirs import user_cache_path  # slow to import

    given = os.environ.get("RTOF_KIN_CACHE")
    return Path(given) if given else user_cache_path("rtof_kin", appauthor=False)


def model_path(name: str) -> Path:
    """Return the path of a shipped file or folder, e.g. ``"skeleton.toml"``, in an installation or a checkout;
    `FileFormatError`, which lists the files there are, where it does not exist.
    """
    for folder in (PACKAGED, CHECKOUT):
        if (folder / name).exists():
            return folder / name
    present = sorted(path.name for folder in (PACKAGED, CHECKOUT) for path in folder.glob("*"))
    raise FileFormatError(
        PACKAGED / name,
        "no such file ships with this installation (there is: "
        f"{', '.join(present) or 'nothing'}); reinstall the package or give a path of your own",
    )


def lifter_path(lifter: str | Path | None) -> Path:
    """Return the weights file of a lifter: a name in `LIFTERS` or a file, else `FileFormatError`; the default one if
    None.
    """
    name = DEFAULT_LIFTER if lifter is None else str(lifter)
    path = model_path(LIFTERS[name]) if name in LIFTERS else Path(name)
    if not path.is_file():
        names = ", ".join(LIFTERS)
        raise FileFormatError(
            path, f"no such file; give the path of a trained lifter, or the name of a shipped one: {names}"
        )
    return path
