"""What needs no network works without torch: classical methods, scores and calibration; the others name the package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "safetensors", "tensorboard"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocked())
"""


def without_torch(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run code in a process that cannot import torch."""
    return subprocess.run(
        [sys.executable, "-c", BLOCKED + code], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip with a stream, and frames for a calibration."""
    place = tmp_path_factory.mktemp("notorch")
    write_clip(place / "c", frames=12, height=12, width=14).sense(ppp=3.25, bits=3)
    rng = np.random.default_rng(0)
    for name, light in (("dark", 0.002), ("flat", 0.3)):
        np.save(place / f"{name}.npy", rng.binomial(50, light, (200, 8, 8)).astype(np.uint8))
    return place


def test_classical_methods_scores_and_calibration_run(folder: Path):
    code = """
import quiver, quiver.cli, qsim.cli
from qsim import Clip
stream = Clip.open("c").stream("quiver-physical_3bit_3.25ppp")
for name in ("naive", "moment:3", "likelihood"):
    print(quiver.score(quiver.restore(stream, name), stream).psnr > 5)
run = [
    (quiver.cli.main, "restore c -o v.npy --method moment"),
    (quiver.cli.main, "evaluate c -o scores --split all --methods naive,moment --ppp 3.25"),
    (qsim.cli.main, "calibrate --planes 50 --dark dark.npy 1e-5 --flat flat.npy 1e-5 0.9 -o s.toml"),
    (qsim.cli.main, "report . -o page.html"),
]
for main, line in run:
    print("RAN", line, main(line.split() + ["--quiet"]))
assert "torch" not in sys.modules
"""
    found = without_torch(code, folder)
    assert found.returncode == 0, found.stderr
    lines = found.stdout.splitlines()
    assert lines[:3] == ["True"] * 3
    assert [line.split()[-1] for line in lines if line.startswith("RAN")] == ["0"] * 4, found.stdout + found.stderr


@pytest.mark.parametrize("method", ["qbp", "transform-denoise", "nano"])
def test_methods_that_need_torch_name_it(folder: Path, method: str):
    words = ["restore", "c", "-o", f"{method}.npy", "--method", method]
    found = without_torch(f"import quiver.cli; sys.exit(quiver.cli.main({words!r}))", folder)
    assert found.returncode == 2
    assert "needs the package " in found.stderr
    assert "which is not installed: pip install " in found.stderr
    assert "Traceback" not in found.stderr
    assert not list(folder.glob(f"{method}.npy*"))
