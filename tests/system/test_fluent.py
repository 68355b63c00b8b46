"""The chain of a notebook, from a scene to a score, after every module was imported: none hides a function."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

import qsim
import quiver
from quiver.cli import main

ROOT = Path(__file__).parents[2]
FUNCTIONS = {"qsim": ("render", "sense", "replay", "pack", "unpack"), "quiver": ("restore", "score", "windows")}


def test_the_chain_runs_after_every_module_was_imported():
    code = f"""
import importlib, pkgutil, qsim, quiver
for package in (qsim, quiver):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
for package, names in {FUNCTIONS!r}.items():
    for name in names:
        function = getattr(globals()[package], name)
        assert callable(function) and not hasattr(function, "__path__"), name

clip = qsim.render("fan", frames=11, height=16, width=20, psnr=20)
stream = clip.sense(qsim.QIS(0.8, 1.6, 0.2, 3), ppp=3.25)
video = quiver.restore(stream, "moment")
score = quiver.score(video, stream)
assert video.shape == stream.codes.shape == stream.truth().shape == (11, 16, 20)
assert 5 < score.psnr <= score.psnr_matched < 60
item = quiver.windows(stream, crop=16)[0]
assert item["codes"].shape == item["target"].shape == (11, 1, 16, 16)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_the_command_and_the_function_restore_by_the_same_default(tmp_path: Path):
    clip = write_clip(tmp_path / "c", frames=12, height=16, width=20)
    stream = clip.sense(ppp=3.25, bits=3)
    assert main(["restore", str(clip.path), "-o", str(tmp_path / "v.npy"), "--quiet"]) == 0
    np.testing.assert_array_equal(quiver.restore(stream), np.load(tmp_path / "v.npy"))


@pytest.mark.parametrize("package", ["qsim", "quiver"])
def test_types_are_shipped(package: str):
    assert (ROOT / package / "py.typed").is_file()


@pytest.mark.slow
def test_a_user_gets_types(tmp_path: Path):
    """mypy finds the types of the chain in a user's program, through the lazy names."""
    program = tmp_path / "mine.py"
    program.write_text(
        "import qsim, quiver\n"
        'clip = qsim.render("fan", frames=3)\n'
        "reveal_type(clip)\n"
        "reveal_type(clip.sense(qsim.QIS(0.8, 1.6, 0.2, 3), ppp=3.25))\n"
        "reveal_type(quiver.score(quiver.restore(clip.sense(ppp=1.0)), clip.sense(ppp=1.0)).psnr)\n"
        'clip.sense(ppp="bright")\n'
    )
    found = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), str(program)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    for words in ('"qsim.streams.clip.Clip"', '"qsim.streams.stream.Stream"', '"float"', '"ppp" to "sense"'):
        assert words in found.stdout, found.stdout


def test_names_are_listed():
    assert {"render", "Clip"} <= set(dir(qsim))
    assert {"restore", "score", "windows"} <= set(dir(quiver))
