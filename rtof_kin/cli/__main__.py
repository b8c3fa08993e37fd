"""``python -m rtof_kin.cli``: the command line without its entry point."""

import sys

from rtof_kin.cli import main

sys.exit(main())
