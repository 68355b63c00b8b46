"""The recipe `readouts` from its clips to a comparison: spike camera, conventional camera and quanta sensor."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import fakes
import numpy as np
import pytest

from qsim.cli.program import main
from qsim.dataset import generation, recipe
from qsim.scenes import RECIPES
from qsim.streams.clip import Clip
from quiver.cli.program import main as quiver

TEXT = '[[scenes]]\nfamily = "text"'


def small(folder: Path, frames: int, height: int, width: int) -> Path:
    """The shipped recipe at another size and with one of its scenes, and its sensors beside it."""
    text = recipe.text_of("readouts")[1]
    for line, value in (("frames = 132", frames), ("height = 250", height), ("width = 400", width)):
        assert text.count(line) == 1
        text = text.replace(line, f"{line.split()[0]} = {value}")
    shutil.copytree(RECIPES["readouts"].parent / "sensors", folder / "sensors")
    (folder / "readouts.toml").write_text(text[: text.index("[[scenes]]")] + text[text.index(TEXT) :])
    return folder / "readouts.toml"


def compared(clip: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    """Return the PSNR of each stream of a clip, and of the light under the empty name."""
    capsys.readouterr()
    assert main(["compare", str(clip), "--json"]) == 0
    return {row["stream"]: row["psnr_db"] for row in json.loads(capsys.readouterr().out)["rows"]}


def test_from_the_recipe_to_a_comparison(tmp_path, capsys):
    """Clips of a quick renderer of tests: the streams state their light, and the spikes come back from their file."""
    path = small(tmp_path, 24, 16, 13)
    generation.generate(recipe.load(path), tmp_path / "data", fakes.HERE, make=fakes.make)
    assert main(["check", str(tmp_path / "data")]) == 0
    clip = Clip.open(tmp_path / "data" / "clips" / "text_0000")
    assert set(compared(clip.path, capsys)) == {"", "spike", "conventional", "quanta"}
    assert main(["convert", str(clip.path / "streams" / "spike.json"), str(tmp_path / "spike.dat")]) == 0
    spike = clip.stream("spike")
    conventional = clip.stream("conventional")
    assert (len(spike), len(conventional)) == (24, 2)
    assert conventional.exposure == pytest.approx(12 * spike.exposure)
    assert conventional.photons_factor == pytest.approx(spike.photons_factor)
    assert conventional.sensor.gain == pytest.approx(4095 / 10_000)
    back = tmp_path / "back"
    words = ["convert", str(tmp_path / "spike.dat"), str(back), "--frame-rate", "20000"]
    assert main([*words, "--sensor", str(tmp_path / "sensors" / "spike.toml")]) == 0
    np.testing.assert_array_equal(np.load(f"{back}.npy"), np.load(spike.path))


@pytest.mark.slow
def test_rendered_scenes_compare_as_their_physics_says(tmp_path, capsys):
    """Drawn again, restored and reported; no readout beats the light of its span, and spikes are the coarsest."""
    path = small(tmp_path, 36, 40, 48)
    assert main(["generate", str(path), "-o", str(tmp_path / "data"), "--workers", "0"]) == 0
    capsys.readouterr()
    assert main(["check", str(tmp_path / "data"), "--redraw"]) == 0
    assert "all hold the reference's codes" in capsys.readouterr().out
    clip = tmp_path / "data" / "clips" / "text_0000"
    for method in ("moment", "auto"):
        out = str(tmp_path / f"{method}.npy")
        assert quiver(["restore", str(clip), "--stream", "spike", "--method", method, "-o", out]) == 0
    assert main(["report", str(tmp_path / "data"), "-o", str(tmp_path / "report.html")]) == 0
    assert "SpikeCamera" in (tmp_path / "report.html").read_text()
    scores = compared(clip, capsys)
    assert scores["spike"] < scores["conventional"] < scores[""] + 0.1
