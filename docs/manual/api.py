"""Writes the pages of the API reference, one per room and one per module with further public names.

What a room's `__init__.py` exports is described on the room's page; other public classes and functions are on the pages
of their modules. Docstrings are Markdown and become reStructuredText here, which Sphinx's autodoc reads.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import shutil
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType
from typing import Any

from qsim.cli.documented_keys import fields_of

PACKAGES = ("qsim", "quiver")


def write_pages(app: Any) -> None:
    """Write docs/api/*.rst; files that do not change keep their time, so that Sphinx does not read them again."""
    folder = Path(app.srcdir) / "api"
    folder.mkdir(exist_ok=True)
    wanted = pages()
    for path in folder.iterdir():
        if path.stem not in wanted:
            path.unlink() if path.is_file() else shutil.rmtree(path)
    for name, text in wanted.items():
        path = folder / f"{name}.rst"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


@lru_cache
def pages() -> dict[str, str]:
    """Return the text of every page by the name of its room or module."""
    rooms = {name: module for name, module in _modules().items() if hasattr(module, "__path__")}
    homes = _homes(rooms)
    found = {name: _room_page(name, module, homes) for name, module in rooms.items()}
    for name, module in _modules().items():
        if name not in rooms and (own := _own(module, set(homes))):
            found[name] = _module_page(name, module, own)
    return {name: text + _below(name, set(found)) for name, text in found.items()}


def _below(name: str, found: set[str]) -> str:
    """Return a table and a menu of the pages below a room; the rooms of a package are in the table of all rooms."""
    below = sorted(
        other for other in found if other.rpartition(".")[0] == name and not (is_room(other) and name in PACKAGES)
    )
    if not below:
        return ""
    rows = _table([(other, other.rpartition(".")[2], inline(charter(other))) for other in below], "doc")
    menu = "".join(f"   {other}\n" for other in below)
    return f"\nModules\n-------\n\n{rows}\n.. toctree::\n   :hidden:\n\n{menu}"


def _modules() -> dict[str, ModuleType]:
    """Return every public module; those of the command lines are in the command reference."""
    names = list(PACKAGES)
    for package in PACKAGES:
        names += [found.name for found in walk_packages(import_module(package).__path__, f"{package}.")]
    public = [name for name in names if not re.search(r"\._|\.cli\b", name)]
    return {name: import_module(name) for name in sorted(public)}


def is_room(name: str) -> bool:
    """Return whether a page describes a room, not one module."""
    return hasattr(import_module(name), "__path__")


def charter(name: str) -> str:
    """Return the first sentence of a room's docstring."""
    return (import_module(name).__doc__ or "").partition("\n")[0]


def _homes(rooms: dict[str, ModuleType]) -> dict[int, str]:
    """Return {identity of an exported object: its full name in the room that describes it}.

    The deepest room with its files describes it; a package such as `qsim` lists the names of its rooms.
    """
    found: dict[int, str] = {}
    for room in sorted(rooms, key=lambda name: (-name.count("."), name)):
        for name in exported(rooms[room]):
            found.setdefault(id(getattr(rooms[room], name)), f"{room}.{name}")
    return found


def exported(module: ModuleType) -> list[str]:
    """Return the names that a room exports."""
    names = getattr(module, "__all__", None)
    return sorted(names if names is not None else _own(module, set()), key=str.lower)


def _own(module: ModuleType, described: set[int]) -> list[str]:
    """Return the public classes and functions that a module defines, in its order, but for those described already."""
    return [
        name
        for name, thing in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(thing) or inspect.isfunction(thing))
        and thing.__module__ == module.__name__
        and id(thing) not in described
    ]


def _room_page(name: str, module: ModuleType, homes: dict[int, str]) -> str:
    """Return the page of a room: charter, table of its names, their descriptions, its modules."""
    parts = [_heading(name), f".. automodule:: {name}\n   :no-index:\n   :no-members:\n"]
    things = {own: getattr(module, own) for own in exported(module)}
    if things:
        parts.append(_table([(homes[id(thing)], own, summary(thing)) for own, thing in things.items()]))
    parts += [_directive(name, own, thing) for own, thing in things.items() if homes[id(thing)] == f"{name}.{own}"]
    return "\n".join(parts)


def _module_page(name: str, module: ModuleType, own: list[str]) -> str:
    parts = [_heading(name), f".. automodule:: {name}\n   :no-index:\n   :no-members:\n"]
    return "\n".join([*parts, *(_directive(name, one, getattr(module, one)) for one in own)])


def _heading(text: str) -> str:
    return f"{text}\n{'=' * len(text)}\n"


def _table(rows: list[tuple[str, str, str]], role: str = "py:obj") -> str:
    """Return a table of names with links and first sentences."""
    lines = [".. list-table::", "   :class: names", "   :widths: 1 3", ""]
    for target, name, what in rows:
        lines += [f"   * - :{role}:`{name} <{target}>`", f"     - {what}"]
    return "\n".join(lines) + "\n"


def summary(thing: Any) -> str:
    """Return the first line of a docstring as reStructuredText; an empty text for constants."""
    if not (inspect.isclass(thing) or inspect.isfunction(thing)):
        return ""
    return inline((inspect.getdoc(thing) or "").partition("\n")[0])


def _directive(home: str, name: str, thing: Any) -> str:
    """Return the directive that describes an object."""
    if inspect.isclass(thing):
        return f".. autoclass:: {home}.{name}\n   :members:\n   :show-inheritance:\n"
    if inspect.isfunction(thing):
        return f".. autofunction:: {home}.{name}\n"
    return f".. py:data:: {home}.{name}\n\n   {_constant(home, name)}\n"


def _constant(home: str, name: str) -> str:
    """Return the comment behind a constant, or its members."""
    thing = getattr(import_module(home), name)
    if isinstance(thing, dict):
        return ", ".join(f"``{key}``" for key in thing)
    return inline(str(thing))


# Docstrings


def convert_docstring(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Convert a docstring in place, and add the meanings of the fields of a dataclass."""
    lines[:] = restructured(lines)
    if what == "class" and dataclasses.is_dataclass(thing):
        meanings = fields_of(thing)
        lines += ["", *(f":param {field}: {inline(text)}" for field, text in meanings.items() if text), ""]


def restructured(lines: list[str]) -> list[str]:
    """Return the lines of a Markdown docstring as reStructuredText: code, literal blocks and lists."""
    found: list[str] = []
    literal = item = False
    for number, line in enumerate(lines):
        blank = not line.strip()
        before = lines[number - 1] if number else ""
        if not literal and not item and line.startswith("    ") and not before.strip():
            found += ["::", ""]
            literal = True
        elif literal and not blank and not line.startswith(" "):
            literal = False
        if not literal:
            if re.match(r"\s*([-*]|\d+\.) ", line):
                if before.strip() and not item:
                    found.append("")
                item = True
            elif not blank and not line.startswith(" "):
                if item and before.strip():
                    found.append("")
                item = False
        found.append(line if literal or blank else inline(line))
    return found


def inline(text: str) -> str:
    """Return a line of Markdown as reStructuredText: code has two backticks or is a link, other marks are escaped."""
    bullet = re.match(r"\s*(?:[-*] )?", text)
    assert bullet is not None
    parts = re.split(r"(``[^`]+``|`[^`]+`|\*\*[^*]+\*\*)", text[bullet.end() :])
    return bullet[0] + "".join(_code(part) if number % 2 else _escaped(part) for number, part in enumerate(parts))


def _code(part: str) -> str:
    """Return a marked part: names of classes and of our packages become links where Sphinx finds them."""
    name = part.strip("`")
    if re.fullmatch(r"(?:qsim|quiver|scenes)(?:\.\w+)+|[A-Z]\w*[a-z]\w*(?:\.\w+)?", name):
        return f":py:obj:`{name}`"
    return f"`{part}`" if part.startswith("`") and not part.startswith("``") else part


def _escaped(part: str) -> str:
    return re.sub(r"[*|`\\]|(?<=\w)_(?!\w)", lambda mark: f"\\{mark[0]}", part)
