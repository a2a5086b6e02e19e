"""Run the command line with `python -m pcbench`."""

import sys

from pcbench.cli import main

sys.exit(main())
