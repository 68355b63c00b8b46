"""Finds the LLVM libraries of this machine, and loads one with what it needs.

    DRJIT_LIBLLVM_PATH -> the environment of this Python -> the system; in each, the newest first

The environment comes before the system: everyone with the same pinned packages renders with the same LLVM.
"""

from __future__ import annotations

import ctypes
import glob
import os
import platform
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

OLDEST = 16  # Dr.Jit 1.5 refuses LLVM 14; with LLVM 15 it aborts the process
VARIABLE = "DRJIT_LIBLLVM_PATH"  # names a library for Dr.Jit
HELD = "that Dr.Jit loaded when it was imported, before qsim could choose"
PACKAGE = "karellen-llvm-core"  # LLVM as a wheel: the extra `llvm`

_SYSTEM = (
    "/usr/lib/*-linux-gnu",  # Debian, Ubuntu
    "/usr/lib/llvm*/lib*",  # Debian's llvm-19, Alpine's llvm19
    "/usr/lib64",  # Fedora, openSUSE
    "/usr/lib64/llvm*/lib*",
    "/usr/lib",  # Arch
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",  # Homebrew on arm64 and on x86-64
    "/usr/local/opt/llvm*/lib",
    "/opt/local/libexec/llvm-*/lib",  # MacPorts
)
# libLLVM.so.23.1, libLLVM-19.so.1, libLLVM-17.0.6.so, libLLVM.19.1.dylib, libLLVM.dylib; not libLLVMSupport.so.19
_NAME = re.compile(r"libLLVM(?:[.-](\d+)[\d.]*\.(?:so[\d.]*|dylib)|\.so\.(\d+)[\d.]*|\.dylib)")
# The package's library needs these. It finds them by links that its start-up file makes when the environment's Python
# first starts: not in a folder without permission to write, and not after `pip install --target`. A library that is
# loaded already needs no link.
_COMPANIONS = ("libunwind", "libc++abi", "libc++")  # each needs those before it
_COMPANION_FOLDER = "x86_64-unknown-linux-gnu"


class Library(NamedTuple):
    """A file that may be a usable LLVM, and where it comes from."""

    path: str
    origin: str  # for messages: "of the system"


def usable() -> list[Library]:
    """Return the libraries to test: the one that Dr.Jit has loaded already, else all `candidates`.

    Dr.Jit loads one when a program imports it, and keeps it. A program that imports Dr.Jit or Mitsuba before `qsim`
    leaves no choice.
    """
    found = candidates()
    held = _held() if "drjit" in sys.modules else None
    if held is None:
        return found
    same = [library for library in found if os.path.realpath(library.path) == held]
    return same or [Library(held, HELD)]


def _held() -> str | None:
    """Return the LLVM library that this process has loaded; None without one, or where no /proc tells."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return None
    paths = [line.split(maxsplit=5)[5] for line in lines if "LLVM" in line]
    return next((os.path.realpath(path) for path in paths if _number(path) is not None), None)


def candidates() -> list[Library]:
    """Return the libraries to test, in the order of this module; each file once."""
    named = os.environ.get(VARIABLE)
    found = [Library(named, f"named by {VARIABLE}")] if named else []
    found += _of_package()
    for root in (sys.prefix, os.environ.get("CONDA_PREFIX")):
        if root:
            found += [Library(path, "of this environment") for path in _newest_first([f"{root}/lib"])]
    found += [Library(path, "of the system") for path in _newest_first(system_folders())]
    unique: dict[str, Library] = {}
    for library in found:
        if os.path.isfile(library.path):
            unique.setdefault(os.path.realpath(library.path), library)
    return list(unique.values())


def system_folders() -> list[str]:
    """Return the patterns of folders where systems keep LLVM."""
    return list(_SYSTEM)


def install_hint() -> str:
    """Return how to install an LLVM on this kind of machine, as part of a sentence."""
    if sys.platform == "darwin":
        how = "brew install llvm"
    elif sys.platform == "linux" and platform.machine() == "x86_64":
        how = f"pip install {PACKAGE}; Debian, Ubuntu: apt install libllvm19"
    else:
        how = "Debian, Ubuntu: apt install libllvm19"
    return f"install LLVM {OLDEST} or newer ({how}) or set {VARIABLE} to one"


def companions(path: str) -> list[str]:
    """Return the libraries to load before `path`, in this order; only the package's library has some."""
    folder = Path(os.path.realpath(path)).parent / _COMPANION_FOLDER
    return [str(found) for stem in _COMPANIONS for found in sorted(folder.glob(f"{stem}.so.*"))[:1]]


def prepare(path: str) -> None:
    """Make Dr.Jit, which is not loaded yet, take the LLVM at `path`."""
    for companion in companions(path):
        ctypes.CDLL(companion)
    os.environ[VARIABLE] = path


def _of_package() -> Iterator[Library]:
    """Yield the library of the installed package, wherever the installer put it."""
    try:
        package = metadata.distribution(PACKAGE)
    except metadata.PackageNotFoundError:
        return
    for file in package.files or ():
        if _number(file.name) is not None:
            yield Library(os.path.realpath(file.locate()), f"of the package {PACKAGE} {package.version}")


def _newest_first(folders: list[str]) -> list[str]:
    """Return the libraries in folders (patterns), of `OLDEST` and newer; one of unknown version last."""
    numbered = []
    for folder in dict.fromkeys(folders):
        for path in glob.glob(f"{folder}/libLLVM[.-]*"):
            number = _number(path)
            if number is not None and (number == 0 or number >= OLDEST):
                numbered.append((-number, path))
    return [path for _, path in sorted(numbered)]


def _number(path: str) -> int | None:
    """Return the version in the name of an LLVM library, or in its folder's, 0 without one; None for other files."""
    matched = _NAME.fullmatch(os.path.basename(path))
    if matched is None:
        return None
    folder = re.search(r"llvm(?:@|-|/)?(\d+)", os.path.dirname(os.path.realpath(path)))
    stated = matched[1] or matched[2] or (folder[1] if folder else "0")
    return int(stated)
