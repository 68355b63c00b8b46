"""Runs the tests that compare floats as if on other processors, and prints what passed.

    python tests/processors.py                  all emulations, on every test file that compares floats
    python tests/processors.py --stored         all emulations, on tests that compare with stored results
    python tests/processors.py --two            the two farthest apart, on those: what .ci/run does
    python tests/processors.py --only prescott,zen tests/qsim/sensor

An emulation is a set of variables that the libraries read: the kernels of OpenBLAS, the vector instructions of NumPy,
ATen, oneDNN and MKL, and the number of threads; or another version of NumPy and SciPy, installed into a folder that
comes before the environment's own (`oldest` needs a package index). Those that this machine cannot run are named and
left out. `lowest` is the oldest of each library at once. The machine itself is `native`, which `make test` is already.

With `--margins FOLDER` each emulation writes there what share of its tolerance every comparison took; the comparisons
whose share changes most between two emulations come last. A rule has room for a processor that is not here if it has
ten times what two very different ones differ by.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
STORED = re.compile(r"(import|from) machines\b|\bbeyond\(")  # text of a test that compares with stored results
FLOATS = re.compile(rf"approx\(|allclose\(|isclose\(|{STORED.pattern}")
# NumPy 2.4 names groups of instructions by the levels of x86-64, earlier versions the sets themselves.
NUMPY_FEATURES = ("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR", "AVX2", "FMA3", "AVX512F", "AVX512_SKX")
BLAS_NEEDS = {"Prescott": "pni", "Haswell": "avx2", "Zen": "avx2", "SkylakeX": "avx512dq"}  # flags of /proc/cpuinfo
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Emulation:
    """Another processor, or other versions, in place of this machine."""

    name: str
    variables: Mapping[str, str] = field(default_factory=dict)
    needs: str = ""  # an instruction set, as /proc/cpuinfo names it
    packages: tuple[str, ...] = ()  # requirements in front of the environment's own


def features_off() -> str:
    """The vector instructions of NumPy that this machine has and may lack, as NPY_DISABLE_CPU_FEATURES takes them."""
    from numpy._core import _multiarray_umath as core

    present = core.__cpu_features__
    return " ".join(name for name in NUMPY_FEATURES if name in core.__cpu_dispatch__ and present.get(name))


def oldest() -> tuple[str, ...]:
    """The least versions of NumPy and SciPy that pyproject.toml allows."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    found = [re.fullmatch(r"(numpy|scipy)>=([\d.]+)", line) for line in dependencies]
    return tuple(f"{match[1]}=={match[2]}.*" for match in found if match)


def emulations() -> list[Emulation]:
    """All emulations; those that this machine cannot run are among them."""
    no_numpy = {"NPY_DISABLE_CPU_FEATURES": features_off()}
    # All libraries of torch follow one processor: its own kernels, those of oneDNN and those of MKL.
    old = {"ONEDNN_MAX_CPU_ISA": "SSE41", "ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE"}
    avx2 = {"ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2"}
    return [
        Emulation("native"),
        *(Emulation(core.lower(), {"OPENBLAS_CORETYPE": core}, needs) for core, needs in BLAS_NEEDS.items()),
        Emulation("numpy-without-vectors", no_numpy),
        Emulation("torch-sse41", old),
        Emulation("torch-avx2", avx2, "avx2"),
        Emulation("torch-avx512", {"ATEN_CPU_CAPABILITY": "avx512"}, "avx512dq"),
        Emulation("two-threads", dict.fromkeys(ONE_THREAD, "2")),
        Emulation("lowest", {"OPENBLAS_CORETYPE": "Prescott"} | no_numpy | old),
        Emulation("oldest", packages=oldest()),
        Emulation("newest", packages=("numpy", "scipy")),
    ]


def flags() -> set[str]:
    """Instruction sets of this machine; empty where /proc/cpuinfo does not tell them."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return set()
    found = re.search(r"^flags\s*:\s*(.*)$", text, re.MULTILINE)
    return set(found[1].split()) if found else set()


def files_that_compare(roots: Iterable[str], what: re.Pattern[str]) -> list[str]:
    """Test files below `roots` whose text matches."""
    files = [
        path for root in roots for path in ([ROOT / root] if root.endswith(".py") else (ROOT / root).rglob("*.py"))
    ]
    tests = [path for path in sorted(files) if path.name.startswith("test_")]
    return [str(path.relative_to(ROOT)) for path in tests if what.search(path.read_text())]


def installed(packages: tuple[str, ...], folder: Path) -> str | None:
    """Installs packages into a folder; the error's last line, or None."""
    command = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--target", str(folder)]
    done = subprocess.run([*command, *packages], capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["pip failed"])[-1]


