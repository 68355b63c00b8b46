"""`python -m quiver`."""

import sys

from quiver.cli import main

sys.exit(main())
