"""The program that compares a shard with its plan: measures of known clips, sums of known costs, and mistakes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from stats import critical_z

from qsim import records
from qsim.cli.program import main as qsim
from qsim.clip.clip_info import PHYSICAL
from qsim.clip.writer import ClipWriter
from qsim.dataset import cost_forecast, recipe
from qsim.dataset.cost_forecast import Cost, Seconds
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job
from qsim.dataset.provenance import origin
from qsim.optics.camera import Camera
from qsim.streams.clip import Clip

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import shard_contents  # noqa: E402  (docs are not a package)
import shard_cost  # noqa: E402
import shard_page  # noqa: E402

RECIPE = """[recipe]
name = "tiny"
frames = 3
height = 16
width = 24
reuse = false

[[scenes]]
family = "fan"
seeds = [0, 1, 2]

[[scenes]]
family = "drums"
seeds = [0, 1, 2]
"""
SHARED = RECIPE.replace("reuse = false\n", "")
USED = {"drums_0000": 3240, "fan_0000": 1080}  # processor seconds of the clips of shard 1/3


def make(job: Job, path: Path) -> Clip:
    """Make a clip of stripes, whose left half moves by 2 px/frame."""
    frames = job.settings.frames
    height = job.settings.height
    width = job.settings.width
    camera = records.plain(Camera(8e-3, 2.8, 1.1e-6, height, width))
    meta = {"shape": [frames, height, width], "frame_rate": 2000.0, "shutter": 0.0, "exposure": 5e-4}
    meta |= {"radiance_unit": PHYSICAL, "camera": camera, "render": {"samples": 8, "neighbours": 3}}
    flow = np.zeros((2, height, width))
    flow[0, :, : width // 2] = 2
    with ClipWriter(path, meta | records.plain(origin(job))) as writer:
        for t in range(frames):
            writer.add(t, np.tile([1.0, 3.0], (height, width // 2)), truth={"flow": flow}, error=1e-3)
    return Clip.open(path)


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A folder with two recipes, their plans, and a shard whose log states what it cost."""

    def measured(jobs: list[Job], folder: Path, frames: int) -> Cost:
        """3600 processor seconds for a clip of fan: 1200 before its frames, 800 each. Three times that for drums.

        A quarter where frames may share samples.
        """
        less = (1.0 if jobs[0].settings.reuse is False else 0.25) * (3 if jobs[0].stem == "drums" else 1)
        seconds = {"setup": 1200.0, "per_frame": 700.0, "sensing": 100.0}
        clocks = {key: Seconds(value * less / 2, value * less) for key, value in seconds.items()}
        return Cost(jobs[0].stem, (16, 24), len(jobs), 3 * len(jobs), samples=(8, 12), **clocks, frame_bytes=1e6)

    monkeypatch.setattr(cost_forecast, "measure_kind", measured)
    monkeypatch.setattr(cost_forecast, "START", 0.0)
    (tmp_path / "tiny.toml").write_text(RECIPE)
    (tmp_path / "shared.toml").write_text(SHARED)
    generate(recipe.parse(SHARED), tmp_path / "data", Options(workers=0, shard=(1, 3)), make=make)
    for name, seconds in USED.items():
        spent = f"clip 600.00 s, streams 120.00 s, processor {seconds}.00 s, peak 3000 MiB"
        (tmp_path / "data" / "logs" / f"{name}.log").write_text(f" rendering on a\n done on a: {spent}")
    return tmp_path


def plan(place: Path, capsys, name: str, *words: str) -> Path:
    """Store what `qsim plan --json` prints."""
    capsys.readouterr()
    assert qsim(["plan", str(place / f"{name}.toml"), "--json", *words]) == 0
    path = place / f"plan-{name}{len(words)}.json"
    path.write_text(capsys.readouterr().out)
    return path


def run(place: Path, *words: object) -> int:
    line = ["--recipe", place / "tiny.toml", "--shard", "1/3", "--out", place / "out" / "tiny", *words]
    return shard_cost.main(list(map(str, line)))


# ---- What clips hold


def test_motion_counts_known_pixels():
    """Of eight pixels one is unknown, two rest; the others move by 0.5, 1, 5, 7 and 30 px."""
    flow = np.zeros((2, 2, 4))
    flow[0] = [[np.nan, 0, 0.01, 0.5], [1, 3, 7, 30]]
    flow[1, 1, 1] = 4
    found = shard_contents.motion([flow, flow])
    assert (found["known"], sum(found["counts"]), found["summed"]) == (14, 10, 2 * 43.5)
    assert shard_page.below_within_above(found["counts"]) == pytest.approx((0.2, 0.4, 0.4))
    assert shard_page.below_within_above([0] * len(found["counts"])) == (0, 0, 0)


