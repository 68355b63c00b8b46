"""Runs the command line: `python -m quiver`."""

import sys

from quiver.cli.program import main

sys.exit(main())
