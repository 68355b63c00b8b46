"""Chooses the Mitsuba variant: tests CUDA, then every LLVM, in a child process.

    CUDA with OptiX -> LLVM (qsim/llvm.py) -> scalar (slow, always available)

Dr.Jit aborts the process at the first render with some libraries. So none is loaded before a child process has
rendered with it. Results that last are stored in the user's cache folder; their key is the library's path and time, or
the driver and CUDA_VISIBLE_DEVICES, and the versions of Mitsuba and Dr.Jit.

Environment: DRJIT_LIBLLVM_PATH names an LLVM to try first; QSIM_ENGINE=cuda|llvm|scalar requires one engine.
"""

from __future__ import annotations

import ctypes.util
import json
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypedDict

from qsim import llvm
from qsim.files import wording, write_bytes

BACKENDS = ("cuda", "llvm", "scalar")
VARIANTS = {"cuda": "cuda_ad_mono", "llvm": "llvm_ad_mono", "scalar": "scalar_rgb"}
GPU_VARIANT = VARIANTS["cuda"]
PROBE_SECONDS = 180
NO_DRIVER = "no NVIDIA driver on this machine"
NO_FRAME = "no frame after"  # of a failure that may pass
NO_LIBRARY = "cannot open shared object file"  # as well: a library that an LLVM needs can be installed beside it
OPTIX = "OptiX is missing or too old"  # of a failure that stays
INSTALL_HINT = llvm.install_hint()

# Runs in a child process: one 4x4 frame of a lit sphere whose mean must be a positive number.
_PROBE = """
import ctypes, os, sys
variant, library, oldest, *companions = sys.argv[1:]
for companion in companions:
    ctypes.CDLL(companion)
if library:
    loaded = ctypes.CDLL(library)
    if not hasattr(loaded, "LLVMGetVersion"):
        sys.exit(f"older than LLVM {oldest}, which Dr.Jit cannot use safely")
    number = ctypes.c_uint()
    loaded.LLVMGetVersion(ctypes.byref(number), None, None)
    print("version", number.value)
    os.environ["DRJIT_LIBLLVM_PATH"] = library
import mitsuba as mi
mi.set_variant(variant)
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"},
    "ball": {"type": "sphere"}, "sensor": {"type": "perspective",
    "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 4, "height": 4}}})
import numpy as np
mean = float(np.mean(np.array(mi.render(scene, spp=4))))
print("rendered" if mean > 0 else f"rendered a mean of {mean}")
"""

# The same of the GPU's own denoiser: a noisy grey picture of 1, whose mean must stay.
_DENOISER_PROBE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
import numpy as np
noisy = np.random.default_rng(0).uniform(0.5, 1.5, (32, 48, 3)).astype(np.float32)
denoiser = mi.OptixDenoiser(input_size=mi.ScalarVector2u(48, 32), albedo=True)
cleaned = np.array(denoiser(mi.TensorXf(noisy), albedo=mi.TensorXf(np.ones_like(noisy))))
right = cleaned.shape == noisy.shape and abs(cleaned.mean() - 1) < 0.1 and cleaned.std() < noisy.std()
print("rendered" if right else f"denoised to {cleaned.mean()} with {cleaned.std()} left")
"""


@dataclass(frozen=True)
class RenderEngine:
    """The chosen renderer and why."""

    variant: str  # Mitsuba variant
    backend: str  # "cuda" | "llvm" | "scalar"
    llvm_path: str | None  # library that Dr.Jit loads, for "llvm"
    reason: str  # one line


@dataclass(frozen=True)
class Probe:
    """The result of a child process that tested one candidate."""

    backend: str
    library: str | None
    works: bool
    detail: str  # version, or the last line of the failure


def choose(prefer: str | None = None) -> RenderEngine:
    """Return the engine, chosen once per process; `prefer` or QSIM_ENGINE requires "cuda", "llvm" or "scalar".

    `ValueError` if the required engine does not work; it states the reason and what to install.
    """
    wanted = prefer or os.environ.get("QSIM_ENGINE") or None
    if wanted not in (None, *BACKENDS):
        raise ValueError(f"engine {wanted!r}: expected one of {', '.join(BACKENDS)}")
    return decided(wanted)


def on_gpu(engine: str) -> bool:
    """Return whether a backend, or the variant of one, runs on a GPU."""
    return engine.startswith("cuda")


def limit_threads() -> None:
    """Set the number of Dr.Jit's threads to QSIM_THREADS, if that is set; child processes inherit it."""
    wanted = os.environ.get("QSIM_THREADS")
    if wanted:
        if not (wanted.isdigit() and int(wanted)):
            raise ValueError(f"QSIM_THREADS={wanted}: expected a number of threads of at least 1")
        import drjit as dr

        if dr.thread_count() != int(wanted):
            dr.set_thread_count(int(wanted))


