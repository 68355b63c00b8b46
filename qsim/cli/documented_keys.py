"""Lists the keys of recipes and sensor files: what each accepts, an example, and its meaning.

Keys and what they accept come from the records that the files are read into. Examples and
meanings come from the commented file in the docstring of the module that reads it, or from the comments of the fields.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple

from qsim import records
from qsim.settings import settings_of
from qsim.tables import text_table


class Section(NamedTuple):
    """The modules that declare a section of a file."""

    commented_in: str  # its docstring shows the section as a commented file
    checked_in: str = ""
    name: str = ""  # of the record; "": none, the commented lines are the keys


_RECIPE = "qsim.dataset.recipe"
_RECORDS = "qsim.dataset.recipe_file"
_DEFECTS = "qsim.sensor.defects.defect_table"
RECIPE = {
    "[recipe]": Section(_RECIPE, _RECORDS, "Head"),
    "[[scenes]]": Section(_RECIPE, _RECORDS, "ScenesSection"),
    "[[streams]]": Section(_RECIPE, _RECORDS, "StreamsSection"),
}
SENSOR_FILE = {
    "[sensor]": Section("qsim.sensor.file_laws"),
    "[sources]": Section("qsim.sensor.file_laws"),
    "[defects]": Section(_DEFECTS, _DEFECTS, "DefectKeys"),
    "[colour]": Section("qsim.sensor.colour_filter"),
}
SECTIONS = RECIPE | SENSOR_FILE


class Key(NamedTuple):
    """One key of a section."""

    name: str
    needed: bool
    accepts: str
    example: str
    meaning: str


# ---- Sections of files


def keys(section: str) -> list[Key]:
    """Return the keys of a section, in the order of its checks; `ValueError` where Python removed the docstrings."""
    where = SECTIONS[section]
    text = import_module(where.commented_in).__doc__
    if text is None:
        raise ValueError("the keys are described in docstrings, which python -OO removes; run without -OO")
    examples = commented(text, section)
    if not where.name:
        return [Key(name, False, "", *found) for name, found in examples.items()]
    if section in RECIPE:
        examples = commented(text, "[recipe]") | examples  # [[scenes]] may repeat keys of [recipe]
    record = getattr(import_module(where.checked_in), where.name)
    return [Key(name, needed, accepts, *examples[name]) for name, needed, accepts in flat(record)]


def flat(record: Any, above: str = "") -> Iterator[tuple[str, bool, str]]:
    """Yield name, whether it is needed, and what is accepted, of the keys of a record and of the records in it."""
    hints = records.hints_of(record)
    for field in dataclasses.fields(record):
        inner = [member for member in records.members_of(hints[field.name]) if dataclasses.is_dataclass(member)]
        if inner:
            yield from flat(inner[0], f"{above}{field.name}.")
        else:
            needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            yield above + field.name, needed, records.words_of(hints[field.name])


def commented(text: str, section: str) -> dict[str, tuple[str, str]]:
    """Return {key: (example, meaning)} of a section of a commented TOML file; a meaning may continue below."""
    found: dict[str, tuple[str, str]] = {}
    last = ""
    for line in text.partition(f"    {section}")[2].splitlines()[1:]:
        if re.match(r"    \[|\S", line):
            break
        if entry := re.match(r"    ([\w.]+) = (.*?)\s+# (.*)", line):
            last = entry[1]
            found[last] = (entry[2], entry[3])
        elif last and (more := re.match(r"\s{8,}# (.*)", line)):
            example, meaning = found[last]
            found[last] = (example, f"{meaning} {more[1]}")
        else:
            last = ""
    return found


# ---- Fields of sensors


def model_keys(model: str) -> list[Key]:
    """Return the keys of [sensor] of a model, a name of `qsim.sensor.devices.MODELS`: the fields of its class."""
    from qsim.sensor.devices import MODELS

    kind = MODELS[model]
    comments = fields_of(kind)
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    found = [Key("model", True, "the name of a model", f'"{model}"', str(kind.__doc__).partition("\n")[0])]
    for name, required, accepts in flat(kind):
        needed = required and name != "bits"  # a file without bits serves every depth
        default = defaults[name]
        stated = "" if needed or default in (None, dataclasses.MISSING) else f"default {str(default).lower()}"
        meaning = "; ".join(part for part in (comments[name], stated) if part)
        found.append(Key(name, needed, accepts, "", meaning))
    return found


def fields_of(kind: type) -> dict[str, str]:
    """Return the meanings of the fields of a dataclass: what settings say, else the comments behind them."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            found |= _comments(base)
    found |= {setting.name: setting.help_with_default for setting in settings_of(kind)}
    return {field.name: found.get(field.name, "") for field in dataclasses.fields(kind) if field.init}


def _comments(kind: type) -> dict[str, str]:
    """Return the comments behind the fields that a class itself defines; a comment may continue below."""
    lines, _ = inspect.getsourcelines(kind)
    (tree,) = ast.parse(textwrap.dedent("".join(lines))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            last = node.end_lineno or node.lineno
            comment = lines[last - 1].partition("  # ")[2].strip()
            for line in lines[last:]:
                if not re.match(r"\s+# ", line) or not comment:
                    break
                comment += " " + line.strip().removeprefix("# ")
            found[node.target.id] = comment
    return found


# ---- Listings


def of_recipes() -> dict[str, list[Key]]:
    """Return the keys of all sections of a recipe."""
    return {section: keys(section) for section in RECIPE}


def of_sensor_files() -> dict[str, list[Key]]:
    """Return the keys of all sections of a sensor file: those of each model, and those that every model may have."""
    from qsim.sensor.devices import MODELS

    models = {f"[sensor] of a {model}": model_keys(model) for model in MODELS}
    shared = {section: keys(section) for section in SENSOR_FILE}
    laws = [key for key in shared.pop("[sensor]") if key.name != "model"]
    return models | {"[sensor] of any model, laws": laws} | shared


def lines(sections: Mapping[str, Iterable[Key]]) -> list[str]:
    """Return the sections as text: per key a line with an example, and what it accepts and means below it."""
    found: list[str] = []
    for section, rows in sections.items():
        cells = [
            (
                f"  {key.name} = {key.example}" if key.example else f"  {key.name}",
                "required" if key.needed else "",
                f"{key.meaning} ({key.accepts})" if key.accepts and key.meaning else key.meaning or key.accepts,
            )
            for key in rows
        ]
        found += ["", section, *text_table(cells, ("  key", "", "meaning (accepts)"), left=3)]
    return found[1:]
