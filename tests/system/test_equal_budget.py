"""The programs of stored rows: rows are made once, busy cores are refused or marked, tables hold what rows hold."""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from quiver.model.presets import ABLATIONS, build, parameter_count

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))

sys.path.insert(0, str(ROOT / "benchmarks"))
import ablation_rows  # noqa: E402
import equal_budget  # noqa: E402
import equal_steps  # noqa: E402
import rows  # noqa: E402
import stream_rows  # noqa: E402
from step_rows import Steps, together  # noqa: E402


def run(*words: object, program: str = "equal_budget") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks" / f"{program}.py"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


@pytest.mark.parametrize(
    ("program", "known"),
    [
        (equal_budget, ("classical", "unet")),
        (equal_steps, ("classical", "unet")),
        (ablation_rows, ("none", "denoiser+flow")),
    ],
    ids=str,
)
def test_an_unknown_row_is_one_sentence(program, known, capsys):
    length = ["--steps", "2"] if program is equal_steps else []
    assert program.main(["data", "--rows", "emdv", "--tiny", *length]) == 2
    found = capsys.readouterr()
    assert (found.out, found.err.count("\n")) == ("", 1)
    told = found.err.removeprefix(f"{program.__name__}: no row is called 'emdv'; known are ").strip().split(", ")
    assert {*known} <= {*told}


