"""The recipe `challenge` from its clips to a submission: sensing, check, cubes, restoring, report."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import fakes
import numpy as np
import pytest

from qsim.cli.program import main
from qsim.dataset import generation, recipe
from qsim.formats.challenge import cubes
from quiver.cli.program import main as quiver


def small(frames: int, height: int, width: int, grey: bool = False) -> str:
    """The shipped recipe at another size, with bands and filters or (`grey`, for the renderer of tests) without."""
    text = recipe.text_of("challenge")[1]
    if grey:
        text = "".join(line for line in text.splitlines(True) if not line.startswith(("bands", "colour")))
    changes = (("frames = 1024", frames), ("height = 800", height), ("width = 800", width))
    for line, value in changes:
        assert text.count(line) == 1
        text = text.replace(line, f"{line.split()[0]} = {value}")
    return text


def to_submission(folder: Path, method: str) -> dict[str, object]:
    """Check a data set, write its cubes, restore those of the test split, and report; return the description."""
    data = folder / "data"
    out = folder / "cubes"
    assert main(["check", str(data)]) == 0
    assert main(["convert", str(data), str(out), "--to", "challenge", "--window", "64"]) == 0
    line = ["restore", str(out / "test"), "-o", str(folder / "s.zip"), "--planes", "3", "--method", method]
    assert quiver(line) == 0
    assert main(["report", str(data), "-o", str(folder / "report.html")]) == 0
    with zipfile.ZipFile(folder / "s.zip") as archive:
        assert (
            archive.namelist() == [f"{cube.name}.png" for cube in cubes(out / "test")] == ["text_0000_x0.2/000000.png"]
        )
    found: dict[str, object] = json.loads((folder / "s.json").read_text())
    return found


def test_the_shipped_recipe_has_the_size_of_the_benchmark():
    jobs = recipe.load("challenge").jobs
    for job in jobs:
        assert (job.settings.frames, job.settings.height, job.settings.width) == (1024, 800, 800)
        assert [stream.stream_name for stream in job.streams] == ["red", "green", "blue"]
        assert len({stream.seed for stream in job.streams}) == 3
    assert {job.split for job in jobs} == {"train", "test"}


def test_from_the_recipe_to_a_submission(tmp_path):
    """64 planes of an odd size, drawn from a quick renderer of tests: every clip becomes one cube with its truth."""
    generation.generate(recipe.parse(small(64, 16, 13, grey=True)), tmp_path / "data", fakes.HERE, make=fakes.make)
    found = to_submission(tmp_path, "moment")
    assert isinstance(found["psnr"], float)
    every = {split: cubes(tmp_path / "cubes" / split) for split in ("train", "test")}
    assert [cube.name for cube in every["train"]] == [
        f"{name}_x0.2/000000" for name in ("fan_0000", "fan_0001", "room_0000")
    ]
    for cube in every["train"] + every["test"]:
        assert cube.shape == (64, 16, 13)
        truth = cube.truth()
        assert truth is not None
        assert 0 < truth.mean() < 255


@pytest.mark.slow
def test_rendered_scenes_in_the_layout(tmp_path):
    """Rendered fan and text: the restored picture of the last plane is nearer to the truth than one grey."""
    text = small(64, 40, 45)
    (tmp_path / "small.toml").write_text(
        text[: text.index('[[scenes]]\nfamily = "room"')] + text[text.index('[[scenes]]\nfamily = "text"') :]
    )
    assert main(["generate", str(tmp_path / "small.toml"), "-o", str(tmp_path / "data"), "--workers", "0"]) == 0
    found = to_submission(tmp_path, "qbp")
    (cube,) = cubes(tmp_path / "cubes" / "test")
    truth = cube.truth()
    assert truth is not None
    grey = 20 * np.log10(255 / truth.std())
    assert isinstance(found["psnr"], float)
    assert found["psnr"] > grey
    assert (np.ptp(truth.reshape(-1, 3), axis=1) > 0).any(), "the scene has colours"
