"""``python -m lifting ...``: the same as ``rtof-kin train ...``."""

import sys

from rtof_kin.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
