"""A folder that lasts as long as the objects that refer to it."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from pathlib import Path


class TemporaryFolder:
    """A folder that is deleted with the last object that refers to it, in the process that made it.

    Copies of an object refer to the same folder. One that was pickled uses it as long as those of the process do.
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="qsim-"))
        weakref.finalize(self, _delete, self.path, os.getpid())

    def __copy__(self) -> TemporaryFolder:
        return self

    def __deepcopy__(self, known: dict[int, object]) -> TemporaryFolder:
        return self


def _delete(path: Path, owner: int) -> None:
    if os.getpid() == owner:  # a forked worker has its copy of every object
        shutil.rmtree(path, ignore_errors=True)