@pytest.mark.parametrize(
    ("program", "words"),
    [(equal_budget, ["unet"]), (equal_steps, ["unet", "--steps", "2"]), (ablation_rows, ["all"])],
    ids=str,
)
def test_a_missing_data_set_is_one_sentence(program, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(["none", "--tiny", "--out", "r", "--rows", *words]) == 2
    assert capsys.readouterr().err == f"{program.__name__}: none: no such data set\n"
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    (tmp_path / "r").mkdir(exist_ok=True)
    length = 2 if program is equal_steps else None
    budget = Steps(crop=rows.TINY.crop, batch=rows.TINY.batch, steps=2) if length else rows.TINY
    row = {"budget": asdict(budget), "data": "none", "recipe_sha256": "0"}  # it was taken for one of another data set
    (tmp_path / "r/unet.json").write_text(json.dumps(row))
    assert program.main(["none", "--tiny", "--out", "r", "--rows", *words]) == 2
    assert capsys.readouterr().err == f"{program.__name__}: none: no such data set\n"


def test_a_trial_that_diverges_is_the_worst(tmp_path, monkeypatch):
    """Other failures leave the row without a trial: a program that ran out of memory has not diverged."""
    for code, known in ((3, True), (1, False), (130, False), (2, False)):

        def fail(*words, code=code, **options):
            raise subprocess.CalledProcessError(code, ["python", "-m", "quiver"])

        monkeypatch.setattr(equal_budget, "quiver", fail)
        if known:
            assert equal_budget.trial("emvd", "1e-3", tmp_path, tmp_path, rows.TINY) == {"psnr": None, "curve": []}
            continue
        with pytest.raises(subprocess.CalledProcessError):
            equal_budget.trial("emvd", "1e-3", tmp_path, tmp_path, rows.TINY)


def test_a_rate_whose_trial_diverged_is_not_chosen():
    assert rows.best_rate({"1e-3": {"psnr": None}, "3e-4": {"psnr": -2.0}}) == "3e-4"
    assert rows.best_rate({"1e-3": {"psnr": 0.0}, "3e-4": {"psnr": -2.0}}) == "1e-3"


def test_a_published_width_is_scored_only_above_the_floor(tmp_path, monkeypatch):
    asked = []

    def found(methods, folder, data, lights, budget, split="test"):
        asked.append((methods, lights, split))
        return {"moment:3": {"3.25 PPP, 3 bit": {"scores": {"psnr_matched": {"mean": 16.0}}}}}

    monkeypatch.setattr(equal_budget, "scores", found)
    args = argparse.Namespace(work=tmp_path, data=tmp_path)
    assert equal_budget.lights_of("emvd", args, rows.TINY, None) == ()
    lights = [equal_budget.lights_of("emvd", args, rows.TINY, psnr) for psnr in (15.9, 16.1)]
    assert lights == [(), ("3.25",)]
    assert asked == 3 * [(["moment:3"], ("3.25",), "val")]
    assert equal_budget.lights_of("emvd-1m", args, rows.TINY, -1.0) == rows.LIGHTS


def test_streams_need_validation_and_test_clips(tmp_path):
    from clips import write_dataset

    data = write_dataset(tmp_path / "data", {"train": 1, "test": 1})
    assert len(stream_rows.clips_of(data, "test")) == 1
    with pytest.raises(ValueError, match="no clip in the split val"):
        stream_rows.clips_of(data, "val")


def test_streams_are_learned_and_restored_without_a_gpu(tmp_path, monkeypatch):
    """As the rows beside them."""
    from clips import write_clip

    asked = {}
    devices = []
    monkeypatch.setattr(stream_rows, "quiver", lambda *words, budget: asked.update(pairwise(words)))
    monkeypatch.setattr(stream_rows, "restorer", lambda name, options: devices.append(options.device))
    monkeypatch.setattr(stream_rows, "restore_clip", lambda *words: None)
    clip = write_clip(tmp_path / "clip", frames=16)
    stream_rows.learned("bit2bit-1m", "1e-3", 0.1, clip, argparse.Namespace(work=tmp_path / "work"), rows.TINY)
    stream_rows.restored(tmp_path, clip, tmp_path)
    assert (asked["--device"], asked["--minutes"], devices) == ("cpu", 0.1, ["cpu"])


def test_rows_of_another_data_set_share_no_page(tmp_path, monkeypatch, capsys):
    """Whether they are asked for or not: all in the folder are ranked."""
    out = tmp_path / "rows"
    out.mkdir()
    rows.write_json(out / "classical.json", {"budget": asdict(rows.TINY), "data": "a", "recipe_sha256": None})
    monkeypatch.setattr(equal_budget, "made", lambda *words: pytest.fail("made"))
    assert equal_budget.main([str(tmp_path / "b"), "--rows", "unet", "--tiny", "--out", str(out)]) == 2
    assert "classical.json: was made with data a; now it is b" in capsys.readouterr().err


# ---- Busy cores


def clock(monkeypatch, busy: float) -> None:
    """A machine on which other programs use so many cores, and this one a half."""
    now = {"s": 0.0}

    def later(seconds: float) -> None:
        now["s"] += seconds

    monkeypatch.setattr(rows.time, "sleep", later)
    monkeypatch.setattr(rows.time, "monotonic", lambda: now["s"])
    monkeypatch.setattr(rows.os, "times", lambda: (0.25 * now["s"], 0.0, 0.25 * now["s"], 0.0, now["s"]))
    monkeypatch.setattr(rows, "everybodys_seconds", lambda: 100 + (busy + 0.5) * now["s"])
    monkeypatch.setattr(rows, "reference_convolution", lambda threads: 3.0)


def made(path: Path, seconds: float, *, busy: bool) -> dict[str, object]:
    """A row that takes so long, made by the program's own function."""
    work = {"busy": busy, "sessions": path.parent / "work" / "x_sessions.json"}
    data = path.parent / "a/data"
    data.mkdir(parents=True, exist_ok=True)
    rows.make_row(path, rows.TINY, data, lambda: rows.time.sleep(seconds) or {"name": "x"}, **work)
    return json.loads(path.read_text())


def test_quiet_cores_make_a_row_once(tmp_path, monkeypatch, capsys):
    clock(monkeypatch, 0.04)
    path = tmp_path / "x.json"
    found = made(path, 60.0, busy=False)
    assert found["quiet"] is True
    assert found["cores_of_others"] == pytest.approx(0.04)
    assert found["reference_convolution_ms"] == [3.0, 3.0]
    once = {"busy": False, "sessions": tmp_path / "work" / "x_sessions.json"}
    rows.make_row(path, rows.TINY, Path("b/data"), lambda: pytest.fail("made twice"), **once)
    with pytest.raises(ValueError, match="was made with data data; now it is other"):
        rows.make_row(path, rows.TINY, Path("other"), dict, **once)
    with pytest.raises(ValueError, match="was made with budget"):
        rows.make_row(path, rows.Budget(), Path("data"), dict, **once)
    (tmp_path / "data").mkdir()
    (tmp_path / "data/dataset.json").write_text('{"recipe": {"frames": 24}, "complete": true}')
    with pytest.raises(ValueError, match="was made with recipe_sha256 None; now it is "):
        rows.make_row(path, rows.TINY, tmp_path / "data", dict, **once)
    assert capsys.readouterr().out == f"{path}: written\n"
    assert rows.notes_on([found])[0].startswith("Machine: ")


def test_busy_cores_are_refused_or_marked(tmp_path, monkeypatch, capsys):
    clock(monkeypatch, 1.3)
    path = tmp_path / "x.json"
    with pytest.raises(ValueError, match=r"^other programs use 1\.3 cores, and a row needs quiet ones.*--busy"):
        made(path, 60.0, busy=False)
    assert not path.exists()
    found = made(path, 60.0, busy=True)
    assert found["quiet"] is False
    assert "marked: other programs used 1.3 cores" in capsys.readouterr().out
    assert rows.notes_on([found])[0] == r"\* made beside other programs: x."


def test_a_row_waits_for_quiet_cores(tmp_path, monkeypatch, capsys):
    """Others use 1.3 cores for a minute: less than a row waits."""
    clock(monkeypatch, 1.3)
    busy = rows.everybodys_seconds
    monkeypatch.setattr(rows, "everybodys_seconds", lambda: busy() - 1.3 * max(0.0, rows.time.monotonic() - 60))
    assert made(tmp_path / "x.json", 600.0, busy=False)["quiet"] is True
    assert rows.time.monotonic() < 60 + 2 * rows.WATCH + 600
    assert capsys.readouterr().out.count("waiting up to 300 s for quiet ones") == 1


@pytest.mark.parametrize("code", [0, 1, 2, 3])
def test_a_command_that_finished_with_problems_is_no_failure_where_they_are_kept(monkeypatch, code):
    monkeypatch.setattr(rows.subprocess, "run", lambda line, check: subprocess.CompletedProcess(line, code))
    if code < 2:
        rows.quiver("bench", budget=rows.TINY, problems=True)
    else:
        with pytest.raises(subprocess.CalledProcessError):
            rows.quiver("bench", budget=rows.TINY, problems=True)
    if code:
        with pytest.raises(subprocess.CalledProcessError):
            rows.quiver("train", budget=rows.TINY)


def test_a_resumed_row_is_as_quiet_as_its_loudest_session(tmp_path, monkeypatch):
    """One session fails beside other programs, one is killed: its load is not known."""
    clock(monkeypatch, 1.3)
    sessions = tmp_path / "work" / "x_sessions.json"

    def stop() -> dict[str, object]:
        rows.time.sleep(60)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rows.make_row(tmp_path / "x.json", rows.TINY, tmp_path, stop, busy=True, sessions=sessions)
    clock(monkeypatch, 0.02)
    found = made(tmp_path / "x.json", 60.0, busy=False)
    assert found["cores_of_others"] == pytest.approx(1.3)
    assert found["quiet"] is False
    (tmp_path / "x.json").unlink()
    sessions.write_text('{"cores_of_others": [0.0, null]}')
    found = made(tmp_path / "x.json", 60.0, busy=False)
    assert (found["cores_of_others"], found["quiet"]) == (None, False)


def test_a_row_that_fails_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    done = []

    def make(path, *words, **options):
        done.append(path.stem)
        if path.stem == "emvd":
            raise subprocess.CalledProcessError(-9, ["python", "-m", "quiver", "train"])

    monkeypatch.setattr(equal_budget, "make_row", make)
    monkeypatch.setattr(equal_budget, "write_tables", lambda out: None)
    words = [str(tmp_path), "--tiny", "--out", str(tmp_path / "rows"), "--rows", "classical,emvd,unet"]
    assert equal_budget.main(words) == 1
    assert done == ["classical", "emvd", "unet"]
    assert capsys.readouterr().err == "equal_budget: emvd has no row: 'quiver train' failed with -9\n"


def test_a_system_that_states_no_times_marks_its_rows(tmp_path, monkeypatch, capsys):
    clock(monkeypatch, 0.0)
    monkeypatch.setattr(rows, "everybodys_seconds", lambda: None)
    found = made(tmp_path / "x.json", 60.0, busy=False)
    assert (found["cores_of_others"], found["quiet"]) == (None, False)
    assert "an unknown number of cores" in capsys.readouterr().out


def test_time_of_this_process_is_not_that_of_others():
    """Half a second of work here: counted as ours, and as part of everybody's."""
    watch = rows.Watch.now()
    while sum(rows.os.times()[:4]) < watch.ours + 0.5:
        sum(range(10_000))
    now = rows.Watch.now()
    assert now.ours - watch.ours > 0.49
    if watch.everybody is not None:
        assert now.everybody - watch.everybody > 0.4
        assert watch.others() >= 0


# ---- Ablation


@pytest.mark.slow
def test_the_six_networks_of_the_ablation_have_a_million_parameters():
    counts = {name: parameter_count(ablation_rows.variant(name)) for name in ABLATIONS}
    assert all(0.95e6 < count < 1.05e6 for count in counts.values())
    assert max(counts.values()) / min(counts.values()) < 1.02


@pytest.mark.slow
@pytest.mark.parametrize("length", [(), ("--steps", 2)], ids=["equal time", "equal steps"])
def test_rows_of_the_ablation_are_made_once_and_shown(tmp_path, length):
    from clips import write_dataset

    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 2})
    out = tmp_path / "rows"
    words = (data, "--tiny", "--out", out, "--work", tmp_path / "work", "--rows", "none", *length)
    first = run(*words, program="ablation_rows")
    assert first.returncode == 0, first.stderr
    assert sorted(path.name for path in out.iterdir()) == ["none-0.json", "none-1.json"]
    second = run(*words, program="ablation_rows")
    assert (second.returncode, second.stdout) == (0, ""), second.stderr
    table = out.with_suffix(".md").read_text()
    assert "| no | no | no | 981,390 |" in table
    assert table.count("±") == 2
    if length:
        assert "| 2, 2 |" in table
        assert "`python benchmarks/ablation_rows.py out/starter --steps 2`" in table
        other = run(*words[:-1], 3, program="ablation_rows")
        assert (other.returncode, other.stdout) == (2, "")
        assert "was made with budget" in other.stderr


