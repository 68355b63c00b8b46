"""Finds the sections of a recipe's TOML text, and the line of each key for error messages."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.files import check_name
from qsim.parsing import parse_toml
from qsim.structure import Table, structure


def file_name(value: Any) -> str:
    """Return a text that can name a file."""
    return check_name(checks.text(value))


@dataclass(frozen=True)
class Text:
    """A TOML file as it was written."""

    path: Path
    text: str

    @property
    def lines(self) -> list[str]:
        """Return the lines of the file."""
        return self.text.splitlines()

    def content(self) -> dict[str, Any]:
        """Return the parsed content; `ValueError` as `FILE:LINE: ...` if it is not TOML."""
        return parse_toml(self.path, self.text)

    def where(self, section: str | None, i: int, key: str | None = None) -> str:
        """Return `FILE:LINE` of a key in the i-th section of that name, or of the section's head without a key."""
        number = 0
        inside = section is None
        seen = -1
        for n, line in enumerate(self.lines, 1):
            head = re.match(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?", line)
            if head:
                seen += head[1] == section
                inside = head[1] == (key if section is None else section) and (section is None or seen == i)
                if inside:
                    number = n
                    if key is None or section is None:
                        break
            elif inside and key is not None and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", line):
                number = n
                break
        return f"{self.path}:{number or self._mention(section, key)}"

    def _mention(self, section: str | None, key: str | None) -> int:
        """Return the first line with `key =`, or else with the section, for tables written in line or with dots."""
        for word in (key, section):
            for n, line in enumerate(self.lines, 1):
                if word and re.search(rf"(?<![\w-]){re.escape(word)}[\"']?\s*[=.]", line):
                    return n
        return 1


@dataclass(frozen=True)
class Section:
    """A table of a recipe: the whole file (no name), [recipe], or the i-th of [[scenes]] or [[streams]]."""

    text: Text
    name: str | None
    i: int
    table: dict[str, Any]

    @property
    def title(self) -> str:
        """Return the section's name as it is written."""
        return {None: "the recipe", "recipe": "[recipe]"}.get(self.name, f"[[{self.name}]]")

    def where(self, key: str | None = None) -> str:
        """Return `FILE:LINE` of a key, or of the section's head."""
        return self.text.where(self.name, self.i, key)

    @contextlib.contextmanager
    def naming(self, key: str | None = None, words: str = "") -> Iterator[None]:
        """Put file and line of a key, or of the head of the section, and some words before the message of an error."""
        try:
            yield
        except (ValueError, OSError) as error:
            raise ValueError(f"{self.where(key)}: {words}{error}") from None

    def values(self, table: Table) -> dict[str, Any]:
        """Return the values as their checks return them; `ValueError` with the line of the wrong key."""
        return structure(self.table, table, self.where, of=self.title)

    def sections(self, key: str) -> list[Section]:
        """Return the tables [[key]] of the file, in their order."""
        tables = self.table.get(key, [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise ValueError(f"{self.text.where(key, 0)}: '{key}' must be sections, each beginning with [[{key}]]")
        return [Section(self.text, key, i, table) for i, table in enumerate(tables)]
