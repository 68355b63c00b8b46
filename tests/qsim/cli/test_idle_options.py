"""Tests that rendering commands refuse options without effect in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim import scenes
from qsim.cli.program import main
from qsim.cli.validate import ACTING
from qsim.dataset import recipe

VALUES = {"output": "x.png", "pixels": "100", "scenes": "fan", "height": "24", "width": "32", "psnr": "30"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("idle")
    clip = write_clip(folder / "clip", frames=3, height=16, width=24)
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3", "--name", "s", "-q"]) == 0
    np.save(folder / "values.npy", np.random.default_rng(1).random((3, 16, 24)).astype(np.float32))
    np.save(folder / "codes.npy", np.zeros((3, 16, 24), np.uint8))
    np.save(folder / "truth.npy", np.zeros((3, 16, 24), bool))
    np.save(folder / "packed.npy", np.zeros((3, 16, 3), np.uint8))
    still = "from small_scenes import plate\n\n\ndef scene(seed=0, *, speed=1.0):\n    return plate(None)\n"
    (folder / "still.py").write_text(still)
    (folder / "still.xml").write_text("<scene version='3.0.0'/>")
    text = "[recipe]\nname='t'\nframes=2\nheight=8\nwidth=8\nframe_rate=2000.0\n[[scenes]]\nfamily='fan'\n"
    (folder / "t.toml").write_text(text)
    return folder


IDLE = [  # words, the option that is named
    ("render fan --explain --force", "--force"),
    ("render still.py -o r --speed 2", "speed 2"),
    ("render still.xml -o r --speed 2", "speed 2"),
    ("generate t.toml -o d --workers 0 --memory 2", "--memory"),
    ("generate t.toml -o d --gpus 1", "--gpus"),
    ("generate t.toml -o d --cluster tcp://127.0.0.1:1 --workers 1", "--workers"),
    ("generate t.toml -o d --cluster tcp://127.0.0.1:1 --memory 1", "--memory"),
    ("preview clip --force", "--force"),
    ("preview clip --scale 2", "--scale"),
    ("preview clip --fps 10", "--fps"),
    ("preview clip -o p.png --fps 10", "--fps"),
    ("preview clip -o p.gif --play", "--play"),
    ("preview clip --play --frame 1", "--frame"),
    ("preview clip -o p.gif --frame 1 --fps 5", "--frame"),
    ("preview clip --bits 3", "--bits"),
    ("preview clip --width 24", "--width"),
    ("preview clip --what sharp --stream s", "--stream"),
    ("preview clip/streams/s.json --bits 3", "--bits"),
    ("preview clip/streams/s.npy --width 24", "--width"),
    ("preview clip/streams/s.npy --stream s", "--stream"),
    ("preview values.npy --bits 3", "--bits"),
    ("preview values.npy --width 3", "--width"),
    ("preview truth.npy --bits 1", "--bits"),
    ("preview packed.npy --width 24 --bits 3", "--bits"),
    ("preview codes.npy --bits 3 --stream s", "--stream"),
    *(
        (f"validate {what} --{option.replace('_', '-')} {VALUES.get(option, '')}", f"--{option.replace('_', '-')}")
        for what, acting in ACTING.items()
        for option in sorted({name for names in ACTING.values() for name in names} - set(acting))
    ),
    ("validate sensor --force", "--force"),
    ("validate render --force", "--force"),
]


@pytest.mark.parametrize(("words", "option"), IDLE, ids=[words for words, _ in IDLE])
def test_an_option_that_cannot_act_is_refused(place, monkeypatch, capsys, words, option):
    monkeypatch.chdir(place)
    before = sorted(path for path in place.rglob("*") if "__pycache__" not in str(path))
    assert main(words.split()) == 2
    message = capsys.readouterr().err
    assert option in message
    assert message.count("\n") == 1
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
    with pytest.raises(
        ValueError, match=r"scene still is in the splits 'train' and 'val'; an \.xml scene is the same scene"
    ):
        recipe.parse(head + again, place / "t.toml")
    assert len(recipe.parse(head + "count=2\n", place / "t.toml").jobs) == 2


def test_a_plan_for_programs_knows_its_machines(monkeypatch, place, capsys):
    from qsim.dataset import cost_forecast

    found = cost_forecast.Forecast((), "llvm", 1.0)
    monkeypatch.setattr(cost_forecast, "forecast", lambda *_, **__: found)
    assert main(["plan", str(place / "t.toml"), "--machines", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["machines"] == 4
