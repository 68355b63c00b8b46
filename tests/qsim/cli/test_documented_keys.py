"""Tests that every key which a reader takes is listed, with a meaning."""

import json
from dataclasses import fields

import pytest

from qsim import records
from qsim.cli import documented_keys
from qsim.cli.program import main
from qsim.dataset import recipe_file
from qsim.sensor import devices, file_laws
from qsim.sensor.defects import defect_table


def printed(words, capsys):
    """The sections that a command prints as JSON: {section: {key: its row}}."""
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["sections"]
    return {section: {row["name"]: row for row in rows} for section, rows in found.items()}


def test_every_key_of_a_recipe_is_printed(capsys):
    found = printed(["recipes", "--keys"], capsys)
    assert set(found) == set(recipe_file.SECTIONS)
    for section, record in recipe_file.SECTIONS.items():
        assert set(found[section]) == set(records.hints_of(record))
        assert all(row["meaning"] and row["accepts"] for row in found[section].values())
    assert found["[recipe]"]["reuse"]["meaning"].endswith("(default: where a trial costs little against the clip)")
    assert found["[[scenes]]"]["psnr"]["meaning"].endswith("(default: that of [recipe])")
    assert found["[[streams]]"]["seed"]["meaning"].endswith("(default: that of [recipe])")


def test_every_key_of_a_sensor_file_is_printed(capsys):
    found = printed(["sensors", "--keys"], capsys)
    assert {section.partition("]")[0].strip("[") for section in found} == set(devices.TABLES)
    for model, kind in devices.MODELS.items():
        assert set(found[f"[sensor] of a {model}"]) == {"model", *(field.name for field in fields(kind))}
        assert found[f"[sensor] of a {model}"]["model"]["meaning"]
    assert set(found["[sensor] of any model, laws"]) == {*file_laws.KEYS, "iso"}
    assert set(found["[defects]"]) == {key for key, *_ in documented_keys.flat(defect_table.DefectKeys)}
    assert set(found["[colour]"]) == {"mask", *(f"efficiency.{colour}" for colour in "RGBW")}
    meanings = [row["meaning"] for rows in found.values() for row in rows.values() if row["name"] != "bits"]
    assert all(meanings)
    assert found["[defects]"]["crosstalk"]["meaning"].endswith("for any of them (default 0)")


@pytest.mark.parametrize("name", list(devices.DEVICES))
def test_every_sensor_is_listed_with_what_it_is(name, capsys):
    assert main(["sensors"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.split()[0] == name and len(line.split()) > 3 for line in lines) == 1
