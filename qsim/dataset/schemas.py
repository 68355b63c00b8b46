"""Makes the JSON Schemas of recipes and sensor files, by which editors complete and check them.

    python -m qsim.dataset.schemas docs/schemas      writes recipe.schema.json and sensor.schema.json

They come from the records that read these files, so that they hold the same names, bounds and lines of help.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
from pathlib import Path
from typing import Any, Literal

import msgspec

from qsim import files, records
from qsim.dataset.recipe_file import RecipeFile
from qsim.kinds import Text
from qsim.sensor.colour_filter import ColourKeys
from qsim.sensor.defects.defect_table import DefectKeys
from qsim.sensor.devices import MODELS
from qsim.sensor.file_laws import SensorKeys

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_NULL = {"type": "null"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class OtherTables:
    """The tables of a sensor file beside [sensor]."""

    sources: dict[str, Text] = dataclasses.field(default_factory=dict)
    defects: DefectKeys | None = None
    colour: ColourKeys | None = None


def of_recipes() -> dict[str, object]:
    """Return the JSON Schema of a recipe."""
    found = msgspec.json.schema(RecipeFile)
    return {"$schema": _DIALECT, "title": "A recipe of qsim"} | _closed(found)


def of_sensor_files() -> dict[str, object]:
    """Return the JSON Schema of a sensor file: [sensor] has the keys of one model, and those of every model."""
    tables = [_table_of(name) for name in MODELS]
    (*models, others), definitions = msgspec.json.schema_components(
        [*tables, OtherTables], ref_template="#/$defs/{name}"
    )
    top = definitions[others["$ref"].rpartition("/")[2]]
    top["properties"] = {"sensor": {"oneOf": models}} | top["properties"]
    top["required"] = ["sensor"]
    return {"$schema": _DIALECT, "title": "A sensor file of qsim"} | _closed(others | {"$defs": definitions})


def _table_of(model: str) -> Any:
    """Return the record of [sensor] of a model; a law may stand for any of its numbers, so that none is required."""
    hints = records.hints_of(MODELS[model])
    optional = [(name, hint | None, None) for name, hint in hints.items()]
    return dataclasses.make_dataclass(
        f"{model} sensor", [("model", Literal[model]), *optional], bases=(SensorKeys,), frozen=True, kw_only=True
    )


def _closed(schema: Any) -> Any:
    """Return a schema as TOML needs it: records take no other keys, and there is no null."""
    if isinstance(schema, list):
        return [_closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    found = {key: _closed(value) for key, value in schema.items() if (key, value) != ("default", None)}
    if isinstance(found.get("description"), str):
        found["description"] = inspect.cleandoc(found["description"])  # as Python 3.13 keeps it
    if "properties" in found and isinstance(found["properties"], dict) and found.get("type") == "object":
        found.setdefault("additionalProperties", False)
    alternatives = [item for item in found.get("anyOf", []) if item != _NULL]
    if "anyOf" in found and len(alternatives) == 1:
        del found["anyOf"]
        return alternatives[0] | found
    return found | ({"anyOf": alternatives} if alternatives else {})


SCHEMAS = {"recipe": of_recipes, "sensor": of_sensor_files}


def write(folder: Path) -> None:
    """Write all schemas into a folder."""
    for name, made in SCHEMAS.items():
        files.write_json(folder / f"{name}.schema.json", made())


if __name__ == "__main__":
    write(Path(sys.argv[1]))
