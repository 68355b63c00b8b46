"""Shares options between the commands, and handles folders to replace and signals."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from qsim.cli.console import note, running
from qsim.files import check_ours, sync_folder
from qsim.kinds import Whole
from qsim.settings import setting
from quiver.evaluation.settings import EvaluateSettings
from quiver.restoration.interface import AUTO
from quiver.restoration.settings import RestoreSettings


@dataclass(frozen=True)
class Threads:
    """The number of torch's threads."""

    threads: Annotated[Whole | None, setting("torch threads on the CPU", unset="measured at start")] = None


@dataclass(frozen=True)
class ResumedThreads:
    """The number of torch's threads of a command that keeps it when it resumes its work."""

    threads: Annotated[
        Whole | None,
        setting("torch threads on the CPU", unset="measured at start; resumed work keeps its number"),
    ] = None


def use_threads(wanted: int | None, earlier: int | None = None) -> int:
    """Set the number of torch's threads, and print it with --verbose."""
    from quiver import threads

    chosen = threads.use(wanted, earlier)
    if running().printing.verbose:
        note(f"threads: {chosen}")
    return chosen.number


def given(*records: Any) -> dict[str, Any]:
    """Return those values of records that stand on the command line."""
    names = running().given
    return {name: value for record in records for name, value in vars(record).items() if name in names}


def check_domain(
    asked: RestoreSettings | EvaluateSettings, methods: Sequence[Any], streams: Iterable[Any], shown: int | None = None
) -> list[str]:
    """Print a line for each network outside of what it was measured for; `ValueError` where they are `strict`.

    Of many lines only the first `shown` are printed, and how many follow.
    """
    from quiver.restoration.interface import measured_at, refuse_outside, remarks

    found: list[str] = []
    for codes in streams:
        found += [text for text in remarks(methods, codes) if text not in found]
        if asked.strict:
            refuse_outside(methods, found, "--strict", named=getattr(asked, "method", None) != AUTO)
        if running().printing.verbose:
            for text in filter(None, (measured_at(method, codes) for method in methods)):
                note(f"quiver: {text}")
    for text in found[:shown]:
        note(f"quiver: warning: {text}")
    if shown is not None and len(found) > shown:
        note(f"quiver: warning: {len(found) - shown} more lines of this kind, for other streams")
    return found


def renew(folder: Path, mark: str, ours: str) -> None:
    """Empty a folder whose lock the caller holds; the lock stays, and the file `mark`, by which it is known, goes last.

    `FileExistsError` if it holds files whose names do not match the pattern `ours`.
    """
    check_ours(folder, ours)
    for path in sorted(folder.iterdir(), key=lambda path: path.name == mark):
        if path.name == mark:
            sync_folder(folder)  # after a power cut nothing is left without it
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()
