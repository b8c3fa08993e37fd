"""The paper's protocol on Human3.6M: ``python examples/human36m.py --root DIR --model FILE [...]``.

The same as ``rtof-kin evaluate human36m``; ``--help`` lists the options, docs/datasets.md how to get the data.
"""

import sys

from rtof_kin.cli import main

if __name__ == "__main__":  # the measurements run in processes of their own
    sys.exit(main(["evaluate", "human36m", *sys.argv[1:]]))