def test_contrast_of_stripes():
    """Half of the pixels is at 1, half at 3: the mean is 2."""
    found = shard_contents.contrast(np.tile(np.float32([1, 3]), (2, 8, 4)))
    assert found == {"rms": pytest.approx(0.5), "low": pytest.approx(0.5), "high": pytest.approx(1.5)}


def test_the_slope_of_white_noise_is_zero_and_its_power_its_variance():
    """24 independent slopes state their own spread. The density is the variance: of noise of 0.1 over a mean of 1."""
    rng = np.random.default_rng(7)
    spectra = [shard_contents.spectrum(1 + 0.1 * rng.standard_normal((1, 128, 192))) for _ in range(24)]
    slopes = np.array([shard_contents.slope(power) for power in spectra])
    assert abs(slopes.mean()) < critical_z() * slopes.std(ddof=1) / np.sqrt(len(slopes))
    last = np.array([power[-1] for power in spectra])
    assert abs(last.mean() - 0.01) < critical_z() * last.std(ddof=1) / np.sqrt(len(last))


@pytest.mark.parametrize("exponent", [-1.0, -2.0, -3.0])
def test_the_slope_of_a_power_law_is_its_exponent(exponent):
    """Waves of random phases on the grid of the frame; the window mixes neighbours on it, which tilts by 1 %."""
    rng = np.random.default_rng(8)
    frequency = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.fftfreq(512))
    frequency[0, 0] = np.inf
    waves = np.fft.fft2(rng.standard_normal((6, 512, 512))) * frequency ** (exponent / 2)
    images = np.fft.ifft2(waves).real
    found = [shard_contents.slope(shard_contents.spectrum(100 + image[None] / image.std())) for image in images]
    spread = critical_z() * np.std(found, ddof=1) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(exponent, abs=spread - 0.015 * exponent)


def test_frames_without_structure_have_no_slope():
    assert shard_contents.slope(shard_contents.spectrum(np.ones((1, 16, 16)))) is None


# ---- Plans and the page


def test_a_plan_alone_makes_a_page_that_names_what_is_missing(place, capsys):
    assert run(place, "--alone", plan(place, capsys, "tiny")) == 0
    text = (place / "out" / "tiny.md").read_text()
    assert "| hours | 12 |" in text
    assert "The plan with frames that share samples is not measured yet." in text
    assert "The shard itself is not measured yet." in text
    assert "reached" not in text
    assert not (place / "out" / "tiny.png").exists()


def test_the_page_compares_planned_and_used(place, capsys):
    """Three clips of an hour and three of three, or a quarter; clips of 0.25 and 0.75 hours took 0.3 and 0.9."""
    shared = plan(place, capsys, "shared")
    assert run(place, "--alone", plan(place, capsys, "tiny"), "--reuse", shared) == 0
    assert "| hours of the recipe: with reuse over without | at most 0.33 | 0.25 | reached |" in (
        text := (place / "out" / "tiny.md").read_text()
    )
    assert "| drums | 3 | 9.00 | 8–12 | 0 | 2.25 | 8–12 | 0 |" in text
    shard = plan(place, capsys, "shared", "--shard", "1/3")
    assert run(place, "--shard-plan", shard, "--data", place / "data") == 0
    text = (place / "out" / "tiny.md").read_text()
    assert "| 0.25 | reached |" in text  # kept from the first run
    assert "| hours of the shard: used over planned | 0.7 to 1.3 | 1.20 | reached |" in text
    assert "| most memory of a worker | at most 2.5 GB | 3.15 GB | **not reached** |" in text
    assert "| together | hours | 1.000 | 1.000 | 1.200 | 1.20 |" in text
    assert "| drums_0000 | hours | 0.750 | 0.750 | 0.900 | 1.20 |" in text
    assert "| fan_0000 | wall hours | 0.125 | 0.125 | 0.200 | 1.60 |" in text
    assert "| together | 50.0 % | 2.00 | 0.0 % | 100.0 % | 0.0 % |" in text
    assert "| fan_0000 | 0.50 | 0.50 | 1.50 |" in text
    assert "| fan_0000 | 3 | 8 | 3 |" in text
    assert (place / "out" / "tiny.png").stat().st_size > 1000
    found = json.loads((place / "out" / "tiny.json").read_text())
    assert list(found["made"]["clips"]) == list(USED)
    assert text == shard_page.page(found, "tiny.png")


