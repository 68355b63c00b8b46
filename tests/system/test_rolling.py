"""The shipped recipe `rolling`, made small: rendered, sensed, checked, drawn again, restored and reported."""

from __future__ import annotations

import re

import numpy as np
import pytest

import qsim.cli.program
import quiver.cli.program
from qsim.dataset import recipe
from qsim.scenes import RECIPES
from qsim.streams.clip import Clip
from qsim.streams.rows import Rows


def shipped() -> str:
    return RECIPES["rolling"].read_text(encoding="utf-8")


@pytest.mark.slow  # kernels of the renderer
def test_the_recipe_goes_from_rendering_to_the_report(tmp_path):
    text = re.sub(r"(?m)^(height|width) = 64", r"\1 = 15", shipped()).replace("32.0", "25.0").replace("= 43", "= 16")
    (tmp_path / "rolling.toml").write_text(text)
    folder = tmp_path / "out"
    assert qsim.cli.program.main(["generate", str(tmp_path / "rolling.toml"), "-o", str(folder)]) == 0
    assert qsim.cli.program.main(["generate", str(tmp_path / "rolling.toml"), "-o", str(folder)]) == 0  # nothing to do
    clip = Clip.open(folder / "clips" / "fan_0000_x40")
    assert clip.stream("planes_down").rows == Rows(1.5e-6)
    assert clip.stream("codes_right").rows == Rows(1.5e-6, "right")
    assert [len(clip.stream(name)) for name in ("planes_down", "codes_right", "codes_at_once")] == [15, 2, 2]
    assert qsim.cli.program.main(["check", str(folder), "--redraw"]) == 0
    stream = str(clip.path / "streams" / "codes_right.json")
    restored = str(tmp_path / "restored.npy")
    assert quiver.cli.program.main(["restore", stream, "--method", "likelihood", "-o", restored]) == 0
    assert np.load(restored).shape == (2, 15, 15)
    assert qsim.cli.program.main(["report", str(clip.path), "-o", str(tmp_path / "page.html")]) == 0
    assert "each column 1.5e-06 s later, right" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_recipe_whose_rows_cannot_be_read_in_time_fails_before_rendering():
    for change, message in (
        (
            "row_delay = 1.6e-6",
            r"rolling.toml: streams\[0\] of scenes\[0\]: planes_down: 64 rows of 1.6e-06 s take 0.0001024 s, ",
        ),
        ('row_delay = "fast"', r"rolling.toml: streams\[0\].row_delay: expected a number"),
    ):
        with pytest.raises(ValueError, match=message):
            recipe.parse(shipped().replace("row_delay = 1.5e-6", change, 1), RECIPES["rolling"].relative_to("/"))
    orders = shipped().replace("row_delay = 1.5e-6\nrow_order", "row_order")
    with pytest.raises(
        ValueError, match=r"toml: streams\[\d\]: row_order right: orders rows that have their own time; give row_delay"
    ):
        recipe.parse(orders)
