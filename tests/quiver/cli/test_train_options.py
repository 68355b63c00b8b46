"""Tests what training and measuring commands say of their options, of interrupts and of errors."""

from __future__ import annotations

import json
import math
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from clips import ClipMaker, write_dataset
from domains import weights
from safetensors.torch import load_file
from sensor_files import FILES, sensor_file

from qsim.files import Blocked, Damaged, sha256
from quiver import threads
from quiver.cli import train
from quiver.cli.program import main
from quiver.evaluation import domain_measurement
from quiver.evaluation.cost import checked_cases
from quiver.evaluation.metrics import Score
from quiver.model.weights import annotate
from quiver.training import ablation, loop, run_folder
from quiver.training.run_folder import alone_in

FAST = ("--steps", "2", "--crop", "16", "--batch", "1", "--preset", "unet", "--protocol", "control")


def told(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Return the one line of a refusal."""
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    assert (code, out, err.count("\n")) == (2, "", 1), err
    return err


def trained(data: Path, out: Path, *words: str) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    assert main(["train", str(data), "-o", str(out), *FAST, *words, "-q"]) == 0
    return load_file(out / "last.safetensors")


def test_a_run_knows_its_first_weights_by_what_decides_results(capsys, tiny_dataset, tmp_path):
    """Notes of the file may change."""
    trained(tiny_dataset, tmp_path / "a")
    first = tmp_path / "a/last.safetensors"
    words = ("--start", str(first))
    trained(tiny_dataset, tmp_path / "b", *words)
    annotate(first, {"step": "7"})
    trained(tiny_dataset, tmp_path / "b", *words)
    capsys.readouterr()
    other = ("--start", str(tmp_path / "b/last.safetensors"))
    assert "holds a run with start" in told(capsys, "train", tiny_dataset, "-o", tmp_path / "b", *FAST, *other, "-q")


@pytest.mark.parametrize("psnr", [math.inf, math.nan])
def test_a_run_without_a_finite_score_keeps_its_newest_weights(tiny_dataset, tmp_path, monkeypatch, capsys, psnr):
    score = Score(psnr, psnr, 1.0, 1.0, scale=1.0, scale_spread=0.0, frames=1)
    monkeypatch.setattr(loop, "validate", lambda *words: (score, torch.zeros(8, 24)))
    words = ["train", str(tiny_dataset), "-o", str(tmp_path / "r"), *FAST, "--threads", "1"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (found["best_psnr_matched"], found["last_validation"]["psnr"]) == (None, None)
    assert Path(found["weights"]).is_file()
    assert main(words) == 0
    assert "2 steps in 0.0 min, no validation has a finite PSNR: " in capsys.readouterr().out


def one_bit_file(folder: Path) -> str:
    """A sensor file of one bit."""
    return sensor_file(folder, f"[sensor]\n{FILES['SPAD']}bits = {{bits}}\n", 1)


@pytest.mark.parametrize(
    "words",
    [(), ("--preset", "unet", "--protocol", "spad-sum")],
    ids=["default", "spad-sum"],
)
def test_a_sensor_file_is_trained_with_its_bits(tiny_dataset, tmp_path, words):
    """Each of these protocols states bits, of other sensors."""
    asked = ["train", str(tiny_dataset), "-o", str(tmp_path / "r"), "--sensor", one_bit_file(tmp_path), "--ppp", "3"]
    asked += ["--steps", "1", "--crop", "16", "--batch", "1", *words, "-q"]
    assert main(asked) == 0
    (noise,) = json.loads((tmp_path / "r/settings.json").read_text())["noise"]
    assert (noise["record"]["bits"], noise["bits"]) == (1, 1)
    assert main(asked) == 0


def test_a_sensor_file_is_ablated_with_its_bits(tiny_dataset, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(ablation, "run_ablation", lambda settings, *_, **__: asked.append(settings.noise))
    words = ("--protocol", "spad-sum", "--sensor", one_bit_file(tmp_path), "--steps", "1", "-q")
    assert main(["ablate", str(tiny_dataset), "-o", str(tmp_path / "six"), *words]) == 130  # as after Ctrl-C
    assert [noise.bits for noise in asked[0]] == [1]


def test_an_ablation_has_clips_to_score_before_it_trains(capsys, make_clip: ClipMaker, tmp_path, monkeypatch):
    """A clip folder is in every split, so only `--split train` names what is scored there."""
    clip = make_clip().path
    data = write_dataset(tmp_path / "data", {"train": 1, "val": 1})
    out = tmp_path / "x"
    monkeypatch.setattr(ablation, "run_ablation", lambda *_, **__: None)
    capsys.readouterr()
    for source, message in (
        (clip, f"{clip}: is one clip, which trains; give a data set with clips in split test"),
        (data, f"--split test: {data} has no finished clip in that split"),
    ):
        assert message in told(capsys, "ablate", source, "-o", out, "--steps", 1, "-q")
    assert not out.exists()
    assert main(["ablate", str(clip), "-o", str(out), "--steps", "1", "--split", "train", "-q"]) == 130


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            Blocked("x holds another evaluation", "choose another folder, or start again with force=True"),
            "x holds another evaluation; choose another -o",
        ),
        (
            Damaged("x: not a state of this run (y)", "start again with force=True"),
            "x: not a state of this run (y); choose another -o",
        ),
        (
            loop.Diverged("loss nan"),
            "loss nan; choose another --protocol or --seed, and another -o",
        ),
    ],
)
def test_no_error_of_an_ablation_advises_force(capsys, tiny_dataset, tmp_path, monkeypatch, error, message):
    def fails(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(ablation, "run_ablation", fails)
    assert main(["ablate", str(tiny_dataset), "-o", str(tmp_path / "x"), "--steps", "1", "-q"]) in (2, 3)
    assert capsys.readouterr().err == f"quiver: {message}\n"


def test_a_damaged_ablation_is_refused_without_force(capsys, tiny_dataset, tmp_path):
    (tmp_path / "x/none").mkdir(parents=True)
    (tmp_path / "x/none/settings.json").write_text(json.dumps({"noise": []}))
    said = told(capsys, "ablate", tiny_dataset, "-o", tmp_path / "x", "--steps", 1, "-q")
    assert said.endswith("settings.json: noise is []; the file is damaged; choose another -o\n")


def test_force_keeps_a_run_where_the_sensor_tells_nothing(capsys, tiny_dataset, tmp_path):
    """The first window told it, when the run was gone."""
    words = ["train", tiny_dataset, "-o", tmp_path / "r", "--preset", "emvd", "--steps", 1, "--crop", 16, "--batch", 1]
    assert main([*map(str, words), "-q"]) == 0
    before = sha256(tmp_path / "r/best.safetensors")
    dark = sensor_file(tmp_path, f"[sensor]\n{FILES['QIS']}bits = {{bits}}\n".replace("= 100.0", "= 1e9"), bits=3)
    capsys.readouterr()
    assert "does not rise with light" in told(capsys, *words, "--sensor", dark, "--ppp", 3.25, "--force", "-q")
    assert sha256(tmp_path / "r/best.safetensors") == before


@pytest.mark.parametrize("words", [[], ["--force"]], ids=["again", "force"])
def test_an_interrupted_run_is_resumed_without_force(capsys, tiny_dataset, tmp_path, monkeypatch, words):
    """With --force the same command deletes what it should resume."""

    def interrupted(*_: object, should_stop: object, **__: object) -> loop.State:
        signal.raise_signal(signal.SIGINT)
        return loop.State()

    monkeypatch.setattr(loop, "train", interrupted)
    monkeypatch.setattr(run_folder, "draw_curve", lambda *_: None)
    monkeypatch.setattr(train, "_summary", lambda *_: ({}, ""))
    assert main(["train", str(tiny_dataset), "-o", str(tmp_path / "r"), "--steps", "1", "-q", *words]) == 130
    again = "the same command without --force" if words else "the same command"
    assert capsys.readouterr().err == f"quiver: interrupted; {again} resumes where it stopped\n"


@pytest.mark.parametrize(
    ("command", "then"),
    [
        ("evaluate", "the same command without --force resumes"),
        ("domain", "the same command with --force makes all of them again"),  # without it, known cells keep their value
    ],
)
def test_interrupted_measurements_state_what_continues(capsys, tiny_dataset, tmp_path, monkeypatch, command, then):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threads, "check", interrupted)
    (tmp_path / "o").mkdir()
    words = [weights(tmp_path), tiny_dataset] if command == "domain" else [tiny_dataset, "-o", tmp_path / "o"]
    assert main([command, *map(str, words), "--force"]) == 130
    assert then in capsys.readouterr().err


STOPS = {
    ("train", 3): "quiver: step 2: loss nan; lower the learning rate and start again with --force",
    ("ablate", 3): "quiver: step 2: loss nan; choose another --protocol or --seed, and another -o",
    ("ablate", 130): "quiver: interrupted; the same command resumes where it stopped",
}


@pytest.mark.parametrize(("command", "code"), list(STOPS))
def test_a_run_that_fails_is_told_in_json(capsys, tiny_dataset, tmp_path, monkeypatch, command, code):
    def ends(*_: object, **__: object) -> None:
        if code == 3:
            raise loop.Diverged("step 2: loss nan")

    monkeypatch.setattr(loop, "train", ends)
    monkeypatch.setattr(ablation, "run_ablation", ends)
    assert main([command, str(tiny_dataset), "-o", str(tmp_path / "r"), "--steps", "1", "--json", "-q"]) == code
    out, err = capsys.readouterr()
    assert json.loads(out) == {"error": STOPS[command, code], "exit_code": code}
    assert err == f"{STOPS[command, code]}\n"


@pytest.mark.parametrize("command", ["train", "ablate"])
def test_exhausted_memory_is_one_sentence(capsys, tiny_dataset, tmp_path, monkeypatch, command):
    def exhausted(*given: object, **named: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(loop, "train", exhausted)
    monkeypatch.setattr(ablation, "run_ablation", exhausted)
    words = [command, str(tiny_dataset), "-o", str(tmp_path / "r"), "--steps", "1", "-q"]
    assert main([*words, *(["--preset", "unet"] if command == "train" else [])]) == 2
    told = capsys.readouterr().err
    assert told.splitlines()[-1].endswith("memory is exhausted (CUDA out of memory); give a smaller --batch")


def test_a_sensor_file_is_measured_with_its_bits(capsys, make_clip: ClipMaker, tmp_path, monkeypatch):
    """Its cell is found again, so that the same command measures nothing."""
    words = ["domain", weights(tmp_path), make_clip().path, "--sensor", f"{one_bit_file(tmp_path)},quiver-physical"]
    words += ["--ppp", "1", "--methods", "naive", "--device", "cpu", "--json"]
    assert main([str(word) for word in words]) == 0
    found = capsys.readouterr().out
    assert sorted(cell["place"]["bits"] for cell in json.loads(found)["domain"]["cells"]) == [1, 3]
    monkeypatch.setattr(domain_measurement, "measure_cell", None)
    assert main([str(word) for word in words]) == 0
    assert capsys.readouterr().out == found


@pytest.mark.parametrize(
    ("scores", "told"),
    [((20.0, 22.5, 22.0), "got worse: the last validation is 0.50 dB below the best"), ((20.0, 22.5, 22.5), None)],
)
def test_a_curve_that_falls_is_told(capsys, tiny_dataset, tmp_path, monkeypatch, scores, told):
    found = iter(scores)
    validate = loop.validate

    def scripted(*args: object) -> tuple[Score, torch.Tensor]:
        score, picture = validate(*args)
        return replace(score, psnr_matched=next(found)), picture

    monkeypatch.setattr(loop, "validate", scripted)
    trained(tiny_dataset, tmp_path / "r", "--steps", "3", "--validate-every", "1")
    said = capsys.readouterr().out
    assert "best validation PSNR 22.50 dB" in said
    assert told in said if told else "worse" not in said


@pytest.mark.parametrize(
    ("methods", "more", "message"),
    [
        (("moment",), {"modes": ("exact",)}, "modes=: acts on networks, and moment is classical"),
        (("moment", "naive"), {"precisions": ("float32",)}, "precisions=: acts on networks, and moment, naive"),
        (("moment",), {"device": "cuda"}, "device=cuda: torch finds no CUDA device here"),
        (("unet",), {"modes": ("exact",)}, "modes=: acts on QUIVER, unet has one mode"),
        (("quiver-s",), {"modes": ("exat",)}, "modes=: no 'exat' (did you mean 'exact'?)"),
        (("quiver-s",), {"precisions": ("float16",)}, "precisions=: no 'float16' (did you mean 'bfloat16'?)"),
        (("momnt",), {}, "no method 'momnt'"),
        (("moment:x",), {}, "the window after the colon is a number of frames"),
        (("none.safetensors",), {}, "none.safetensors: no such weights file"),
    ],
)
def test_bench_refuses_before_it_measures(methods, more, message):
    asked = {"modes": None, "precisions": None, "device": None} | more
    with pytest.raises(ValueError if "safetensors" not in methods[0] else FileNotFoundError) as error:
        checked_cases(methods, **asked)
    assert message in str(error.value)


def test_bench_replaces_only_with_a_folder(capsys, tmp_path):
    assert "--force: replaces a result in -o FOLDER" in told(capsys, "bench", "--methods", "naive", "--force")
    (tmp_path / "b").mkdir()
    (tmp_path / "b/bench.json").write_text(json.dumps({}))
    said = told(capsys, "bench", "--methods", "naive", "-o", tmp_path / "b")
    assert "exists; name another, or replace it with --force" in said


def test_one_ablation_and_one_measurement_at_a_time(capsys, tiny_dataset, tmp_path):
    (tmp_path / "a").mkdir()
    with alone_in(tmp_path / "a", "works"):
        words = ("ablate", tiny_dataset, "-o", tmp_path / "a", "--steps", 1, "--crop", 16, "--batch", 1, "-q")
        assert f"{tmp_path / 'a'}: another process works here; wait" in told(capsys, *words)
        words = ("bench", "--methods", "naive", "--size", "16x16", "-o", tmp_path / "a", "-q")
        assert f"{tmp_path / 'a'}: another process measures here; wait" in told(capsys, *words)
        assert [path.name for path in (tmp_path / "a").iterdir()] == ["lock"]
    assert list((tmp_path / "a").iterdir()) == []
