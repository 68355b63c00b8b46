"""Shows progress in notebooks, where a function was not given anything to report to. Elsewhere nothing is shown."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from qsim.files import Progress

SHOWN_AFTER = 1.0  # s, before a bar appears


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook (IPython with a front end)."""
    shell = sys.modules.get("IPython")
    running = None if shell is None else shell.get_ipython()
    return running is not None and getattr(running, "kernel", None) is not None


@contextlib.contextmanager
def reporting(progress: Progress | None, label: str, unit: str = "frame") -> Iterator[Progress | None]:
    """Give what a function reports (done, total) to: `progress`, or a bar in a notebook, or None."""
    if progress is not None or not in_notebook():
        yield progress
        return
    from tqdm import tqdm

    with tqdm(desc=label, unit=unit, file=sys.stdout, delay=SHOWN_AFTER) as shown:

        def update(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield update
