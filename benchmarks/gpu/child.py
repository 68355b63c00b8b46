"""Makes one measurement, or the list of all: reads its job from standard input and writes one record.

A record holds `state` (done, failed, absent, unfinished), `why`, `rows` for the tables, and what the job asks to keep.
The process ends with the one that started it.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from folder import write
from job import SECTIONS, Absent, Job


def end_with_parent() -> None:
    """End this process and its children when the pipe of its parent closes."""
    while os.read(0, 1 << 16):
        pass
    os.killpg(0, signal.SIGKILL)


def plan(job: Job) -> dict[str, list[str]]:
    """Return the names of all measurements; a section that cannot name them has "all", which tells why."""
    found = {}
    for section in SECTIONS:
        try:
            found[section] = importlib.import_module(section).names(job.sizes)
        except Exception:
            traceback.print_exc()
            found[section] = ["all"]
    return found


def measured(job: Job) -> dict[str, Any]:
    """Return what a measurement adds to its record."""
    started = time.perf_counter()
    try:
        section = importlib.import_module(job.section)
        section.names(job.sizes)  # where the list was not made: the reason
        rows = section.measure(job)
        rows = [{name: finite(value) for name, value in row.items()} for row in rows]
        found = {"state": "unfinished" if job.stopped else "done", "rows": rows}
    except Absent as reason:
        found = {"state": reason.state, "why": str(reason)}
    except ModuleNotFoundError as error:
        traceback.print_exc()
        why = f"needs the package {error.name}, which is not installed; install it, or name wheels with --wheels FOLDER"
        found = {"state": "absent", "why": why}
    except Exception as error:
        traceback.print_exc()
        found = {"state": "failed", "why": f"{type(error).__name__}: {' '.join(str(error).split())}"[:1000]}
    return found | {"seconds": time.perf_counter() - started}


def finite(value: Any) -> Any:
    """Return a value for JSON, which knows neither NaN nor infinity: None instead of them."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    """Read the job, make it, write its record."""
    line = b""
    while not line.endswith(b"\n"):
        letter = os.read(0, 1)
        if not letter:
            return None  # the parent was killed before it told the job
        line += letter
    threading.Thread(target=end_with_parent, daemon=True).start()
    told = json.loads(line)
    if told["section"] == "table":
        from table import write_tables

        return write_tables(Path(told["out"]))
    job = Job.of(told)
    if job.section == "plan":
        return write(job.result, {"result": plan(job)})
    return write(job.result, job.record | measured(job))


if __name__ == "__main__":
    main()
