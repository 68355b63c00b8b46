"""Finds sensors and methods of others: in a Python file, `mine.py:Trigger`, or under an entry point of a package.

A file is run when its user names it, on a command line, in a recipe, by `load`, or in the variable QSIM_PLUGINS, a list
of files. What a stored description names is never run for that alone: a data set from elsewhere may name anything.
A package registers its parts in its pyproject.toml, and installing it is its user's word:

    [project.entry-points."qsim.sensors"]
    trigger = "my_package:Trigger"

    [project.entry-points."quiver.methods"]
    my-mean = "my_package:restore"
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from qsim.checks import suggest

SENSORS = "qsim.sensors"  # groups of entry points
METHODS = "quiver.methods"
VARIABLE = "QSIM_PLUGINS"
_NAME = re.compile(r"(.+\.py):([A-Za-z_]\w*)")
_MODULE = "qsim_plugin_"  # followed by the digest of the file


@dataclass(frozen=True)
class Source:
    """Where a part of others comes from."""

    module: str  # of a package, or the name of a file without its folder
    version: str  # of the package; of a file, nothing
    sha256: str  # of the module's file

    def words(self) -> str:
        """Return module and version."""
        return f"{self.module} {self.version}".rstrip()


@dataclass(frozen=True)
class Plugin:
    """A class or function of others."""

    name: str  # as it is asked for
    made: Any
    source: Source


def file_of(name: str) -> str | None:
    """Return the file of a name like `mine.py:Trigger`; None for any other name."""
    found = _NAME.fullmatch(name)
    return None if found is None else found[1]


def beside(name: str, folder: Path) -> str:
    """Return a name like `mine.py:Trigger` with the absolute path of its file, which is relative to a folder."""
    file, _, part = name.rpartition(":")
    return f"{(folder / file).resolve()}:{part}"


def installed(group: str) -> list[str]:
    """Return the names of the entry points of a group."""
    return sorted(_entries(group))


def load(name: str, group: str) -> Plugin | None:
    """Return the part of a name like `mine.py:Trigger`, or of an entry point; None for any other name.

    `FileNotFoundError` for a file that is not there; `ValueError` for one that cannot be run, or without such a part.
    """
    found = _NAME.fullmatch(name)
    if found is None:
        return _of_package(name, group)
    file, part = found.groups()
    module = _module(Path(file))
    if not hasattr(module, part):
        known = [key for key in vars(module) if not key.startswith("_")]
        raise ValueError(f"{file}: has no {part}{suggest(part, known)}")
    return Plugin(name, getattr(module, part), _source_of_module(module.__name__))


def _of_package(name: str, group: str) -> Plugin | None:
    entry = _entries(group).get(name)
    if entry is None:
        return None
    try:
        made = entry.load()
    except Exception as error:
        raise ValueError(f"{name}: its package cannot be loaded ({type(error).__name__}: {error})") from None
    return Plugin(name, made, _source_of_module(entry.module, entry.dist.version if entry.dist else ""))


def source_of(kind: type) -> Source | None:
    """Return where a class of others comes from, if a stored description can name it; None for any other class."""
    module = kind.__module__
    if is_of_file(kind) and module in sys.modules:
        return _source_of_module(module)
    for entry in _entries(SENSORS).values():
        if entry.module == module or entry.module == module.partition(".")[0]:
            return _source_of_module(module, entry.dist.version if entry.dist else "")
    return None


def is_of_file(kind: type) -> bool:
    """Return whether a class is of a Python file that was named."""
    return kind.__module__.startswith(_MODULE)


def stored_class(model: str, stored: Mapping[str, Any], where: str) -> tuple[type, Source]:
    """Return the class that a stored description names, from what is installed or named in QSIM_PLUGINS.

    `ValueError` with one sentence where it is not.
    """
    wanted = str(stored.get("module"))
    if wanted.endswith(".py"):
        for file in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
            if Path(file).name == wanted:
                module = _module(Path(file))
                if isinstance(vars(module).get(model), type):
                    return vars(module)[model], _source_of_module(module.__name__)
        cure = f"put its file into {VARIABLE}, as in {VARIABLE}=/path/{wanted}"
    else:
        for entry in _entries(SENSORS).values():
            if entry.module.partition(".")[0] == wanted.partition(".")[0]:
                entry.load()
                kind = getattr(sys.modules.get(wanted), model, None)
                found = source_of(kind) if isinstance(kind, type) else None
                if found is not None:
                    return kind, found  # type: ignore[return-value]  # a type, by the line above
        cure = f"install the package of {wanted}"
    version = f" {stored['version']}" if stored.get("version") else ""
    raise ValueError(f"{where}: the sensor {model} of {wanted}{version} is not on this machine; {cure}")


def stated(kind: type) -> dict[str, Any]:
    """Return what a stored description says of a class of others: {"plugin": ...}; empty for any other class."""
    if kind.__module__.partition(".")[0] in ("qsim", "__main__"):
        return {}
    found = source_of(kind)
    return {} if found is None else {"plugin": asdict(found)}


def made_again(model: str, stored: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
    """Return an object of a class of others, in another process; `ValueError` where the class is not."""
    kind, _ = stored_class(model, stored, "an object of another process")
    return kind(**values)


@functools.cache
def _entries(group: str) -> dict[str, metadata.EntryPoint]:
    return {entry.name: entry for entry in metadata.entry_points(group=group)}


def _module(path: Path) -> Any:
    """Return the module of a file, run once per content; processes that this one starts know the file, too."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    content = path.read_bytes()
    name = f"{_MODULE}{hashlib.sha256(content).hexdigest()}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path.resolve())
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            del sys.modules[name]
            raise ValueError(f"{path}: cannot be run ({type(error).__name__}: {error})") from None
    known = [file for file in os.environ.get(VARIABLE, "").split(os.pathsep) if file]
    if str(path.resolve()) not in known:
        os.environ[VARIABLE] = os.pathsep.join([str(path.resolve()), *known])
    return sys.modules[name]


@functools.lru_cache(maxsize=64)
def _source_of_module(module: str, version: str = "") -> Source:
    found = sys.modules.get(module)
    file = Path(str(getattr(found, "__file__", "")))
    if module.startswith(_MODULE):
        return Source(file.name, "", module.removeprefix(_MODULE))
    digest = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    return Source(module, version, digest)
