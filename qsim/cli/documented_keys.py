"""Lists the keys of recipes and sensor files: what each accepts, an example, and its meaning.

Keys and what they accept come from the records that the files are read into. They are settings, which declare meanings
and examples; of the numbers of a sensor class the comments of its fields do.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from qsim import records
from qsim.dataset import recipe_file
from qsim.rendering.render_settings import RenderSettings
from qsim.sensor.colour_filter import ColourKeys
from qsim.sensor.defects.defect_table import DefectKeys
from qsim.sensor.file_laws import SensorKeys
from qsim.settings import Setting, settings_of
from qsim.streams.sensing import Sensing
from qsim.tables import text_table

SENSOR_FILE: dict[str, Any] = {"[sensor]": SensorKeys, "[defects]": DefectKeys, "[colour]": ColourKeys}
SOURCES = "[sources]"
RECIPE = tuple(recipe_file.SECTIONS)


class Key(NamedTuple):
    """One key of a section."""

    name: str
    needed: bool
    accepts: str
    example: str
    meaning: str


# ---- Sections of files


def keys(section: str) -> list[Key]:
    """Return the keys of a section of a recipe or of a sensor file."""
    return recipe_keys(section) if section in RECIPE else sensor_keys(section)


def recipe_keys(section: str) -> list[Key]:
    """Return the keys of a section of a recipe, in the order of its record: what their settings declare."""
    shared = {one.name: one for kind in (RenderSettings, Sensing) for one in settings_of(kind)}
    inherited = {"seed", *(one.name for one in settings_of(RenderSettings))} if section != RECIPE[0] else set()
    found = []
    for one in settings_of(recipe_file.SECTIONS[section]):
        default = one.default_words or shared.get(one.name, one).default_words
        if one.name in inherited:
            default = f"that of {RECIPE[0]}"
        if section == RECIPE[2] and one.name in recipe_file.StreamsKeys.LIGHT:
            default = f"none; one of {', '.join(recipe_file.StreamsKeys.LIGHT)} is needed"
        told = replace(one, unset="" if one.required else default)
        example = _example(replace(one, default=shared.get(one.name, one).default))
        found.append(Key(one.name, one.required, one.expected, json.dumps(example), told.help_with_default))
    return found


def _example(one: Setting) -> Any:
    """Return an example of a setting: what it states, else another than its default."""
    if one.example is not None:
        return one.example
    if any(records.bare_type(member) is bool for member in records.members_of(one.hint)):
        return one.default is not True
    return one.choices[0] if one.choices else one.default


def sensor_keys(section: str) -> list[Key]:
    """Return the keys of a section of a sensor file, in the order of its record: what their settings declare."""
    if section == SOURCES:
        meaning = "where the number of this key of [sensor] comes from; one line per key"
        return [Key("median", False, "a text", '"data sheet, page 3"', meaning)]
    return list(_keys_of(SENSOR_FILE[section]))


def _keys_of(record: Any, above: str = "") -> Iterator[Key]:
    """Yield the keys of a record and of the records in it; one for each example of a table of equal entries."""
    declared = {one.name: one for one in settings_of(record)}
    for field in dataclasses.fields(record):
        if (one := declared.get(field.name)) is None:
            (inner,) = (
                m for m in records.members_of(records.hints_of(record)[field.name]) if dataclasses.is_dataclass(m)
            )
            yield from _keys_of(inner, f"{above}{field.name}.")
            continue
        example = one.default if one.example is None else one.example
        each = example.items() if isinstance(example, dict) else [("", example)]
        for name, value in each:
            full = f"{above}{one.name}.{name}".rstrip(".")
            yield Key(full, one.required, one.expected, json.dumps(value), one.help_with_default)


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
    laws = {"[sensor] of any model, laws": keys("[sensor]"), SOURCES: keys(SOURCES)}
    return models | laws | {section: keys(section) for section in SENSOR_FILE if section != "[sensor]"}


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