# ---- Equal steps


def test_networks_of_equal_steps_are_those_that_learn_from_clips_at_published_width():
    assert {*equal_steps.NAMES} >= {"classical", "unet", "quiver", "rvrt"}
    assert not [name for name in equal_steps.NAMES if name.startswith("bit2bit") or name.endswith(("-1m", "published"))]


@pytest.mark.parametrize("program", [equal_steps, ablation_rows], ids=str)
def test_busy_cores_are_no_option_of_equal_steps(program, tmp_path, capsys):
    words = [str(tmp_path), "--steps", "2", "--tiny", "--busy", "--out", str(tmp_path / "r"), "--rows"]
    assert program.main([*words, "unet" if program is equal_steps else "none"]) == 2
    assert capsys.readouterr().err == (
        f"{program.__name__}: --busy: rows of equal steps are made on any cores and never marked; leave it out\n"
    )


def test_rvrt_gets_crops_that_it_does_not_fill(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(equal_budget, "quiver", lambda *words, budget: asked.update(pairwise(words)))
    full = rows.Budget()  # rvrt-1m fills nothing: its flow has two levels less
    for name, budget, crop in (("rvrt", full, 128), ("rvrt-1m", full, 80), ("unet", full, 80), ("rvrt", rows.TINY, 32)):
        equal_budget.train(name, "1e-4", tmp_path, tmp_path, budget)
        assert asked["--crop"] == crop


def test_a_trial_has_a_sixth_of_the_steps():
    words = {short: Steps(steps=600).length(trial=short) for short in (True, False)}
    assert words[True][-4:] == ("--steps", 100, "--validate-every", 100)
    assert words[False][-4:] == ("--steps", 600, "--validate-every", 120)
    assert Steps(steps=2).length(trial=True)[-4:] == ("--steps", 1, "--validate-every", 1)


@pytest.mark.slow
def test_rows_of_equal_steps_are_made_once_and_shown(tmp_path):
    from clips import write_dataset

    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 2})
    out = tmp_path / "rows"
    words = (data, "--tiny", "--out", out, "--work", tmp_path / "work", "--rows", "classical,unet", "--steps", 6)
    first = run(*words, program="equal_steps")
    assert first.returncode == 0, first.stderr
    row = json.loads((out / "unet.json").read_text())
    assert (row["steps"], row["budget"]["steps"], row["quiet"]) == (6, 6, True)
    trials = {float(rate): found for rate, found in row["trials"].items()}
    assert trials[row["rate"]]["psnr"] == max(found["psnr"] for found in trials.values())
    assert [found["curve"][-1]["step"] for found in trials.values()] == [1, 1]
    assert row["settings"]["precision"] == "float32"
    second = run(*words, program="equal_steps")
    assert (second.returncode, second.stdout) == (0, ""), second.stderr
    table = out.with_suffix(".md").read_text()
    score = row["scores"]["3.25 PPP, 3 bit"]["scores"]["psnr_matched"]
    assert rows.interval(score, 2) in next(line for line in table.split("\n") if "| unet |" in line)
    assert "`python benchmarks/equal_steps.py out/starter --steps 6`: steps of 2 windows" in table
    other = run(*words[:-1], 7, program="equal_steps")
    assert (other.returncode, other.stdout) == (2, "")
    assert "was made with budget" in other.stderr


