"""Tests that a scene which stands still, and a recipe of it, refuse a speed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from qsim import scenes
from qsim.cli.program import main
from qsim.dataset import recipe


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("still")
    still = "from small_scenes import plate\n\n\ndef scene(seed=0, *, speed=1.0):\n    return plate(None)\n"
    (folder / "still.py").write_text(still)
    (folder / "still.xml").write_text("<scene version='3.0.0'/>")
    text = "[recipe]\nname='t'\nframes=2\nheight=8\nwidth=8\nframe_rate=2000.0\n[[scenes]]\nfamily='fan'\n"
    (folder / "t.toml").write_text(text)
    return folder


@pytest.mark.parametrize("name", ["still.py", "still.xml"])
def test_a_scene_that_stands_still_refuses_a_speed(place, monkeypatch, capsys, name):
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert main(["render", name, "-o", "r", "--speed", "2"]) == 2
    assert "speed 2" in capsys.readouterr().err
    assert sorted(path for path in place.rglob("*") if "__pycache__" not in str(path)) == before


def test_a_scene_file_that_uses_its_speed_is_taken(place):
    moving = place / "moving.py"
    text = "from small_scenes import plate\nfrom qsim.scene.motion import Spin\n\n\ndef scene(seed=0, *, speed=1.0):\n"
    moving.write_text(text + "    return plate(Spin((0, 0, 1), 200.0 * speed))\n")
    assert scenes.load(moving, speed=2.0).bodies[1].motion.rate == 400.0
    assert scenes.load(place / "still.py").name == "test"


def test_a_recipe_knows_that_an_xml_scene_stands_still_and_is_one(place):
    head = (place / "t.toml").read_text().replace("family='fan'", "family='still.xml'")
    with pytest.raises(
        ValueError, match=r"t\.toml: scenes\[0\]: an \.xml scene has no motion, so speed changes nothing"
    ):
        recipe.parse(head + "speed=2.0\n", place / "t.toml")
    again = "[[scenes]]\nfamily='still.xml'\nseeds=[1]\nsplit='val'\n"
    with pytest.raises(ValueError, match=r"scene still is in the splits 'train' and 'val'; the file is the same scene"):
        recipe.parse(head + again, place / "t.toml")
    assert len(recipe.parse(head + "count=2\n", place / "t.toml").jobs) == 2


def test_a_plan_for_programs_knows_its_machines(monkeypatch, place, capsys):
    from qsim.dataset import cost_forecast

    found = cost_forecast.Forecast((), "llvm", 1.0)
    monkeypatch.setattr(cost_forecast, "forecast", lambda *_, **__: found)
    assert main(["plan", str(place / "t.toml"), "--machines", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["machines"] == 4