def run(emulation: Emulation, files: list[str], margins: Path | None, more: list[str]) -> tuple[bool, str, float]:
    """(whether all tests passed, pytest's last line, minutes) of one emulation."""
    with tempfile.TemporaryDirectory() as folder:
        path = [str(ROOT), str(ROOT / "tests/support")]
        if emulation.packages:
            if (error := installed(emulation.packages, Path(folder))) is not None:
                return False, error, 0.0
            path.insert(0, folder)
        variables = {**os.environ, **ONE_THREAD, **emulation.variables, "PYTHONPATH": os.pathsep.join(path)}
        command = [sys.executable, "-m", "pytest", "-m", "not slow", "-p", "no:cacheprovider", "--tb=short", *more]
        if margins is not None:
            variables["FLOAT_MARGINS"] = str(margins / f"{emulation.name}.jsonl")
            command += ["-p", "margins", "-n", "0"]
        begun = time.monotonic()
        done = subprocess.run([*command, *files], cwd=ROOT, env=variables, capture_output=True, text=True, check=False)
    said = done.stdout.strip().splitlines() or done.stderr.strip().splitlines() or ["nothing"]
    for line in said:
        if line.startswith(("FAILED", "ERROR")):
            print(f"  {line}", flush=True)
    return done.returncode == 0, said[-1].strip("= "), (time.monotonic() - begun) / 60


def print_margins(folder: Path, most: int = 20) -> None:
    """Prints the comparisons whose share of the tolerance differs most between emulations."""
    shares: dict[tuple[str, int], dict[str, float]] = {}
    places: dict[tuple[str, int], str] = {}
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text().splitlines():
            test, number, place, share = json.loads(line)
            shares.setdefault((test, number), {})[path.stem] = share
            places[test, number] = place
    spread = {key: max(by.values()) - min(by.values()) for key, by in shares.items() if len(by) > 1}
    known = {key: change for key, change in spread.items() if max(shares[key].values()) <= 1}
    for key in sorted(known, key=lambda key: known[key] / (1.001 - min(shares[key].values())))[-most:]:
        print(f"{known[key]:.3g} of the tolerance, at {min(shares[key].values()):.3g}: {places[key]} {key[0]}")


def main(arguments: list[str] | None = None) -> int:
    """The command above; 1 if a test failed."""
    parser = argparse.ArgumentParser(description="run the tests that compare floats as if on other processors")
    parser.add_argument("roots", nargs="*", default=["tests"], help="test files or folders (default tests)")
    parser.add_argument("--two", action="store_true", help="the two farthest apart, on stored results")
    parser.add_argument("--stored", action="store_true", help="only tests that compare with stored results")
    parser.add_argument("--only", help="names of emulations, with commas between them")
    parser.add_argument("--margins", type=Path, help="folder for the shares of the tolerances")
    parser.add_argument("-n", default="2", help="processes at a time (default 2)")
    given = parser.parse_args(arguments)
    chosen = emulations()
    if given.two:
        chosen = [emulation for emulation in chosen if emulation.name == "lowest"]
    if given.only:
        names = given.only.split(",")
        unknown = set(names) - {emulation.name for emulation in chosen}
        if unknown:
            parser.error(f"unknown: {', '.join(sorted(unknown))}; choose among {', '.join(e.name for e in chosen)}")
        chosen = [emulation for emulation in chosen if emulation.name in names]
    if given.margins:
        given.margins.mkdir(parents=True, exist_ok=True)
    files = files_that_compare(given.roots, STORED if given.two or given.stored else FLOATS)
    here = flags()
    failed = False
    print(f"{len(files)} test files compare floats", flush=True)
    for emulation in chosen:
        if emulation.needs and emulation.needs not in here:
            print(f"{emulation.name:24} left out: this machine has no {emulation.needs}", flush=True)
            continue
        passed, said, minutes = run(emulation, files, given.margins, ["-n", given.n])
        print(f"{emulation.name:24} {said:60} {minutes:6.1f} min", flush=True)
        failed = failed or not passed
    if given.margins:
        print_margins(given.margins)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
