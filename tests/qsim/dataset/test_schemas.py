"""The JSON Schemas beside the pages are those of the records, and shipped files keep to them."""

import json
import tomllib
from pathlib import Path

import pytest

from qsim import files
from qsim.dataset import recipe_file, schemas
from qsim.scenes import RECIPES
from qsim.sensor.devices import MODELS

FOLDER = Path(__file__).parents[3] / "docs" / "schemas"


@pytest.mark.parametrize("name", schemas.SCHEMAS)
def test_the_stored_schema_is_that_of_the_records(name: str):
    stored = (FOLDER / f"{name}.schema.json").read_bytes()
    assert stored == files.to_json(schemas.SCHEMAS[name]()), "write it: python -m qsim.dataset.schemas docs/schemas"


def test_every_key_of_the_shipped_recipes_is_in_the_schema():
    known = schemas.of_recipes()["$defs"]
    kinds = {key: known[record.__name__] for key, record in recipe_file.SECTIONS.items()}
    for path in RECIPES.values():
        written = tomllib.loads(path.read_text())
        tables = [("[recipe]", written["recipe"]), *(("[[scenes]]", each) for each in written["scenes"])]
        tables += [("[[streams]]", each) for each in written.get("streams", [])]
        for section, table in tables:
            assert table.keys() <= kinds[section]["properties"].keys()
            assert set(kinds[section].get("required", ())) <= table.keys()
        assert written.keys() <= known["RecipeFile"]["properties"].keys()


def test_a_schema_refuses_what_the_reader_refuses():
    found = schemas.of_recipes()["$defs"]
    assert not any(kind["additionalProperties"] for kind in found.values())
    assert found["Head"]["required"] == ["name", "frames", "height", "width"]
    assert found["ScenesSection"]["properties"]["psnr"] == found["Head"]["properties"]["psnr"]
    assert (found["Head"]["properties"]["psnr"]["minimum"], found["Head"]["properties"]["psnr"]["maximum"]) == (10, 80)
    assert '"null"' not in json.dumps(found)
    sensors = schemas.of_sensor_files()["$defs"]
    assert len(sensors["OtherTables"]["properties"]["sensor"]["oneOf"]) == len(MODELS)
    assert sensors["DefectKeys"]["properties"]["crosstalk"]["minimum"] == 0