def test_a_row_of_equal_steps_that_fails_does_not_stop_the_others(tmp_path, capsys):
    args = argparse.Namespace(out=tmp_path / "rows", data=tmp_path)
    makers = {"good": partial(dict, name="good"), "bad": partial(int, "x")}
    pages = []
    assert together("equal_steps", makers, args, Steps(steps=2), lambda: pages.append(1)) == 1
    assert [path.name for path in args.out.iterdir()] == ["good.json"]
    assert "equal_steps: bad: ValueError: invalid literal" in capsys.readouterr().err
    assert pages == [1]


@pytest.mark.slow
def test_rows_are_made_once_and_shown(tmp_path):
    from clips import write_dataset

    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 2})
    out = tmp_path / "rows"
    work = tmp_path / "work"
    common = [data, "--tiny", "--out", out, "--work", work]
    first = run(*common, "--rows", "classical,unet")
    assert first.returncode == 0, first.stderr
    row = json.loads((out / "unet.json").read_text())
    line = json.loads((work / "unet_floor" / "evaluation.json").read_text())["table"][0]
    floor = line["scores"]["psnr_matched"]["mean"]
    assert set(row["scores"]) == ({"3.25 PPP, 3 bit"} if row["curve"][-1]["psnr_matched"] > floor else set())
    assert row["rate"] in (3e-4, 1e-3)
    trials = {float(rate): found for rate, found in row["trials"].items()}
    assert trials[row["rate"]]["psnr"] == max(found["psnr"] for found in trials.values())
    assert trials[row["rate"]]["psnr"] == trials[row["rate"]]["curve"][-1]["psnr_matched"]
    assert row["settings"]["optimiser"] == "adam"
    assert (row["window"], row["look_ahead"]) == (11, 5)
    assert row["steps"] == row["curve"][-1]["step"] > 0
    assert row["parameters"] == 911_841
    assert row["macs_per_pixel"] == pytest.approx(127_400, rel=0.01)
    assert row["cost"]["restoring_macs_per_pixel"] > 1e5
    assert min(row["reference_convolution_ms"]) > 0
    written = (out / "unet.json").stat().st_mtime_ns
    second = run(*common, "--rows", "classical,unet,emvd,student-teacher-1m,bit2bit-1m")
    assert second.returncode == 0, second.stderr
    students = json.loads((out / "student-teacher-1m.json").read_text())
    assert set(students["scores"]) == {f"{ppp} PPP, 3 bit" for ppp in ("3.25", "1", "9.75", "26")}
    assert students["parameters"] == sum(weight.numel() for weight in build("student-teacher-1m").student.parameters())
    assert (out / "unet.json").stat().st_mtime_ns == written
    assert "--preset unet" not in second.stdout
    alone = json.loads((out / "bit2bit-1m.json").read_text())
    assert set(alone["scores"]) == {"3.25 PPP, 3 bit"}
    assert alone["scores"]["3.25 PPP, 3 bit"]["scores"]["psnr_matched"]["scenes"] == 2
    assert alone["steps"] >= 2  # one run for each test clip
    table = out.with_suffix(".md").read_text()
    record, widths = table.split("## Published widths")
    widths, streams = widths.split("## Learned from the test streams themselves")
    assert re.search(r"\| bit2bit-1m(\\\*)? \| 0\.999 M \|", streams)
    assert "| bit2bit" not in record + widths.partition("## ")[0] + streams.partition("## ")[2]
    assert re.search(r"\| unet(\\\*)? \| 0\.127 M \|", widths)
    assert re.search(r"\| emvd(\\\*)? \| 0\.0056\d? M \|", widths)
    assert re.search(r"\| (1|none) \| student-teacher-1m(\\\*)? \| 11, 5 \|", record)
    assert "|  | qbp-bm3d |" in record
    assert "(rows.png)" in table
    assert out.with_suffix(".png").stat().st_size > 1000
    other = run(*common, "--rows", "unet", "--budget-seconds", "9")
    assert (other.returncode, other.stderr.count("\n")) == (2, 1)
    assert "was made with" in other.stderr
