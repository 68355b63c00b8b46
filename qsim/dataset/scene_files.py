"""Loads a scene and finds the user's files that it reads, so that a resumed run notices an edit of any of them.

    load(family, seed, speed) -> the scene, and {file: SHA-256}

* Python: the file, the modules of the user that it imports, the files that the scene's records name (a texture), and
  those that the file declares, beside it or by absolute names:

      reads = ["numbers.txt", "meshes/*.obj"]

  With a pattern the names of all files that match it count, too: another mesh may be the one that a seed picks.
* glTF: the file, and the buffers and pictures that it names.
* Mitsuba XML: each file that an attribute names, in this file and in those that it includes.
* A folder of assets: every file in it.

Names are relative to the scene's file; files outside its folder have absolute names. Installed packages, this program
and caches are left out. Families of the library read no files of the user.
"""

from __future__ import annotations

import ast
import contextlib
import os
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from qsim import files, limits, opening, scenes
from qsim.dataset.provenance import nested
from qsim.scene import Scene
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES
from qsim.scene.animated.gltf_buffers import files_of

_INSTALLED = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
_LEFT_OUT = tuple(f"{os.path.realpath(folder)}{os.sep}" for folder in (*_INSTALLED, str(Path(__file__).parents[1])))
_LIBRARY = Path(scenes.__file__).resolve().parent
# of one Mitsuba scene
MOST_FOLDERS = 100
_PARTS_LEFT_OUT = frozenset({".cache", "site-packages", "dist-packages", "__pycache__"})


def load(
    family: str | Path,
    seed: int = 0,
    speed: float = 1.0,
    *,
    along_path: bool = False,
    bands: Literal["rgb"] | None = None,
    camera: str | None = None,
    start: float | None = None,
) -> tuple[Scene, dict[str, str]]:
    """Load a scene as `scenes.load` does, with the SHA-256 of each file read; empty for a family of the library.

    `ValueError` for a Python file whose `reads` is no list of texts, or names a file that does not exist.
    """
    view: dict[str, Any] = {"along_path": along_path, "bands": bands, "camera": camera, "start": start}
    path = Path(family).resolve()
    if str(family) in scenes.FAMILIES or not path.exists():
        return scenes.load(family, seed, speed, **view), {}
    declared = _declared(path) if path.suffix == ".py" else {}
    known = set(sys.modules)
    scene = scenes.load(family, seed, speed, **view)
    if path.is_dir():
        found = {file for file in path.rglob("*") if file.is_file()}
        return scene, {_name(file, path): _digest(file) for file in sorted(found)}
    if path.suffix == ".xml":
        found = of_xml(path)
    elif path.suffix in GLTF_SUFFIXES:
        found = {path, *files_of(path)}
    else:
        found = {path, *_imported(path), *_named_in(scene)}
        _forget(set(sys.modules) - known)
        for file in [file for file in found if file.suffix == ".xml"]:
            found |= of_xml(file)
    found = {file for file in found if file.is_file() and (file == path or _counts(file))}
    for pattern, matching in declared.items():
        found |= matching
        if "*" in pattern.name:
            found.add(pattern)
    return scene, {_name(file, path.parent): _digest(file) for file in sorted(found)}


def _declared(path: Path) -> dict[Path, set[Path]]:
    """Return the files that match each entry of `reads` in a Python file."""
    return {path.parent / entry: _matching(path, entry) for entry in _reads(path)}


def _reads(path: Path) -> list[str]:
    """Return the list `reads` of a Python file as it is written, without running it; empty if it has none."""
    try:
        body = ast.parse(opening.content(path)).body
    except (SyntaxError, OSError, ValueError):
        return []  # the loader reports the error
    found = [node for node in body if _binds_reads(node)]
    if not found:
        return []
    entries = _written_out(found[0])
    if len(found) > 1 or not isinstance(entries, list | tuple) or not all(isinstance(one, str) for one in entries):
        raise ValueError(
            f'{path}, line {found[-1].lineno}: reads is a list of names, written out once, as in reads = ["a.obj"]'
        )
    return list(entries)


def _written_out(node: ast.stmt) -> Any:
    """Return the plain value of `name = value` or `name: type = value`; None for any other statement."""
    plain = isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name)
    if not plain and not isinstance(node, ast.AnnAssign):
        return None
    try:
        return ast.literal_eval(node.value)  # type: ignore[attr-defined]
    except (ValueError, TypeError):
        return None


