"""What needs no network works without torch: classical methods, scores and calibration; the others name the package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

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
for name in ("naive", "moment:3", "likelihood", "qbp:3", "qbp-bm3d:3", "transform-denoise", "auto"):
    print(quiver.score(quiver.restore(stream, name), stream).psnr > 5)
run = [
    (quiver.cli.main, "restore c -o v.npy --method qbp-bm3d"),
    (quiver.cli.main, "evaluate c -o scores --split all --methods naive,qbp-bm3d:5,transform-denoise --ppp 3.25"),
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
    assert [line for line in lines if line == "True"] == ["True"] * 7
    assert [line.split()[-1] for line in lines if line.startswith("RAN")] == ["0"] * 4, found.stdout + found.stderr


def test_auto_takes_a_classical_method_and_says_so(folder: Path):
    words = ["restore", "c", "-o", "auto.npy"]
    found = without_torch(f"import quiver.cli; sys.exit(quiver.cli.main({words!r}))", folder)
    assert found.returncode == 0, found.stderr
    assert "auto: qbp-bm3d; mergenet needs the package " in found.stderr + found.stdout


DRAWS = 14
COMPUTE = f"""
import numpy as np
from scipy.ndimage import gaussian_filter
from qsim import QIS, Key
from quiver.baselines import METHODS, arrays
def draw(seed):
    rng = np.random.default_rng(seed)
    (height, width), frames = rng.integers(9, 80, 2), int(rng.integers(1, 9))
    light = gaussian_filter(rng.random((height + 40, width + 40)), rng.uniform(0.7, 4))
    light = (light - light.min()) * 10 ** rng.uniform(-0.3, 1.3) / np.ptp(light)
    moves = np.round(20 + np.outer(np.arange(frames), rng.uniform(-2, 2, 2))).astype(int)
    photons = np.stack([light[v : v + height, u : u + width] for v, u in moves])
    sensor = QIS(bits=int(rng.integers(1, 5)), quantum_efficiency=0.8, dark_current=1.6, read_noise=0.2)
    codes = np.stack([sensor.sample(frame, 5e-4, key=Key(seed, 7, t)) for t, frame in enumerate(photons)])
    name = ("qbp", "qbp-bm3d", "transform-denoise", "qbp-published")[seed % 4]
    middle = range(frames // 2, frames // 2 + 1)
    video = METHODS[name].restore(codes, sensor, 5e-4, window=int(rng.choice([1, 3, 5, 11])), frames=middle)
    psnr = 10 * np.log10(photons.max() ** 2 / np.mean((video - photons[middle.start]) ** 2))
    return video, name, psnr
found = [draw(seed) for seed in range({DRAWS})]
"""


def test_numpy_restores_what_torch_restores(folder: Path):
    """Random sizes, clips, sensors and windows. BM3D may take another of two blocks that are equally similar.

    Over 60 draws of every method PSNR differed by 0.0013 dB (root mean square), at most by 0.015 dB.
    """
    write = "np.savez('n.npz', *(video for video, *_ in found), psnr=[psnr for *_, psnr in found])"
    there = without_torch(f"{COMPUTE}\nassert not arrays.TORCH\n{write}", folder)
    assert there.returncode == 0, there.stderr
    here: dict[str, Any] = {}
    exec(COMPUTE, here)
    assert here["arrays"].TORCH
    with np.load(folder / "n.npz") as file:
        for i, (video, name, psnr) in enumerate(here["found"]):
            other = file[f"arr_{i}"]
            assert other.dtype == np.float32
            assert abs(file["psnr"][i] - psnr) < 0.02, (i, name)
            if name in ("qbp", "qbp-published"):
                np.testing.assert_allclose(other, video, rtol=1e-4, atol=1e-4 * video.mean())


@pytest.mark.parametrize("method", ["path-merge", "mergenet"])
def test_methods_that_need_torch_name_it(folder: Path, method: str):
    words = ["restore", "c", "-o", f"{method}.npy", "--method", method]
    found = without_torch(f"import quiver.cli; sys.exit(quiver.cli.main({words!r}))", folder)
    assert found.returncode == 2
    assert "needs the package " in found.stderr
    assert "which is not installed: pip install " in found.stderr
    assert "Traceback" not in found.stderr
    assert not list(folder.glob(f"{method}.npy*"))
