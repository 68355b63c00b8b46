"""Loads a scene and finds the user's files that it reads, so that a resumed run notices an edit of any of them.

    load(family, seed, speed) -> the scene, and {file: SHA-256}

* Mitsuba XML: each file that an attribute names, in this file and in those that it includes.
* Python: modules that it imports, files that it opens while the scene is made, and files that the scene names. If it
  lists a folder and opens files in it, the names of all files with these endings count too (`meshes/*.obj`).
* A folder of assets: every file in it.

Names are relative to the scene's file; files outside its folder have absolute names. Installed packages, this program,
caches and the system's /proc, /sys and /dev are left out, but for files of users in /dev/shm. Families of the library
read no files of the user.
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

from qsim import backend, files, scenes
from qsim.dataset.provenance import nested
from qsim.rendering import engine
from qsim.scene import Scene

_INSTALLED = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
_LEFT_OUT = tuple(
    f"{os.path.realpath(folder)}{os.sep}" for folder in (*_INSTALLED, str(Path(__file__).parents[1]), "/proc", "/sys")
)
_DEVICES, _SHARED = "/dev/", "/dev/shm/"  # the second holds files of users
_LIBRARY = Path(scenes.__file__).resolve().parent
MOST_FOLDERS, MOST_FILES = 100, 10_000  # of one Mitsuba scene
_PARTS_LEFT_OUT = frozenset({".cache", "site-packages", "dist-packages"})


def load(
    family: str | Path, seed: int = 0, speed: float = 1.0, *, along_path: bool = False, bands: str | None = None
) -> tuple[Scene, dict[str, str]]:
    """Load a scene as `scenes.load` does, with the SHA-256 of each file read; empty for a family of the library."""
    path = Path(family).resolve()
    if str(family) in scenes.FAMILIES or not path.exists():
        return scenes.load(family, seed, speed, along_path=along_path, bands=bands), {}
    with _tracing() as trace:
        scene = scenes.load(family, seed, speed, along_path=along_path, bands=bands)
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
    """Return how a file changed since its scene was rendered, or None if it is the same; `name` as `load` gives it."""
    path = Path(family) if Path(family).is_dir() else Path(family).parent
    file = path / name
    if "*" in file.name:
        return None if _digest(file) == digest else f"other files match {file}"
    if not file.is_file():
        return f"{file} is missing"
    return None if _digest(file) == digest else f"{file} was changed"


def of_xml(path: Path) -> set[Path]:
    """Return every file that a Mitsuba scene names, with itself and the scenes that it includes.

    Mitsuba looks beside the scene, in the folders of <path> and in the working folder; all existing files count.
    """
    found: set[Path] = set()
    _follow(path, [_plain(path.parent), Path.cwd()], {}, found)
    return found


def _follow(path: Path, folders: list[Path], defaults: dict[str, str], found: set[Path]) -> None:
    """Add a scene file and the files that it names; `folders` and `defaults` hold for included scenes, too."""
    if path in found:
        return
    found.add(path)
    if len(found) > MOST_FILES:
        raise ValueError(f"{path}: a scene that names more than {MOST_FILES} files")
    try:
        elements = list(ElementTree.parse(path).iter())
    except (ElementTree.ParseError, OSError, ValueError):
        return  # Mitsuba reports the error
    if _plain(path.parent) not in folders:
        folders.append(_plain(path.parent))
    for element in elements:
        if element.tag == "default":
            defaults.setdefault(element.get("name", ""), element.get("value", ""))
        if element.tag == "path":
            added = [folder / element.get("value", "") for folder in folders]
            folders += [folder for folder in dict.fromkeys(map(_plain, added)) if folder not in folders]
            if len(folders) > MOST_FOLDERS:
                raise ValueError(f"{path}: names more than {MOST_FOLDERS} folders by <path>")
    for element in elements:
        for value in element.attrib.values():
            written = re.sub(r"\$(\w+)", lambda match: defaults.get(match[1], match[0]), value)
            for folder in dict.fromkeys(folders):
                with contextlib.suppress(OSError, ValueError):  # the value is not the name of a file
                    file = (folder / written).resolve()
                    if file.is_file() and element.tag == "include":
                        _follow(file, folders, defaults, found)
                    elif file.is_file():
                        found.add(file)


def _plain(folder: Path) -> Path:
    """Return a folder without `.` and `..`, so that one folder has one name."""
    return Path(os.path.normpath(folder))


@dataclasses.dataclass
class _Trace:
    """Files that Python code of this process opened for reading, and folders that it listed."""

    opened: set[Path] = dataclasses.field(default_factory=set)
    listed: set[Path] = dataclasses.field(default_factory=set)


_active: ContextVar[_Trace | None] = ContextVar("active", default=None)
_hooks: list[object] = []  # an audit hook cannot be removed, so only one is added
_own_modules: set[str] = set()  # imported by scenes of the user; the next scene imports them again, and is traced


@contextlib.contextmanager
def _tracing() -> Iterator[_Trace]:
    """Record what a scene opens, lists and imports inside the block."""
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
    """Record, as an audit hook, files that a scene opens or lists while it is made; omit imports and the renderer."""
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
    """Return whether Python's importer or the choice of a backend opens the file, not the user's scene."""
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
    """Return whether a file belongs to the user."""
    device = str(path).startswith(_DEVICES) and not str(path).startswith(_SHARED)
    if device or str(path).startswith(_LEFT_OUT) or not _PARTS_LEFT_OUT.isdisjoint(path.parts):
        return False
    return "__pycache__" not in path.parts and not (path.parent == _LIBRARY and path.suffix == ".py")


def _imported(path: Path, found: set[Path] | None = None) -> set[Path]:
    """Return a Python file and the modules of the user that it imports, also those imported before."""
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
    """Return the files whose names a scene's records hold: pictures are read only during rendering."""
    found: set[Path] = set()
    for item in nested(scene):
        if isinstance(item, str) and 0 < len(item) < 4096:
            with contextlib.suppress(OSError, ValueError):
                found |= {Path(item).resolve()} if Path(item).is_file() else set()
    return found


def _digest(file: Path) -> str:
    """Return the SHA-256 of a file, or of the names that match a pattern."""
    if "*" in file.name:
        return files.sha256(files.to_json(sorted(path.name for path in file.parent.glob(file.name))))
    return files.sha256(file)


def _name(file: Path, root: Path) -> str:
    return str(file.relative_to(root)) if file.is_relative_to(root) else str(file)
