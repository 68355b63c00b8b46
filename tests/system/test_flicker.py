"""The shipped recipe `flicker`, made small: rendered, sensed, checked, drawn again, restored and reported."""

from __future__ import annotations

import re

import numpy as np
import pytest

import qsim.cli.program
import quiver.cli.program
from qsim.dataset import recipe
from qsim.scenes import RECIPES
from qsim.streams.clip import Clip


@pytest.mark.slow  # eight seconds of rendering and of kernels
def test_the_recipe_goes_from_rendering_to_the_report(tmp_path, capsys):
    text = RECIPES["flicker"].read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(height|width) = 64", r"\1 = 15", text).replace("seeds = [0, 1]", "seeds = [1]")
    (tmp_path / "flicker.toml").write_text(text.replace("frames = 21", "frames = 9").replace("34.0", "25.0"))
    assert recipe.load(tmp_path / "flicker.toml").name == "flicker"
    folder = tmp_path / "out"
    assert qsim.cli.program.main(["generate", str(tmp_path / "flicker.toml"), "-o", str(folder)]) == 0
    clip = Clip.open(folder / "clips" / "mains_0001_x8")
    tube = clip.strengths["light1"]
    led = clip.strengths["light2"]
    assert len(tube) == len(led) == 9
    assert np.ptp(led) > 0.5  # switched off in some frames
    brightness = np.array([frame.mean() for frame in clip])
    share = np.linalg.lstsq(np.column_stack([np.ones(9), tube, led]), brightness, rcond=None)[0]
    fitted = np.column_stack([np.ones(9), tube, led]) @ share
    assert np.abs(fitted - brightness).max() < 0.1 * np.ptp(brightness)  # beside the motion, light follows the lamps
    assert qsim.cli.program.main(["check", str(folder), "--redraw"]) == 0
    stream = next(iter((clip.path / "streams").glob("*.json")))
    restored = str(tmp_path / "restored.npy")
    assert quiver.cli.program.main(["restore", str(stream), "--method", "likelihood", "-o", restored]) == 0
    assert qsim.cli.program.main(["report", str(clip.path), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Flicker, exact means over the exposures: light1 (" in page
    assert "strength of the lights that flicker" in page
