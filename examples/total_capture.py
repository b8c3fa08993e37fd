"""The paper's protocol on Total Capture: ``python examples/total_capture.py --root DIR [...]``.

The same as ``rtof-kin evaluate total-capture``; ``--help`` lists the options, docs/datasets.md how to get the data.
"""

import sys

from rtof_kin.cli import main

if __name__ == "__main__":  # the measurements run in processes of their own
    sys.exit(main(["evaluate", "total-capture", *sys.argv[1:]]))
