"""Tells what is there: GPU and driver, OptiX, torch, the renderer's variants, and the packages that are missing."""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from folder import gpus, setup
from job import Job
from sizes import Sizes


def names(sizes: Sizes) -> list[str]:
    """Return the one measurement."""
    return ["machine"]


def measure(job: Job) -> list[dict[str, Any]]:
    """Return one row for everything that was looked at; what fails states why, and the others follow."""
    parts: tuple[Callable[[Path], list[tuple[str, str]]], ...] = (_driver, _packages, _torch, _variants)
    rows = []
    for part in parts:
        try:
            rows += part(job.out)
        except ImportError as error:
            rows.append((part.__name__.strip("_"), f"not told: {error.name} is not installed"))
        except Exception as error:
            rows.append((part.__name__.strip("_"), f"not told: {type(error).__name__}: {error}"))
    return [{"what": what, "found": found} for what, found in rows]


def _driver(out: Path) -> list[tuple[str, str]]:
    file = Path("/proc/driver/nvidia/version")
    optix = next((name for name in ("libnvoptix.so.1", "libnvoptix.so") if _loads(name)), None)
    return [
        *(("GPU, driver, memory", gpu) for gpu in gpus() or ["none that nvidia-smi lists"]),
        ("kernel module", file.read_text().splitlines()[0] if file.exists() else "none"),
        ("CUDA driver library", ctypes.util.find_library("cuda") or "none"),
        ("OptiX library", optix or "none"),
    ]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _packages(out: Path) -> list[tuple[str, str]]:
    found = setup(out / "packages")["packages"]
    missing = ", ".join(name for name, version in found.items() if version is None)
    there = ", ".join(f"{name} {version}" for name, version in found.items() if version)
    return [("Python", sys.version.split()[0]), ("packages", there or "none"), ("missing packages", missing or "none")]


def _torch(out: Path) -> list[tuple[str, str]]:
    import torch

    there = torch.cuda.is_available()
    rows = [
        ("torch", f"{torch.__version__}, CUDA {torch.version.cuda or 'not built in'}, {'works' if there else 'no GPU'}")
    ]
    for i in range(torch.cuda.device_count() if there else 0):
        about = torch.cuda.get_device_properties(i)
        text = f"{about.name}, compute {about.major}.{about.minor}, {about.total_memory / 2**30:.0f} GiB"
        rows.append((f"torch device {i}", f"{text}, bfloat16 {'yes' if torch.cuda.is_bf16_supported() else 'no'}"))
    return rows


def _variants(out: Path) -> list[tuple[str, str]]:
    import warnings

    from qsim import backend

    rows = []
    for name, variant in backend.VARIANTS.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                rows.append((variant, f"works: {backend.choose(name).reason}"))
        except ValueError as error:
            rows.append((variant, str(error)))
    return rows
