"""Writes tables of the keys of recipes and of `[defects]`, in place of `<!-- keys: SECTION -->`.

The keys and what they accept come from the checks that read the files; examples and meanings come from the commented
file in the docstring of the module that reads it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple

# Section -> module with the commented file, module of its checks, and their name.
_RECIPE, _SECTIONS = "qsim.dataset.recipe", "qsim.dataset.recipe_sections"
_DEFECTS = "qsim.sensor.defects.defect_table"
SECTIONS = {
    "[recipe]": (_RECIPE, _RECIPE, "HEAD"),
    "[[scenes]]": (_RECIPE, f"{_SECTIONS}.scenes_section", "SCENES"),
    "[[streams]]": (_RECIPE, f"{_SECTIONS}.streams_section", "STREAMS"),
    "[defects]": (_DEFECTS, _DEFECTS, "TABLE"),
}
_MARK = re.compile(r"^<!-- keys: (\[\S+\]) -->$", re.MULTILINE)


class Key(NamedTuple):
    """One key of a section."""

    name: str
    needed: bool
    accepts: str
    example: str
    meaning: str


def insert(text: str) -> str:
    """Return a page with tables in place of its comments."""
    return _MARK.sub(lambda found: table(keys(found[1])), text)


def keys(section: str) -> list[Key]:
    """Return the keys of a section, in the order of its checks."""
    commented_in, checked_in, name = SECTIONS[section]
    text = import_module(commented_in).__doc__ or ""
    examples = commented(text, "[recipe]") | commented(text, section)  # [[scenes]] may repeat keys of [recipe]
    return [
        Key(entry.removesuffix(", if any"), ", if any" not in entry, accepted(check), *examples[entry.split(",")[0]])
        for entry, check in flat(getattr(import_module(checked_in), name))
    ]


def flat(checks: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (entry, check) of a table and of the tables in it, with dotted keys."""
    for entry, check in checks.items():
        if isinstance(check, Mapping):
            yield from flat(check, f"{above}{entry.removesuffix(', if any')}.")
        else:
            yield above + entry, check


def commented(text: str, section: str) -> dict[str, tuple[str, str]]:
    """Return {key: (example, meaning)} of a section of a commented TOML file."""
    found: dict[str, tuple[str, str]] = {}
    lines = text.partition(f"    {section}")[2].splitlines()[1:]
    for line in lines:
        if re.match(r"    \[|\S", line):
            break
        if entry := re.match(r"    ([\w.]+) = (.*?)\s+# (.*)", line):
            found[entry[1]] = (entry[2], entry[3])
    return found


def accepted(check: Any) -> str:
    """Return what a check expects, in the words of its message about values that it refuses."""
    for refused in (1e30, object()):  # beyond every limit; of no kind that TOML has
        try:
            check(refused)
        except ValueError as error:
            return str(error).removeprefix("expected ").partition(", got")[0]
    return ""


def table(rows: list[Key]) -> str:
    """Return a Markdown table of keys."""
    lines = ["| key | accepts | meaning |", "|---|---|---|"]
    for key in rows:
        needed = "**Required.** " if key.needed else ""
        cells = (f"`{key.name} = {key.example}`", key.accepts, needed + key.meaning[:1].upper() + key.meaning[1:])
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