class EngineReport(TypedDict):
    """What `qsim doctor` prints about rendering."""

    variant: str  # the choice, as `RenderEngine`
    backend: str
    llvm_path: str | None
    reason: str
    probes: list[dict[str, object]]  # every `Probe`
    software: dict[str, str]  # versions
    cache: str  # file


def report() -> EngineReport:
    """Return the choice of the renderer, and what led to it."""
    engine = choose()
    cuda = probe_cuda()
    stored = _cached_probes()
    probes = [asdict(probe) for probe in (stored if cuda in stored else [cuda, *stored])]  # one that passes is not kept
    return EngineReport(
        variant=engine.variant,
        backend=engine.backend,
        llvm_path=engine.llvm_path,
        reason=engine.reason,
        probes=probes,
        software={"mitsuba": version("mitsuba"), "drjit": version("drjit")},
        cache=str(_cache_file() or "none (no home)"),
    )


def decide(wanted: str | None) -> RenderEngine:
    failures = []
    if wanted in (None, "cuda"):
        probe = probe_cuda()
        if probe.works:
            return RenderEngine(VARIANTS["cuda"], "cuda", None, probe.detail)
        failures.append(f"CUDA: {probe.detail}")
    if wanted in (None, "llvm"):
        found, reasons = _with_llvm()
        if found is not None:
            return found
        failures += reasons
    if wanted == "scalar":
        return RenderEngine(VARIANTS["scalar"], "scalar", None, "asked for")
    why = "; ".join(failures)
    if wanted is not None:
        hint = INSTALL_HINT if wanted == "llvm" else "it needs an NVIDIA GPU whose driver brings OptiX"
        raise ValueError(f"engine {wanted} does not work here ({why}); {hint}")
    warnings.warn(f"rendering with the slow scalar engine ({why}): {INSTALL_HINT}", RuntimeWarning, stacklevel=3)
    return RenderEngine(VARIANTS["scalar"], "scalar", None, why)


def _with_llvm() -> tuple[RenderEngine | None, list[str]]:
    """Return the engine of the first LLVM that works, or None, and why those before it do not."""
    libraries = llvm.usable()
    if not libraries:
        return None, [f"no libLLVM of version {llvm.OLDEST} or newer found"]
    failures: list[str] = []
    for path, origin in libraries:
        probe = cached_probe(VARIANTS["llvm"], path)
        if probe.works:
            return RenderEngine(VARIANTS["llvm"], "llvm", path, f"{probe.detail} {origin}, {path}"), failures
        reason = f"{path}: {probe.detail}"
        if origin == llvm.HELD:
            reason += f"; it is the one {origin}: set {llvm.VARIABLE} to a newer one before drjit is imported"
        if path == os.environ.get(llvm.VARIABLE):
            warnings.warn(f"{llvm.VARIABLE}={reason}; looking further", RuntimeWarning, stacklevel=4)
        failures.append(reason)
    return None, failures


decided = lru_cache(decide)


def probe_cuda() -> Probe:
    """Test CUDA if there is a driver; its version is part of the cache key."""
    stamp = _driver()
    return cached_probe(VARIANTS["cuda"], None, stamp) if stamp else Probe("cuda", None, False, NO_DRIVER)


@lru_cache
def gpu_denoises() -> bool:
    """Return whether OptiX's denoiser works here, tested in a child process: its failure may end the process."""
    stamp = _driver()
    return bool(stamp) and cached_probe(GPU_VARIANT, None, f"{stamp}, denoiser", run_denoiser_probe).works