def test_the_stored_page_is_made_from_its_numbers():
    results = ROOT / "docs" / "results"
    found = json.loads((results / "i2.json").read_text())
    assert (results / "i2.md").read_text(encoding="utf-8") == shard_page.page(found, "i2.png"), (
        "run benchmarks/shard_cost.py"
    )


@pytest.mark.slow
def test_a_tiny_shard_is_planned_made_and_measured(tmp_path, capsys):
    """With the real renderer, whose log and flow the program reads."""
    text = RECIPE.replace("width = 24", "width = 24\npsnr = 20.0")
    (tmp_path / "tiny.toml").write_text(text)
    (tmp_path / "shared.toml").write_text(text.replace("reuse = false\n", ""))
    words = ["--alone", plan(tmp_path, capsys, "tiny"), "--reuse", plan(tmp_path, capsys, "shared")]
    words += ["--shard-plan", plan(tmp_path, capsys, "shared", "--shard", "1/3"), "--data", tmp_path / "data"]
    made = ["generate", str(tmp_path / "shared.toml"), "-o", str(tmp_path / "data"), "--shard", "1/3", "-q"]
    assert qsim(made) == 0
    assert run(tmp_path, *words) == 0
    clip = json.loads((tmp_path / "out" / "tiny.json").read_text())["made"]["clips"]["fan_0000"]
    assert clip["processor_hours"] > 0
    assert 0.1 < clip["memory"] < 4
    assert clip["samples"] >= 4
    assert clip["motion"]["known"] == 3 * 16 * 24
    assert sum(clip["motion"]["counts"]) > 0


# ---- Mistakes


def refused(place: Path, capsys, *words: object) -> str:
    """Return the one sentence of a mistake; nothing is written."""
    before = {path: path.read_bytes() for path in place.glob("out/*")}
    capsys.readouterr()
    assert run(place, *words) == 2
    found = capsys.readouterr()
    assert (found.out, found.err.count("\n")) == ("", 1)
    assert {path: path.read_bytes() for path in place.glob("out/*")} == before
    return found.err


def test_missing_or_unfinished_data_is_one_sentence(place, capsys):
    assert "no such data set" in refused(place, capsys, "--data", place / "none")
    assert "no such file" in refused(place, capsys, "--alone", place / "none.json")
    assert "1 of 2 clips are not made yet, the first is fan_0001" in refused(
        place, capsys, "--shard", "2/3", "--data", unfinished(place)
    )
    assert "shard 9/9 none of them" in refused(place, capsys, "--shard", "9/9")
    (place / "data" / "logs" / "fan_0000.log").write_text(" rendering on a\n rendering on a\n done on a")
    assert "not made in one run" in refused(place, capsys, "--data", place / "data")


def unfinished(place: Path) -> Path:
    """A data set whose second shard has one of two clips."""
    wanted = recipe.parse(RECIPE)
    generate(wanted, place / "part", Options(workers=0, shard=(5, 6)), make=make)
    return place / "part"


def test_files_of_another_recipe_are_refused(place, capsys):
    """A plan of a shard is none of the recipe; one with reuse is none without; a data set holds other settings."""
    tiny = plan(place, capsys, "tiny")
    shared = plan(place, capsys, "shared")
    shard = plan(place, capsys, "tiny", "--shard", "1/3")
    for option, path in (("--alone", shared), ("--reuse", tiny), ("--alone", shard), ("--shard-plan", tiny)):
        assert f"{path}: is not the plan of " in refused(place, capsys, option, path)
    assert "planned for each frame alone, and made with frames that share samples" in refused(
        place, capsys, "--shard-plan", shard, "--data", place / "data"
    )
    found = json.loads(tiny.read_text())
    tiny.write_text(json.dumps({key: value for key, value in found.items() if key != "kinds"}))
    assert "lacks 'kinds'" in refused(place, capsys, "--alone", tiny)
    (place / "tiny.toml").write_text(RECIPE.replace("frames = 3", "frames = 4"))
    assert "was made from another recipe" in refused(place, capsys, "--data", place / "data")


def test_a_page_of_another_recipe_is_not_mixed_with_this_one(place, capsys):
    assert run(place, "--alone", plan(place, capsys, "tiny")) == 0
    (place / "tiny.toml").write_text(RECIPE.replace("frames = 3", "frames = 4"))
    assert "choose another --out" in refused(place, capsys)
