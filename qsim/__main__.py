"""Runs the command `qsim` as `python -m qsim`."""

import sys

from qsim.cli.program import main

if __name__ == "__main__":
    sys.exit(main())
