"""Keeps the folder of results: one machine, one process at a time, records that are complete or absent."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    *("numpy", "scipy", "mitsuba", "drjit", "OpenEXR", "trimesh", "scikit-image", "tifffile", "pillow", "matplotlib"),
    *("tqdm", "jinja2", "torch", "safetensors", "tensorboard", "pyoidn"),
)


class Wrong(Exception):
    """A mistake of the user: one sentence on stderr, and exit code 2."""


@contextlib.contextmanager
def opened(out: Path, sizes: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Lock the folder and yield the machine; `Wrong` if it holds other files, or results of another machine."""
    if out.exists() and not out.is_dir():
        raise Wrong(f"{out}: is a file; name a folder")
    record = out / "machine.json"
    names = [path.name for path in out.iterdir()] if out.is_dir() else []
    if not record.exists() and any(name != "lock" and ".json.tmp-" not in name for name in names):
        raise Wrong(f"{out}: holds files that this program did not write; name an empty folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = open(out / "lock", "a")  # noqa: SIM115
    except OSError as error:
        raise Wrong(f"{out}: cannot be written ({error.strerror}); name another folder") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Wrong(f"{out}: another process measures there; wait for it, or name another folder") from None
        here = machine()
        if record.exists():
            _check_same(out, read(record), here, sizes)
        else:
            write(record, {"machine": here, "sizes": sizes})
        yield here


def _check_same(out: Path, stored: dict[str, Any] | None, here: dict[str, Any], sizes: dict[str, Any]) -> None:
    """Raise `Wrong` unless a folder was begun on this machine, with these sizes."""
    there = (stored or {}).get("machine")
    if stored is None or not isinstance(there, dict):
        raise Wrong(f"{out / 'machine.json'}: is damaged; name another folder")
    different = [f"{key} {there.get(key)!r}, here {value!r}" for key, value in here.items() if there.get(key) != value]
    if stored.get("sizes") != sizes:
        different.append("measurements of other sizes")
    if different:
        raise Wrong(f"{out}: holds results of another machine ({'; '.join(different)}); name another folder")


def machine() -> dict[str, Any]:
    """Return what identifies the kind of machine: processor, cores, GPUs with driver, system, Python."""
    processor = platform.processor()
    with contextlib.suppress(OSError):
        names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(errors="replace"), re.MULTILINE)
        processor = names[0] if names else processor
    return {
        "processor": processor or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "gpus": gpus(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def gpus() -> list[str]:
    """Return name, driver and memory of every NVIDIA GPU, from `nvidia-smi`; empty without one."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(query, capture_output=True, text=True, timeout=60, check=False)
        return [line.strip() for line in done.stdout.splitlines() if line.strip()] if done.returncode == 0 else []
    return []


def setup(packages: Path) -> dict[str, Any]:
    """Return what a result depends on beside the machine: versions of packages, and this program."""
    digest = hashlib.sha256()
    for file in sorted(
        p for part in ("qsim", "quiver", "scenes", "benchmarks/gpu") for p in (ROOT / part).rglob("*.py")
    ):
        digest.update(file.read_bytes())
    return {"program": digest.hexdigest()[:12], "packages": {name: version(name, packages) for name in PACKAGES}}


def version(name: str, packages: Path) -> str | None:
    """Return the version of an installed package, also of one in the folder of the wheels; None without it."""
    found = next(iter(importlib.metadata.distributions(name=name, path=[str(packages), *sys.path])), None)
    return found.version if found else None


def read(path: Path) -> dict[str, Any] | None:
    """Return the table of a JSON file; None if it is missing or damaged."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def read_record(path: Path) -> dict[str, Any] | None:
    """Return the record of a measurement; None if it is missing or damaged."""
    found = read(path) or {}
    kinds: dict[str, Any] = {"state": str, "setup": dict, "minutes": (int, float), "command": str}
    return found if all(isinstance(found.get(name), kind) for name, kind in kinds.items()) else None


def write(path: Path, value: dict[str, Any]) -> None:
    """Write JSON that is complete or absent; qsim.files does the same, and needs NumPy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.tmp-{os.getpid()}")
    with open(temporary, "w", encoding="utf-8") as file:
        json.dump(value, file, indent=1, allow_nan=False)  # columns of rows keep their order
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
