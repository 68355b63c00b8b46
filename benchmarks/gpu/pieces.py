"""Runs the measurements that are missing, each in a child process, until a piece ends."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from folder import ROOT, Wrong, opened, read, read_record, setup, write
from job import QUARTER, QUARTER_MINUTES, SECTIONS
from wheels import install

CHILD = (sys.executable, str(Path(__file__).with_name("child.py")))
SLEEPING = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}  # as quiver.threads has it for commands
LAST_SHARE = 0.1  # of a piece, in which nothing is started
ENDED = ("done", "failed", "absent", "late")  # states of a record that is not made again as it is
LISTING = 600.0  # s, limit of the list of measurements, and of the table
REASON = 300  # letters of a reason that a record keeps


@dataclass(frozen=True)
class Piece:
    """One call: where it writes, what it measures, and when it ends."""

    out: Path
    section: str | None  # None: all
    minutes: float
    sizes: dict[str, Any]  # what differs from the sizes in gpu/sizes.py
    child: tuple[str, ...]  # the command of a measurement
    quarter: bool = False  # what a quarter of an hour measures, in its order

    @property
    def packages(self) -> Path:
        """Where the wheels are installed."""
        return self.out / "packages"


def arguments(argv: list[str]) -> argparse.Namespace:
    """Return the checked arguments; argparse ends the program with code 2 where they are wrong."""
    about = "Measure what only a machine with a GPU can tell; the same command again continues."
    parser = argparse.ArgumentParser("benchmarks/gpu.py", description=about)
    parser.add_argument("out", type=Path, help="folder of the results; the same command continues there")
    parser.add_argument(
        "--section", choices=(*SECTIONS, "table"), help="measure one section; what failed in it is tried again"
    )
    parser.add_argument(
        "--quarter", action="store_true", help="what a quarter of an hour tells, in order of worth; then train QUIVER"
    )
    parser.add_argument(
        "--minutes", type=_minutes, help=f"length of this piece (default 9; with --quarter {QUARTER_MINUTES:g})"
    )
    parser.add_argument("--wheels", type=Path, help="folder of .whl files for packages that this machine lacks")
    given = parser.parse_args(argv)
    if given.quarter and given.section is not None:
        parser.error("--quarter has its own list of measurements; leave --section out")
    if given.minutes is None:
        given.minutes = QUARTER_MINUTES if given.quarter else 9.0
    return given


def _minutes(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise argparse.ArgumentTypeError(f"expected a number of minutes above 0, got {text!r}")


def planned(piece: Piece) -> dict[str, list[str]]:
    """Return the names of all measurements by section; a section that cannot tell has the one name "all"."""
    path = piece.out / "plan.json"
    path.unlink(missing_ok=True)
    job = {"section": "plan", "name": "plan", "out": str(piece.out), "sizes": piece.sizes, "record": {}}
    why = run_child(piece, job, path, LISTING)
    plan = (read(path) or {}).get("result")
    if why is not None or not isinstance(plan, dict):
        raise Wrong(
            f"the list of measurements was not made ({why or 'no answer'}); see {log_of(piece, 'plan', 'plan')}"
        )
    for section, names in plan.items():
        if names != ["all"]:
            (piece.out / section / "all.json").unlink(missing_ok=True)
    return {section: plan[section] for section in SECTIONS}


def record_of(piece: Piece, section: str, name: str) -> dict[str, Any] | None:
    """Return the record of a measurement; None if it is missing or damaged."""
    return read_record(piece.out / section / f"{name}.json")


def is_open(record: dict[str, Any] | None, piece: Piece, section: str, now: dict[str, Any]) -> bool:
    """Return whether a measurement has to be made: it is missing, or what hindered it may have changed."""
    if record is None or record["state"] not in ENDED:
        return True
    changed = record["setup"] != now
    if record["state"] == "done":
        return section == "doctor" and changed
    longer = record["state"] == "late" and piece.minutes > record["minutes"]
    return changed or longer or piece.section == section


def log_of(piece: Piece, section: str, name: str) -> Path:
    """Return the file that receives what a measurement prints."""
    return piece.out / "log" / f"{section}.{name}.txt"


def run_child(piece: Piece, job: dict[str, Any], result: Path, seconds: float) -> str | None:
    """Run one measurement in a process group with an end; return why there is no result, None if there is one.

    The child ends with this process: it reads its job from a pipe, whose end it notices.
    """
    log = log_of(piece, job["section"], job["name"])
    log.parent.mkdir(exist_ok=True)
    given = [os.path.abspath(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    path = os.pathsep.join([str(piece.packages), str(ROOT), *given])
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}  # hides gpu/ from it
    before = result.stat().st_mtime_ns if result.exists() else None
    with open(log, "wb") as text:
        process = subprocess.Popen(
            piece.child,
            stdin=subprocess.PIPE,
            stdout=text,
            stderr=text,
            start_new_session=True,
            env=SLEEPING | inherited | {"PYTHONPATH": path},
            cwd=piece.out,
        )
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):
                told = job | {"result": str(result), "seconds": seconds, "end": time.monotonic() + seconds}
                process.stdin.write(json.dumps(told).encode() + b"\n")
                process.stdin.flush()
            code = process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            return None if changed(result, before) else "late"
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
    if code == 0 and changed(result, before):
        return None
    lines = log.read_text(errors="replace").strip().splitlines()
    ended = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"its process ended with {ended}{': ' + lines[-1][:REASON] if lines else ''}"


def changed(result: Path, before: int | None) -> bool:
    """Return whether a file was written since its time was `before` (None: it was missing)."""
    return result.exists() and result.stat().st_mtime_ns != before


def measure(piece: Piece, section: str, name: str, fixed: dict[str, Any], seconds: float, first: bool) -> str:
    """Make one measurement; return its state, "open" if the piece ended before it."""
    result = piece.out / section / f"{name}.json"
    result.parent.mkdir(exist_ok=True)
    record = fixed | {"section": section, "measurement": name}
    job = {"section": section, "name": name, "out": str(piece.out), "sizes": piece.sizes, "record": record}
    why = run_child(piece, job, result, seconds)
    if why is None:
        return str((read(result) or {}).get("state"))
    if why == "late" and not first:
        return "open"
    if why == "late":
        why = f"it took longer than the {piece.minutes:g} minutes of its piece; give more --minutes"
        write(result, record | {"state": "late", "why": why})
        return "late"
    write(result, record | {"state": "failed", "why": why})
    return "failed"


def run(piece: Piece) -> int:
    """Make what is missing until the piece ends; return 0, or 1 if a measurement failed."""
    end = time.monotonic() + 60 * piece.minutes
    with opened(piece.out, piece.sizes) as here:
        now = setup(piece.packages)
        lacking = [name for name, found in now["packages"].items() if found is None]
        gpus = ", ".join(here["gpus"]) or "no NVIDIA GPU"
        print(f"{here['processor']}, {here['cores']} cores, {gpus}; packages not here: {', '.join(lacking) or 'none'}")
        chosen = _chosen(piece)
        fixed = {"setup": now, "machine": here, "minutes": piece.minutes, "command": shown(piece)}
        limits = {(section, name): most for section, name, most in QUARTER} if piece.quarter else {}
        todo = [one for one in chosen if is_open(record_of(piece, *one), piece, one[0], now)]
        for i, one in enumerate(todo):
            remaining = end - time.monotonic()
            if i and remaining < LAST_SHARE * 60 * piece.minutes:
                break
            print(f"{one[0]}: {one[1]} ... ", end="", flush=True)
            started = time.monotonic()
            most = limits.get(one)
            state = measure(piece, *one, fixed, max(min(remaining, most or remaining), 1.0), first=i == 0)
            why = f": {(record_of(piece, *one) or {}).get('why')}" if state in ("failed", "late", "absent") else ""
            print(f"{state}, {time.monotonic() - started:.0f} s{why}", flush=True)
            if state == "unfinished" and not piece.quarter:  # its next part may not fit, and others may need it
                break
        return summed_up(piece, chosen)


def _chosen(piece: Piece) -> list[tuple[str, str]]:
    """Return the measurements of this piece, section and name."""
    if piece.quarter:
        return [(section, name) for section, name, _ in QUARTER]
    plan = planned(piece)
    return [(s, n) for s, names in plan.items() if piece.section in (None, s) for n in names]


def summed_up(piece: Piece, chosen: list[tuple[str, str]]) -> int:
    """Write the table, print one line about what was chosen, and return the exit code."""
    job = {"section": "table", "name": "table", "out": str(piece.out), "record": {}}
    why = run_child(piece, job, piece.out / "table.json", LISTING)
    if why is not None:
        print(f"table: failed: {why}")
    states = [(record_of(piece, *one) or {}).get("state") for one in chosen]
    failed = sum(state in ("failed", "late") for state in states)
    left = sum(state not in ENDED for state in states)
    print(
        f"{states.count('done')} of {len(chosen)} measured, {failed} failed, {states.count('absent')} not possible "
        f"here, {left} to do{' by the same command' if left else ''}; {piece.out / 'table.md'}"
    )
    return 1 if failed or why is not None else 0


def shown(piece: Piece) -> str:
    """Return the command that makes such a piece."""
    section = f" --section {piece.section}" if piece.section else ""
    quarter = " --quarter" if piece.quarter else ""
    return f"python benchmarks/gpu.py OUT{section}{quarter} --minutes {piece.minutes:g}"


def main(argv: list[str] | None = None, *, sizes: dict[str, Any] | None = None, child: tuple[str, ...] = CHILD) -> int:
    """Run a command line; tests give smaller sizes, or another program in place of the measurements."""
    given = arguments(sys.argv[1:] if argv is None else argv)
    try:
        piece = Piece(given.out.absolute(), given.section, given.minutes, sizes or {}, child, given.quarter)
        if given.wheels is not None:
            with opened(piece.out, piece.sizes):
                install(given.wheels, piece.packages)
        return run(piece)
    except Wrong as error:
        print(f"gpu.py: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"gpu.py: {error}; the same command continues when this is mended", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ngpu.py: interrupted; the same command continues there", file=sys.stderr)
        return 130