def _binds_reads(node: ast.stmt) -> bool:
    """Return whether a statement of a file gives `reads` a value, in whatever way; inside a function it is another."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return False
    names = [found for found in ast.walk(node) if isinstance(found, ast.Name) and isinstance(found.ctx, ast.Store)]
    return any(found.id == "reads" for found in names)


def _matching(path: Path, entry: str) -> set[Path]:
    """Return the files that one entry of `reads` names."""
    pattern = path.parent / entry
    if "*" in pattern.name:
        found = {file for file in pattern.parent.glob(pattern.name) if file.is_file()}
    else:
        found = {pattern} if pattern.is_file() else set()
    if not found:
        raise ValueError(f"{path}: reads names {entry!r}, and there is no such file beside it")
    return found


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
    if len(found) > limits.SCENE_FILES:
        raise ValueError(f"{path}: a scene that names more than {limits.SCENE_FILES} files")
    elements = _elements(path)
    if _plain(path.parent) not in folders:
        folders.append(_plain(path.parent))
    for element in elements:
        if element.tag == "default":
            defaults.setdefault(element.get("name", ""), element.get("value", ""))
        if element.tag == "path":
            _add_folders(path, element.get("value", ""), folders)
    for element in elements:
        for file in _named_by(element, folders, defaults):
            if element.tag == "include":
                _follow(file, folders, defaults, found)
            else:
                found.add(file)


def _elements(path: Path) -> list[ElementTree.Element]:
    """Return the elements of an XML file; none of a file that is none, about which Mitsuba reports."""
    try:
        return list(ElementTree.parse(path).iter())
    except (ElementTree.ParseError, OSError, ValueError):
        return []


def _add_folders(path: Path, value: str, folders: list[Path]) -> None:
    """Add what a <path> names in every folder; `ValueError` for more folders than a scene needs."""
    added = [folder / value for folder in folders]
    folders += [folder for folder in dict.fromkeys(map(_plain, added)) if folder not in folders]
    if len(folders) > MOST_FOLDERS:
        raise ValueError(f"{path}: names more than {MOST_FOLDERS} folders by <path>")


def _named_by(element: ElementTree.Element, folders: Sequence[Path], defaults: Mapping[str, str]) -> Iterator[Path]:
    """Yield the existing files that the attributes of an element name, in any of the folders."""
    for value in element.attrib.values():
        written = re.sub(r"\$(\w+)", lambda match: defaults.get(match[1], match[0]), value)
        for folder in dict.fromkeys(folders):
            with contextlib.suppress(OSError, ValueError):  # the value is not the name of a file
                file = (folder / written).resolve()
                if file.is_file():
                    yield file


def _plain(folder: Path) -> Path:
    """Return a folder without `.` and `..`, so that one folder has one name."""
    return Path(os.path.normpath(folder))


def _counts(path: Path) -> bool:
    """Return whether a file belongs to the user."""
    if str(path).startswith(_LEFT_OUT) or not _PARTS_LEFT_OUT.isdisjoint(path.parts):
        return False
    return not (path.parent == _LIBRARY and path.suffix == ".py")


def _imported(path: Path, found: set[Path] | None = None) -> set[Path]:
    """Return a Python file and the modules of the user that it imports, also those imported before."""
    found = set() if found is None else found
    if path in found:
        return found
    found.add(path)
    with contextlib.suppress(SyntaxError, OSError, ValueError):
        for node in ast.walk(ast.parse(opening.content(path))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or "", *(f"{node.module}.{name}" for name in names)]
            for module in {part for name in names for part in _packages(name)}:
                file = getattr(sys.modules.get(module), "__file__", None)
                if file and _counts(Path(file).resolve()):
                    _imported(Path(file).resolve(), found)
    return found


def _packages(name: str) -> list[str]:
    """Return a module's name after those of the packages that it lies in: a, a.b, a.b.c."""
    parts = name.split(".")
    return [".".join(parts[: n + 1]) for n in range(len(parts))]


def _forget(names: set[str]) -> None:
    """Forget the user's modules among these: a scene in another folder may have others of the same names."""
    for name in names:
        file = getattr(sys.modules.get(name), "__file__", None)
        if file and _counts(Path(file).resolve()):
            del sys.modules[name]


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
