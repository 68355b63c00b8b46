"""The shipped recipe `bracketing`, made small: rendered, sensed, checked, drawn again, restored and reported."""

from __future__ import annotations

import re

import numpy as np
import pytest

import qsim.cli.program
import quiver
import quiver.cli.program
from qsim.dataset import recipe
from qsim.scenes import RECIPES
from qsim.streams.clip import Clip


@pytest.mark.slow  # kernels of the renderer
def test_the_recipe_goes_from_rendering_to_the_report(tmp_path, capsys):
    text = RECIPES["bracketing"].read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(height|width) = 64", r"\1 = 19", text).replace("34.0", "25.0").replace("= 24", "= 9")
    (tmp_path / "b.toml").write_text(text)
    folder = tmp_path / "out"
    assert qsim.cli.program.main(["generate", str(tmp_path / "b.toml"), "-o", str(folder)]) == 0
    assert qsim.cli.program.main(["generate", str(tmp_path / "b.toml"), "-o", str(folder)]) == 0  # nothing to do
    assert qsim.cli.program.main(["check", str(folder), "--redraw"]) == 0
    clip = Clip.open(folder / "clips" / "glossy_0000_x2")
    stream = clip.stream("bracketed")
    assert stream.shares == (1.0, 0.25, 0.0625)
    found = {}
    for name in ("bracketed", "full"):
        path = str(tmp_path / f"{name}.npy")
        command = ["restore", str(clip.path / "streams" / f"{name}.json"), "--method", "likelihood", "-o", path]
        assert quiver.cli.program.main(command) == 0
        found[name] = np.load(path)
    truth = stream.truth()
    white = stream.sensor.white(stream.exposure)
    bright = truth > 2 * white
    error = {name: np.median(np.abs(video / truth - 1)[bright]) for name, video in found.items()}
    assert error["bracketed"] < 0.5 * error["full"]
    assert qsim.cli.program.main(["report", str(clip.path), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "exposures of 1, 0.25, 0.0625 of a code&#39;s time in turn" in page
    with pytest.raises(ValueError, match="method 'qbp': takes equal exposures only; use naive, moment, likelihood"):
        quiver.restore(stream, "qbp")


@pytest.mark.parametrize("shares", ["[1.0, 0.0]", "[]", "-1.0", "[1.0, 2.0]", '["long"]'])
def test_a_recipe_with_an_impossible_schedule_names_the_place(shares):
    text = RECIPES["bracketing"].read_text(encoding="utf-8")
    with pytest.raises(
        ValueError, match=r"recipe.toml: streams\[\d\].exposures.*: expected .*a number from 1e-06 to 1"
    ):
        recipe.parse(text.replace("[1.0, 0.25, 0.0625]", shares))