def _driver() -> str:
    """Return what identifies driver and visible GPUs; empty without a driver."""
    driver = Path("/proc/driver/nvidia/version")
    if not (driver.exists() or ctypes.util.find_library("cuda") or ctypes.util.find_library("nvcuda")):
        return ""
    stamp = driver.read_text().splitlines()[0] if driver.exists() else "driver"
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    return stamp if visible is None else f"{stamp}, visible: {visible}"


def cached_probe(
    variant: str, library: str | None, stamp: str = "", run: Callable[[str, str | None], Probe] | None = None
) -> Probe:
    """Return the stored result of an earlier test, or test in a child process; `run` None is `run_probe`."""
    modified = os.stat(library).st_mtime_ns if library else 0
    software = [version("mitsuba"), version("drjit"), sys.version.split()[0]]
    key = json.dumps([variant, os.path.realpath(library) if library else None, modified, stamp, *software])
    answers = _read_cache()
    if key not in answers:
        probe = (run or run_probe)(variant, library)
        if not lasts(probe):
            return probe
        answers = _read_cache() | {key: asdict(probe)}
        _write_cache(answers)
    return Probe(**answers[key])


def lasts(probe: Probe) -> bool:
    """Return whether a probe would have the same result again; a GPU may be full, or a machine too busy, for a while.

    A GPU without OptiX stays without it until its driver changes.
    """
    passes = probe.detail.startswith(NO_FRAME) or NO_LIBRARY in probe.detail
    return probe.works or not (passes or (on_gpu(probe.backend) and OPTIX not in probe.detail))


def run_denoiser_probe(variant: str, library: str | None) -> Probe:
    """Test the GPU's own denoiser in a child process."""
    probe = run_probe(variant, library, _DENOISER_PROBE)
    return replace(probe, detail=f"{probe.detail}, denoiser")


def run_probe(variant: str, library: str | None, script: str = _PROBE) -> Probe:
    """Run a script that tests a candidate in a child process; it prints `rendered` where that works."""
    backend = variant.split("_")[0]
    needed = llvm.companions(library) if library else []
    command = [sys.executable, "-W", "ignore", "-c", script, variant, library or "", str(llvm.OLDEST), *needed]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return Probe(backend, library, False, f"{NO_FRAME} {PROBE_SECONDS} s")
    numbers = re.search(r"^version (\d+)$", child.stdout, re.MULTILINE)
    # Mitsuba's own lines may stand before it, or after it where Python keeps what it prints (no PYTHONUNBUFFERED).
    if child.returncode == 0 and re.search(r"rendered$", child.stdout, re.MULTILINE):
        return Probe(backend, library, True, f"LLVM {numbers.group(1)}" if numbers else "CUDA with OptiX")
    lines = [line.strip() for line in (child.stderr + "\n" + child.stdout).splitlines() if line.strip()]
    errors = [line for line in lines if "ERROR" in line.upper()]  # the last: start-up files of Python may print others
    last = (errors or lines or ["no message"])[-1]
    ended = f"child process crashed with signal {-child.returncode}: " if child.returncode < 0 else ""
    if backend == "cuda" and "memory" not in last.lower() and any("optix" in line.lower() for line in lines):
        last = f"{OPTIX} ({last}); update the NVIDIA driver"
    return Probe(backend, library, False, (ended + last)[:300])


def _cache_file() -> Path | None:
    """Return the file of stored results; None for a user without a home, as in containers."""
    root = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/.cache")
    return Path(root) / "qsim" / "engine.json" if os.path.isabs(root) else None


def _read_cache() -> dict[str, dict[str, Any]]:
    file = _cache_file()
    try:
        answers = json.loads(file.read_text()) if file else {}
    except (OSError, ValueError):
        return {}
    return answers if isinstance(answers, dict) else {}


def _write_cache(answers: dict[str, dict[str, Any]]) -> None:
    """Store the results if possible; without a writable home every process tests again."""
    file = _cache_file()
    try:
        if file is None:
            raise FileNotFoundError("this user has no home; set XDG_CACHE_HOME to a folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, json.dumps(answers, indent=1).encode())
    except OSError as error:
        warnings.warn(f"cannot store the choice of the engine ({wording(error)})", RuntimeWarning, stacklevel=2)


def _cached_probes() -> list[Probe]:
    return [Probe(**answer) for answer in _read_cache().values()]
