"""Checks what a Mitsuba scene names before Mitsuba opens it: regular files, and no text that grows without a bound.

A parameter, `<default name="a" value="$b$b"/>`, may repeat another one, and a scene may include another one twice: a
few lines ask for more memory or time than there is.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from qsim import limits, opening

_LONGEST_NAME = 4096  # characters


@dataclass
class _Document:
    """A scene file: its elements, and the scenes that it includes."""

    elements: list[ElementTree.Element]
    included: list[Path]

    def of(self, tag: str) -> list[ElementTree.Element]:
        return [element for element in self.elements if element.tag == tag]


def check(document: Path) -> None:
    """Raise `ValueError` for a pipe or a device, of which Mitsuba would wait for the end, and above the limits.

    Files are looked for where Mitsuba does: beside the document, in folders that it names, and in the working one.
    """
    found = _documents(document)
    size = _expanded(list(found.values()))
    if size > limits.TEXT:
        raise ValueError(f"{document}: its parameters ($NAME) grow to {size:.3g} characters; {limits.TEXT} are read")
    times = _inclusions(document, found)
    if times == math.inf:
        raise ValueError(f"{document}: includes itself, or files more than {limits.BENEATH} levels deep")
    if times > limits.SCENE_FILES:
        raise ValueError(f"{document}: includes {times:.3g} files in all; at most {limits.SCENE_FILES} are read")


def _documents(document: Path) -> dict[Path, _Document]:
    """Return a scene, and those that it includes, with parameters in their names put in."""
    parsed: dict[Path, list[ElementTree.Element]] = {}
    values: dict[str, str] = {}
    while True:
        known = len(parsed), len(values)
        found = _reached(document, parsed, values)
        if (len(parsed), len(values)) == known:
            return found


def _reached(
    document: Path, parsed: dict[Path, list[ElementTree.Element]], values: dict[str, str]
) -> dict[Path, _Document]:
    """Return the scenes that are reached with these values of parameters; add what is parsed, and more values."""
    found: dict[Path, _Document] = {}
    waiting = [document]
    while waiting and len(found) < limits.SCENE_FILES:
        path = waiting.pop()
        if path in found or path.suffix.lower() != ".xml":
            continue
        if path not in parsed:
            parsed[path] = _elements(path)
        made = found[path] = _Document(parsed[path], [])
        values |= {f"${e.get('name', '')}": e.get("value", "") for e in made.of("default")}
        named = [_put_in(e.get("value", "."), values) for e in made.of("path")]
        folders = dict.fromkeys([path.parent, document.parent, Path(), *(path.parent / name for name in named)])
        names = [e.get("value", "") for e in made.of("string") if e.get("name") == "filename"]
        for name in dict.fromkeys(names):
            _places(folders, _put_in(name, values))
        for element in made.of("include"):
            places = _places(folders, _put_in(element.get("filename", ""), values))
            made.included += places[:1]
            waiting += places
    return found


def _elements(path: Path) -> list[ElementTree.Element]:
    """Return the elements of a scene file; none of a damaged one, whose error Mitsuba reports."""
    try:
        return list(ElementTree.fromstring(opening.content(path)).iter())
    except (ElementTree.ParseError, RecursionError):
        return []


def _put_in(name: str, values: dict[str, str]) -> str:
    """Return a name with the values of its parameters; longer ones than a file has are left as they are."""
    for _ in range(limits.BENEATH):
        if "$" not in name or len(name) > _LONGEST_NAME:
            return name
        for parameter in sorted(values, key=len, reverse=True):
            name = name.replace(parameter, values[parameter]) if len(name) <= _LONGEST_NAME else name
    return name


def _places(folders: dict[Path, None], name: str) -> list[Path]:
    """Return the files of a name in some folders; `ValueError` for a pipe or a device."""
    return [opening.regular(folder / name) for folder in folders if name and os.path.exists(folder / name)]


def _expanded(documents: list[_Document]) -> float:
    """Return the most characters that the attributes may have once parameters are put in, in whatever order."""
    longest = 1.0
    growth = 1.0
    for each in documents:
        for element in each.of("default"):
            text = element.get("value", "")
            longest = max(longest, len(text))
            growth *= 1 + text.count("$")
    total = 0
    for each in documents:
        total += sum(value.count("$") for element in each.elements for value in element.attrib.values())
    return min(total * longest * growth, math.inf)


def _inclusions(document: Path, found: dict[Path, _Document]) -> float:
    """Return how many files are read, a file each time that it is included; infinite for a circle."""
    counts: dict[Path, float] = {}

    def count(path: Path, above: tuple[Path, ...]) -> float:
        if path in above or len(above) > limits.BENEATH:
            return math.inf
        if path not in counts:
            inner = found[path].included if path in found else []
            counts[path] = 1 + sum(count(each, (*above, path)) for each in inner)
        return counts[path]

    return count(document, ())
