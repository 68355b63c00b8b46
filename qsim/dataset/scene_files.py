"""The files that a scene of the user's own reads, so that an edit of any of them is noticed when a run is resumed.

    load(family, seed, speed) -> the scene, and {file: SHA-256}

* Mitsuba XML: each file that an attribute names, in this file and in those that it includes.
* Python: what it imports and opens while the scene is made, and the files that the scene names. Where it lists a folder
  and opens files of it, the names of all files with these endings count too (`meshes/*.obj`).
* A folder of assets: every file in it.

Files are named relative to the scene's own, absolute where they lie elsewhere. Installed packages, this program, caches
and the system's /proc, /sys and /dev are left out. Families of the library read nothing.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import os
import re
import sys
import sysconfig
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import scenes
from qsim import backend, files
from qsim.dataset.provenance import nested
from qsim.rendering import engine
from qsim.scene import Scene

_INSTALLED = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
_LEFT_OUT = tuple(
    f"{os.path.realpath(folder)}{os.sep}"
    for folder in (*_INSTALLED, str(Path(__file__).parents[1]), "/proc", "/sys", "/dev")
)
_LIBRARY = Path(scenes.__file__).resolve().parent
_PARTS_LEFT_OUT = frozenset({".cache", "site-packages", "dist-packages"})


def load(family: str | Path, seed: int = 0, speed: float = 1.0) -> tuple[Scene, dict[str, str]]:
    """As `scenes.load`, with the SHA-256 of each file that was read; empty for a family of the library."""
    path = Path(family).resolve()
    if str(family) in scenes.FAMILIES or not path.exists():
        return scenes.load(family, seed, speed), {}
    with _tracing() as trace:
        scene = scenes.load(family, seed, speed)
    if path.suffix == ".xml":
        found = of_xml(path)
    elif path.is_dir():
        found = {file for file in path.rglob("*") if file.is_file()}
    else:
        found = {path, *trace.opened, *_named_in(scene)}
        if path.suffix == ".py":
            found |= _imported(path)
    for file in [file for file in found if file.suffix == ".xml"]:
        found |= of_xml(file)
    kept = sorted(file for file in found if file.is_file() and (path.is_dir() or file == path or _counts(file)))
    listed = {file.parent / f"*{file.suffix}" for file in kept if path.suffix == ".py" and file.parent in trace.listed}
    root = path if path.is_dir() else path.parent
    return scene, {_name(file, root): _digest(file) for file in sorted({*kept, *listed})}


def change(family: str, name: str, digest: str) -> str | None:
    """What happened to a file since its scene was rendered, or None if it is the same; `name` as `load` gives it."""
    path = Path(family) if Path(family).is_dir() else Path(family).parent
    file = path / name
    if "*" in file.name:
        return None if _digest(file) == digest else f"other files match {file}"
    if not file.is_file():
        return f"{file} is missing"
    return None if _digest(file) == digest else f"{file} was changed"


def of_xml(path: Path) -> set[Path]:
    """Every file that a Mitsuba scene names, itself and included scenes too.

    Mitsuba looks beside the scene, in the folders of <path> and in the working folder; all that are there count.
    """
    found: set[Path] = set()
    _follow(path, [path.parent, Path.cwd()], {}, found)
    return found


def _follow(path: Path, folders: list[Path], defaults: dict[str, str], found: set[Path]) -> None:
    """Add a scene file and what it names; `folders` and `defaults` hold for what it includes, too."""
    if path in found:
        return
    found.add(path)
    try:
        elements = list(ElementTree.parse(path).iter())
    except (ElementTree.ParseError, OSError, ValueError):
        return  # Mitsuba says what is wrong with it
    folders.append(path.parent)
    for element in elements:
        if element.tag == "default":
            defaults.setdefault(element.get("name", ""), element.get("value", ""))
        if element.tag == "path":
            folders += [folder / element.get("value", "") for folder in list(folders)]
    for element in elements:
        for value in element.attrib.values():
            written = re.sub(r"\$(\w+)", lambda match: defaults.get(match[1], match[0]), value)
            for folder in dict.fromkeys(folders):
                with contextlib.suppress(OSError, ValueError):  # no name of a file
                    file = (folder / written).resolve()
                    if file.is_file() and element.tag == "include":
                        _follow(file, folders, defaults, found)
                    elif file.is_file():
                        found.add(file)


@dataclasses.dataclass
class _Trace:
    """Files opened for reading and folders listed by this process, in Python."""

    opened: set[Path] = dataclasses.field(default_factory=set)
    listed: set[Path] = dataclasses.field(default_factory=set)


_active: ContextVar[_Trace | None] = ContextVar("active", default=None)
_hooks: list[object] = []  # a hook cannot be taken away, so there is one
_own_modules: set[str] = set()  # imported by own scenes: imported again by the next, which is traced like the first


@contextlib.contextmanager
def _tracing() -> Iterator[_Trace]:
    if not _hooks:
        _hooks.append(_see)
        sys.addaudithook(_see)
    for name in _own_modules:
        sys.modules.pop(name, None)
    before = set(sys.modules)
    token = _active.set(trace := _Trace())
    try:
        yield trace
    finally:
        _active.reset(token)
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and _counts(Path(file).resolve()):
                _own_modules.add(name)
                trace.opened.add(Path(file).resolve())


def _see(event: str, arguments: tuple[Any, ...]) -> None:
    """The audit hook: what a scene opens or lists while it is made, without imports of packages and the engine."""
    if event not in ("open", "os.listdir", "os.scandir") or (trace := _active.get()) is None:
        return
    with contextlib.suppress(Exception):  # a hook that raises would stop the scene
        path = Path(os.path.realpath(os.fsdecode(arguments[0])))
        if not _counts(path) or _for_itself():
            return
        if event != "open":
            trace.listed.add(path)
        elif not arguments[2] & (os.O_WRONLY | os.O_RDWR):
            trace.opened.add(path)


def _for_itself() -> bool:
    """Whether Python's importer or our choice of an engine opens the file, and not the user's scene."""
    frame = sys._getframe(2)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith("<frozen importlib") or name in (backend.__file__, engine.__file__):
            return True
        if not name.startswith("<") and _counts(Path(os.path.realpath(name))):
            return False
        frame = frame.f_back  # type: ignore[assignment]
    return False


def _counts(path: Path) -> bool:
    """Whether a file is the user's."""
    if str(path).startswith(_LEFT_OUT) or not _PARTS_LEFT_OUT.isdisjoint(path.parts):
        return False
    return "__pycache__" not in path.parts and not (path.parent == _LIBRARY and path.suffix == ".py")


