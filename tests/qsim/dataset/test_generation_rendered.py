"""Generation with the real renderer: killed and resumed from the command line, it gives the same bytes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fakes
import pytest
from fakes import tree

from qsim import cli
from qsim.dataset.dataset import Dataset

RECIPE = fakes.RECIPE.replace("height = 8\nwidth = 10\n", "height = 24\nwidth = 32\npsnr = 25.0\n")
RECIPE = RECIPE.replace("bits = [1, 3]\nppp = 3.25", "bits = 3\nppp = [3.25, 26.0]")
RECIPE = RECIPE.replace(
    'seeds = [4]\nsplit = "test"\nframes = 2', 'split = "test"'
)  # a scene without shared photographs


def generate(recipe: Path, folder: Path, *options: str) -> subprocess.Popen[bytes]:
    line = [sys.executable, "-m", "qsim", "generate", str(recipe), "-o", str(folder), *options]
    return subprocess.Popen(line, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)


@pytest.mark.slow
def test_a_killed_generation_resumes_to_the_same_bytes(tmp_path: Path):
    recipe = tmp_path / "real.toml"
    recipe.write_text(RECIPE)
    assert generate(recipe, tmp_path / "whole", "--workers", "1").wait() == 0
    killed = generate(recipe, tmp_path / "killed", "--workers", "2")
    end = time.monotonic() + 300
    while not list((tmp_path / "killed").glob("work/*.part/journal.jsonl")):
        assert time.monotonic() < end, "no frame was ever finished"
        assert killed.poll() is None, "it came to its end before it could be killed"
        time.sleep(0.01)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    assert len(Dataset.open(tmp_path / "killed").names()) < 3
    assert generate(recipe, tmp_path / "killed", "--workers", "2").wait() == 0
    found = Dataset.open(tmp_path / "killed")
    assert found.verify() == []
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")
    for clip in found.clips():
        assert clip.info.psnr_of_truth > 24
        assert [asset for asset in clip.info.assets if asset.startswith("mesh ")]
        for name in clip.streams:
            stream = clip.stream(name)
            assert stream.info.sensing.ppp * 0.5 < stream.codes().mean() / stream.sensor.gain / 0.8 * 2


PLANES = """
[recipe]
name = "planes"
frames = 9
height = 24
width = 32
frame_rate = 10000.0
psnr = 25.0
[[scenes]]
family = "plain"
[[streams]]
sensor = "spad512s"
bits = 2
group = true
ppp = {ppp}
"""


@pytest.mark.slow
@pytest.mark.parametrize(("ppp", "limit"), [(0.5, "25 dB"), (400.0, "400 PPP")])
def test_a_recipe_of_sums_renders_codes_and_names_the_limit(tmp_path: Path, capsys, ppp, limit):
    """Three planes share the noise of a code, and the plan states the same limit."""
    recipe = tmp_path / "planes.toml"
    recipe.write_text(PLANES.format(ppp=ppp))
    assert cli.main(["generate", str(recipe), "-o", str(tmp_path / "set"), "--workers", "0", "-q"]) == 0
    assert f"the samples follow from {limit} in 1 clip" in capsys.readouterr().out
    (clip,) = Dataset.open(tmp_path / "set").clips()
    assert clip.info.render is not None
    assert (clip.info.render.planes, clip.info.render.codes) == (3, (3,))
    assert len(clip.info.error_per_code) == 3
    assert clip.info.psnr_of_truth >= 24.5
    assert [clip.info.has("sharp", t) for t in range(9)] == [False, True, False] * 3
    assert cli.main(["plan", str(recipe), "--json", "-q"]) == 0
    (kind,) = json.loads(capsys.readouterr().out)["kinds"]
    assert (kind["planes"], kind["limits"]) == (3, [limit])
