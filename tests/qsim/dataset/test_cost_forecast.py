"""Forecasts: the arithmetic, and a forecast against a real run."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from qsim.cli.program import main
from qsim.dataset import cost_forecast, job_runner, recipe
from qsim.dataset.cost_forecast import START, Cost, Forecast, Seconds
from qsim.dataset.worker_pool import Limits
from qsim.rendering.budget import Budget

RECIPE = """[recipe]
name = "tiny"
frames = 12
height = 32
width = 48
frame_rate = 2000.0
psnr = 30.0

[[scenes]]
family = "fan"
seeds = [0, 1, 2]

[[streams]]
sensor = "quiver-physical"
bits = 3
ppp = 3.25
"""


def test_the_arithmetic_of_a_forecast():
    """10 clips of 30 frames: 10 * 6 s + 300 * (1.5 + 0.3) s = 600 s, and an eighth of a process start per clip."""
    seconds = {"setup": Seconds(6.0, 11.0), "per_frame": Seconds(1.5, 2.9), "sensing": Seconds(0.3, 0.4)}
    cost = Cost("fan", (512, 1024), 10, 300, samples=(8, 72), **seconds, frame_bytes=4e6)
    assert cost.hours == pytest.approx(600 / 3600)
    assert cost.seconds.processor == pytest.approx(10 * 11 + 300 * (2.9 + 0.4))
    assert cost.gigabytes == pytest.approx(1.2)
    whole = Forecast((cost, cost), "llvm", 0.5)
    assert whole.hours == pytest.approx((1200 + 20 * START / Limits().jobs) / 3600)
    assert whole.processor_hours == pytest.approx((2 * 1100 + 20 * START / Limits().jobs) / 3600)
    assert whole.gigabytes == pytest.approx(2.4)
    assert f"10 machines like this: {whole.hours / 10:.3g} hours each" in "\n".join(whole.lines(10))
    assert whole.lines(1)[-1].startswith("within a day: 1 machine like this; run this command on a machine with a GPU")
    days = Forecast((cost,) * 200, "cuda", 0.5)  # a little over 33 hours
    times = f"{days.hours / 24:.2g} times as fast"
    assert days.lines(1)[-1] == f"within a day: 2 machines like this, or one that is {times}"
    assert " 8-72 " in whole.lines(1)[1]
    kind = whole.to_dict()["kinds"][0]
    assert (kind["frames"], kind["per_frame_seconds"]) == (300, {"wall": 1.5, "processor": 2.9})


def test_frames_that_share_samples_are_timed_where_each_traces_one():
    """Scene 5 s, paths 2 s, picture 0.5 s. With three neighbours the first frame traces four, the last three none."""
    traced = [min(t + 4, 9) for t in range(9)]
    moments = [Seconds(5 + 2 * n + 0.5 * t, 0.0) for t, n in enumerate(traced, 1)]
    setup, frame = cost_forecast.setup_and_frame(moments, 3)
    assert frame.wall == pytest.approx(2.5)
    assert setup.wall == pytest.approx(5.0)
    setup, frame = cost_forecast.setup_and_frame(moments[:5], 3)
    assert setup.wall + 5 * frame.wall == pytest.approx(moments[4].wall)
    assert cost_forecast.setup_and_frame([Seconds(4.0, 3.0)], 0) == ((0.0, 0.0), (4.0, 3.0))
    codes = [Seconds(*(end,) * 2) for end in (9.0, 9.5, 10.0, 14.0, 14.5, 15.0, 19.0)]
    setup, frame = cost_forecast.setup_and_frame(codes, 0, 3)  # 5 s per code of three planes
    assert frame == pytest.approx((5 / 3, 5 / 3))
    assert setup == pytest.approx((5.0, 5.0))


def test_a_few_jobs_are_looked_at_from_first_to_last():
    wanted = recipe.parse(RECIPE.replace("[0, 1, 2]", str(list(range(42)))))
    seeds = [job.scene_seed for job in cost_forecast.evenly_spaced(list(wanted.jobs))]
    assert seeds == [0, 10, 20, 31, 41]
    assert len(cost_forecast.evenly_spaced(list(wanted.jobs)[:3])) == 3
    assert cost_forecast.evenly_spaced(list(wanted.jobs)[:1]) == list(wanted.jobs)[:1]


def test_a_frame_costs_what_its_samples_cost(monkeypatch: pytest.MonkeyPatch):
    """Three budgets of 10, 20 and 90 samples: a frame costs twice as much as one of the middle job, which is timed."""
    wanted = recipe.parse(RECIPE)
    samples = {0: 10, 1: 20, 2: 90}
    monkeypatch.setattr(job_runner, "load_scene", lambda job: job)
    monkeypatch.setattr(job_runner, "choose_budget", lambda job, scene: Budget(samples[job.scene_seed]))
    monkeypatch.setattr(Seconds, "now", staticmethod(lambda: Seconds(0.0, 0.0)))
    timed = []

    def first_frames(job, budget, path, frames):
        assert budget.samples == samples[job.scene_seed]
        timed.append(job.scene_seed)
        return FakeClip(), [Seconds(2.0 + 3 * n, 1.0 + n) for n in range(frames)]

    monkeypatch.setattr(cost_forecast, "render_first_frames", first_frames)
    monkeypatch.setattr(cost_forecast, "sense_streams", lambda job, clip: (Seconds(0.0, 0.0), 0.0))
    cost = cost_forecast.measure_kind(list(wanted.jobs), Path(), 4)
    assert timed[-1] == 1
    assert cost.samples == (10, 90)
    assert cost.per_frame == pytest.approx(Seconds(6.0, 2.0))
    assert cost.setup == Seconds(0.0, 0.0)


def test_a_clip_costs_the_choice_of_its_budget_as_well(monkeypatch: pytest.MonkeyPatch):
    """The first choice in a process takes ten times as long; the median of the three counts."""
    clock = [0.0]
    monkeypatch.setattr(Seconds, "now", staticmethod(lambda: Seconds(clock[0], 2 * clock[0])))
    monkeypatch.setattr(job_runner, "load_scene", lambda job: job)
    took = {0: 50.0, 1: 5.0, 2: 4.0}

    def choose(job, scene):
        clock[0] += took[job.scene_seed]
        return Budget(8)

    def first_frames(job, budget, path, frames):
        return FakeClip(), [Seconds(clock[0] + 3 + 2 * n, 2 * clock[0] + 6 + 4 * n) for n in range(frames)]

    monkeypatch.setattr(job_runner, "choose_budget", choose)
    monkeypatch.setattr(cost_forecast, "render_first_frames", first_frames)
    monkeypatch.setattr(cost_forecast, "sense_streams", lambda job, clip: (Seconds(0.0, 0.0), 0.0))
    cost = cost_forecast.measure_kind(list(recipe.parse(RECIPE).jobs), Path(), 4)
    assert cost.setup == Seconds(5 + 3 - 2, 2 * (5 + 3 - 2))


@pytest.mark.parametrize(
    ("stream", "frames"),
    [
        ("", 3),
        ("slices = 7", 7),
        ("slices = 7\nrow_delay = 1e-5", 8),
        ('sensor = "spad512s"\nbits = 3\ngroup = true\nrow_delay = 1e-5', 8),
    ],
)
def test_streams_of_long_codes_are_measured_with_the_frames_of_a_code(monkeypatch, stream, frames):
    """A plan of the recipes `rolling` and `readouts` failed: its five frames were too few for one code."""
    asked = []
    monkeypatch.setattr(job_runner, "load_scene", lambda job: job)
    monkeypatch.setattr(job_runner, "choose_budget", lambda job, scene: Budget(8))

    def first_frames(job, budget, path, frames):
        asked.append(frames)
        return FakeClip(), [Seconds(1.0, 1.0)] * frames

    monkeypatch.setattr(cost_forecast, "render_first_frames", first_frames)
    monkeypatch.setattr(cost_forecast, "sense_streams", lambda job, clip: (Seconds(0.0, 0.0), 0.0))
    sensor = "" if "sensor" in stream else 'sensor = "quiver-physical"\nbits = 3\n'
    text = RECIPE[: RECIPE.index("[[streams]]")] + f"[[streams]]\n{sensor}ppp = 3.25\n{stream}\n"
    cost_forecast.measure_kind(list(recipe.parse(text).jobs), Path(), 3)
    assert asked == [frames]


class FakeClip:
    """A clip of one frame that is not stored."""

    path = Path("/nowhere")

    def __len__(self) -> int:
        return 1


def test_plans_without_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "r.toml"
    path.write_text(RECIPE)
    for options, message in [(["--machines", "0"], "--machines: expected"), (["--frames", "1"], "at least 2 frames")]:
        assert main(["plan", str(path), *options]) == 2
        assert message in capsys.readouterr().err


def test_a_plan_of_a_shard_is_that_of_its_clips(tmp_path, capsys, monkeypatch):
    """Of three clips the second of two shards has one; the digest tells whose plan it is."""
    monkeypatch.setattr(cost_forecast, "measure_kind", lambda jobs, folder, frames: cost_of(len(jobs)))
    path = tmp_path / "r.toml"
    path.write_text(RECIPE)
    found = {}
    for shard in ([], ["--shard", "1/2"], ["--shard", "2/2"]):
        assert main(["plan", str(path), *shard, "--json"]) == 0
        found[tuple(shard[1:])] = json.loads(capsys.readouterr().out)
    assert [plan["kinds"][0]["clips"] for plan in found.values()] == [3, 2, 1]
    assert found[()]["digest"] == recipe.parse(RECIPE).digest
    assert len({plan["digest"] for plan in found.values()}) == 3
    assert main(["plan", str(path), "--shard", "3/2"]) == 2


def cost_of(clips: int) -> Cost:
    """Return the cost of clips of twelve frames that take no time."""
    nothing = {name: Seconds(0.0, 0.0) for name in ("setup", "per_frame", "sensing")}
    return Cost("fan", (32, 48), clips, 12 * clips, samples=(8, 8), **nothing, frame_bytes=0.0)


def alone(home: Path, *words: str | Path) -> str:
    """Return what a command prints in a process with a new home, in which Dr.Jit keeps compiled kernels."""
    home.mkdir()
    places = {"HOME": str(home), "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))}
    command = [sys.executable, "-m", "qsim", *map(str, words)]
    return subprocess.run(command, env=os.environ | places, check=True, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_a_forecast_against_a_real_run(tmp_path: Path):
    """Both sides in processor time, on which other work on the machine has little effect; the promise is 30 %.

    Each side meets the scenes for the first time: a run that finds the kernels of its forecast takes less.
    """
    (tmp_path / "r.toml").write_text(RECIPE)
    forecast = json.loads(alone(tmp_path / "1", "plan", tmp_path / "r.toml", "--json"))
    alone(tmp_path / "2", "generate", tmp_path / "r.toml", "-o", tmp_path / "d", "--workers", "1")
    logs = "".join(log.read_text() for log in (tmp_path / "d" / "logs").glob("*.log"))
    seconds = sum(map(float, re.findall(r"processor ([\d.]+) s", logs)))
    kind = forecast["kinds"][0]
    each = [kind[f"{name}_seconds"]["processor"] for name in ("setup", "per_frame", "sensing")]
    predicted = kind["clips"] * each[0] + kind["frames"] * (each[1] + each[2])
    print(f"predicted {predicted:.1f} s, took {seconds:.1f} s of processor time")
    assert 0.7 < seconds / predicted < 1.3
    kept = [file for file in (tmp_path / "d" / "clips").rglob("*") if file.suffix in (".exr", ".npy")]
    stored = sum(file.stat().st_size for file in kept)
    assert stored == pytest.approx(forecast["gigabytes"] * 1e9, rel=0.3)
