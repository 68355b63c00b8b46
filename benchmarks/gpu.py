"""Measures on a machine with a GPU what other machines cannot tell, in pieces that continue where they stopped.

    python benchmarks/gpu.py OUT [--section NAME] [--minutes 9] [--wheels FOLDER]

Every measurement is a child process (gpu/child.py) that writes one file, OUT/SECTION/NAME.json. The same command again
does what is missing; OUT/table.md and OUT/table.json hold everything so far. This program needs Python alone, so that
it can tell which packages are missing; its measurements need qsim's and quiver's. Page: docs/gpu.md.
"""

import signal
import sys
from pathlib import Path

if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036
        print(f"gpu.py: {sys.executable} is Python {sys.version.split()[0]}; use 3.11 or newer", file=sys.stderr)
        sys.exit(2)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also where SIGINT is ignored, as in the background
    sys.path[0] = str(Path(__file__).resolve().parent / "gpu")
    from pieces import main

    sys.exit(main())
