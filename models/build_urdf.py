"""Write the URDF files beside the skeleton tables they are made from.

::

    python models/build_urdf.py            write models/skeleton.urdf and models/human36m.urdf
    python models/build_urdf.py --check    change nothing; exit code 1 if a file differs from its table
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rtof_kin.body.skeleton_table import read_skeleton_table
from rtof_kin.body.urdf import to_urdf

MODELS = Path(__file__).parent
NAMES = ("skeleton", "human36m")


def main(arguments: Sequence[str] | None = None, folder: Path = MODELS) -> int:
    """Write or check every URDF; returns the exit code.

    Args:
        arguments: of the command line; ``sys.argv`` where not given.
        folder: where the tables are and the URDF files go.

    Raises:
        FileFormatError: a table cannot be read.
    """
    parser = argparse.ArgumentParser(description="Make the URDF files from the skeleton tables.")
    parser.add_argument("--check", action="store_true", help="only say which URDF differs from its table")
    check = parser.parse_args(arguments).check
    stale = 0
    for name in NAMES:
        path = folder / f"{name}.urdf"
        wanted = to_urdf(read_skeleton_table(folder / f"{name}.toml")).encode()
        if path.is_file() and path.read_bytes() == wanted:
            print(f"{path}: agrees with its table")
        elif check:
            stale += 1
            print(f"{path}: differs from {name}.toml; run python models/build_urdf.py")
        else:
            path.write_bytes(wanted)
            print(f"{path}: written")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
