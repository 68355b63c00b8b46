"""Options of the rendering commands that cannot act are refused with one sentence; and `validate light`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from small_scenes import plate

import scenes
from qsim.cli.program import main
from qsim.cli.validate import ACTING
from qsim.dataset import recipe
from qsim.scene import SunSky
from qsim.studies.validation import light
from qsim.studies.validation.light import LightReport, LightRow

ROW = LightRow("a/0", 36.0, 36.4, 36.3, 30.0, 30.1, 32, 4, True, -0.0040, 0.0043, 0.0002)
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
    with pytest.raises(ValueError, match=r"t\.toml:9: an \.xml scene stands still, its speed changes nothing"):
        recipe.parse(head + "speed=2.0\n", place / "t.toml")
    again = "[[scenes]]\nfamily='still.xml'\nseeds=[1]\nsplit='val'\n"
    with pytest.raises(
        ValueError, match=r"scene still is in the splits 'train' and 'val'; an \.xml scene is one scene"
    ):
        recipe.parse(head + again, place / "t.toml")
    assert len(recipe.parse(head + "count=2\n", place / "t.toml").jobs) == 2


def test_a_plan_for_programs_knows_its_machines(monkeypatch, place, capsys):
    from qsim.dataset import cost_forecast

    found = cost_forecast.Forecast((), "llvm", 1.0)
    monkeypatch.setattr(cost_forecast, "forecast", lambda *_, **__: found)
    assert main(["plan", str(place / "t.toml"), "--machines", "4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["machines"] == 4


def test_the_verdict_on_light_needs_error_and_light_as_said():
    good = LightReport(8, 10, "llvm", (ROW,))
    assert good.ok
    assert "as announced" in light.table(good)
    for wrong in (replace(ROW, reached=35.4), replace(ROW, light=-0.0106), replace(ROW, light=0.0043)):
        bad = replace(good, rows=(ROW, wrong))
        assert not bad.ok
        assert "NOT as asked or announced: a/0" in light.table(bad)
        assert json.loads(json.dumps(bad.to_dict()))["ok"] is False
    with pytest.raises(ValueError, match="at least one scene"):
        light.run([])


def test_a_small_scene_has_the_error_and_the_light_that_are_said():
    """A plate in sun and sky, 24 x 33 pixels, six frames; errors of so few pixels are known to about 5 %."""
    report = light.run([plate(None, light=SunSky())], levels=(32.0,), reference_samples=512, frames=tuple(range(6)))
    (row,) = report.rows
    assert row.ok
    assert row.stated == pytest.approx(row.reached, abs=1.5)
    assert row.reached_unclamped <= row.reached


@pytest.mark.slow
@pytest.mark.parametrize("family", ["glossy", "glass", "room", "shadow"])
def test_families_that_tuned_nothing_have_the_light_that_is_announced(family):
    report = light.run([scenes.load(family, seed=4).resized(64, 96)])
    assert report.ok, light.table(report)