def _imported(path: Path, found: set[Path] | None = None) -> set[Path]:
    """A Python file and the modules that it imports, if they are the user's: those that were there before, too."""
    found = set() if found is None else found
    if path in found:
        return found
    found.add(path)
    with contextlib.suppress(SyntaxError, OSError, ValueError):
        for node in ast.walk(ast.parse(path.read_bytes())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or "", *(f"{node.module}.{name}" for name in names)]
            for name in names:
                file = getattr(sys.modules.get(name), "__file__", None)
                if file and _counts(Path(file).resolve()):
                    _imported(Path(file).resolve(), found)
    return found


def _named_in(scene: Any) -> set[Path]:
    """The files whose names a scene's records hold: pictures are read when it is rendered."""
    found: set[Path] = set()
    for item in nested(scene):
        if isinstance(item, str) and 0 < len(item) < 4096:
            with contextlib.suppress(OSError, ValueError):
                found |= {Path(item).resolve()} if Path(item).is_file() else set()
    return found


def _digest(file: Path) -> str:
    """SHA-256 of a file, or of the names that match a pattern."""
    if "*" in file.name:
        return files.sha256(files.to_json(sorted(path.name for path in file.parent.glob(file.name))))
    return files.sha256(file)


def _name(file: Path, root: Path) -> str:
    return str(file.relative_to(root)) if file.is_relative_to(root) else str(file)
