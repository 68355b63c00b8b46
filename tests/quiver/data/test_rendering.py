"""Training while clips are rendered: the order of the clips, resumed runs, and what is refused."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import fakes
import pytest
import torch
from safetensors.torch import load_file

from qsim.dataset import recipe
from qsim.dataset.generation import Options, generate
from quiver.cli.program import main
from quiver.data import rendering
from quiver.data.rendering import mixed
from quiver.device import environment_beside_training
from quiver.training import loop

TEXT = """[recipe]
name = "small"
frames = 12
height = 20
width = 24

[[scenes]]
family = "fan"
seeds = [0, 1, 2, 3]

[[scenes]]
family = "plain"
seeds = [8, 9]
split = "val"

[[scenes]]
family = "shadow"
seeds = [3]
split = "test"

[[scenes]]
family = "tumble"
seeds = [4, 5]
"""
FAST = ("--preset", "unet", "--protocol", "control", "--crop", "16", "--batch", "2", "--validate-every", "6")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clips of noise in a moment instead of rendered ones, by the same process otherwise."""
    renders_by(monkeypatch, "make")


def renders_by(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    script = str(Path(fakes.__file__).with_name("quick_renderer.py"))
    monkeypatch.setattr(rendering, "RENDERER", (sys.executable, script, name))
    monkeypatch.setattr(rendering, "PAUSE", 0.02)
    monkeypatch.setenv("PYTHONPATH", fakes.SUPPORT)


def train(source: Path | str, out: Path, *words: object) -> int:
    torch.manual_seed(0)
    return main(["train", str(source), "-o", str(out), *FAST, *map(str, words)])


def test_the_order_begins_with_what_training_waits_for():
    jobs = recipe.parse(TEXT).jobs
    names = [job.name for job in mixed(jobs, "val")]
    assert sorted(names) == sorted(jobs.names())
    assert [name.split("_")[0] for name in names[:5]] == ["fan", "plain", "plain", "shadow", "tumble"]
    assert [job.name for job in mixed(jobs, "test")][1].startswith("shadow")


def test_a_killed_run_ends_as_one_that_was_not(source, tmp_path, monkeypatch):
    """The schedule of the killed one is given to the other, as times of rendering differ from run to run."""
    stopped = iter([*[False] * 5, True])
    kept = loop.train
    with monkeypatch.context() as patched:
        patched.setattr(loop, "train", lambda *a, **k: kept(*a, **k | {"should_stop": lambda: next(stopped)}))
        train(source, tmp_path / "runs/one", "--steps", 14, "-q")
    assert json.loads((tmp_path / "runs/one/settings.json").read_text())["data"] == str(tmp_path / "runs/small")
    assert train(source, tmp_path / "runs/one", "--steps", 14, "-q") == 0
    schedule = json.loads((tmp_path / "runs/one/schedule.json").read_text())
    assert schedule["samples"][0] == 0
    assert all(name.startswith(("fan", "tumble")) for name in schedule["clips"])
    with monkeypatch.context() as patched:
        begun = loop.Trainer.__init__

        def given(trainer, model, run, *rest):
            shutil.copy(tmp_path / "runs/one/schedule.json", run.folder)
            begun(trainer, model, run, *rest)

        patched.setattr(loop.Trainer, "__init__", given)
        assert train(source, tmp_path / "runs/two", "--steps", 14, "-q") == 0
    one, two = (load_file(tmp_path / "runs" / name / "last.safetensors") for name in ("one", "two"))
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize("length", [("--steps", 4), ("--steps", 8)])
def test_a_run_that_is_stopped_while_it_waits_for_clips_loses_no_step(source, tmp_path, monkeypatch, length):
    """Before a validation in the middle, and before the last one: the same command then does what is missing."""
    waits = iter([True])
    complete = rendering.Rendering.complete

    def interrupted(self):
        if next(waits, False):
            raise KeyboardInterrupt
        complete(self)

    monkeypatch.setattr(rendering.Rendering, "complete", interrupted)
    assert train(source, tmp_path / "run", *length, "-q") == 130
    kept = torch.load(tmp_path / "run/checkpoint.pt", weights_only=True)["state"]
    assert (kept["step"], kept["finished"]) == (min(6, length[1]), False)
    assert train(source, tmp_path / "run", *length, "-q") == 0
    history = json.loads((tmp_path / "run/history.json").read_text())["history"]
    assert [entry["step"] for entry in history][-1] == length[1]


def test_workers_draw_what_this_process_draws(source, tmp_path):
    """Of clips that are there already, so that both runs have one schedule."""
    found = []
    for name, count in (("none", 0), ("one", 1)):
        generate(recipe.parse(TEXT), tmp_path / name / "small", Options(workers=0), make=fakes.make)
        assert train(source, tmp_path / name / "run", "--steps", 4, "--workers", count, "-q") == 0
        found.append(load_file(tmp_path / name / "run/last.safetensors"))
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def test_clips_that_fail_are_left_out_and_told(source, tmp_path, monkeypatch, capfd):
    renders_by(monkeypatch, "fail_on_tumble")
    assert train(source, tmp_path / "run", "--steps", 6) == 0
    schedule = json.loads((tmp_path / "run/schedule.json").read_text())
    assert all(name.startswith("fan") for name in schedule["clips"])
    assert "is rendered into" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (('split = "val"', 'split = "train"'), "has no clips in split 'val'"),
        (("seeds = [8, 9]", "seeds = []"), "small.toml"),
    ],
)
def test_a_recipe_that_cannot_be_trained_on_is_one_sentence(source, tmp_path, capfd, change, named):
    source.write_text(TEXT.replace(*change))
    assert train(source, tmp_path / "run", "--steps", 2) == 2
    said = capfd.readouterr().err
    assert named in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_validation_clip_that_cannot_be_rendered_ends_the_run(source, tmp_path, monkeypatch, capfd):
    source.write_text(TEXT.replace('"plain"\nseeds = [8, 9]', '"tumble"\nseeds = [8, 9]'))
    renders_by(monkeypatch, "fail_on_tumble")
    assert train(source, tmp_path / "run", "--steps", 2, "-q") == 2
    last = capfd.readouterr().err.splitlines()[-1]
    assert "0 of 1 clips of split 'val' could be rendered" in last
    assert "small.toml says why" in last


def test_a_folder_of_another_recipe_is_not_trained_on(source, tmp_path, capfd):
    generate(recipe.parse(TEXT.replace("[4, 5]", "[6]")), tmp_path / "small", Options(workers=0), make=fakes.make)
    assert train(source, tmp_path / "run", "--steps", 2) == 2
    said = capfd.readouterr().err
    assert "is the data set of another recipe than" in said
    assert said.count("\n") == 1


def test_a_run_that_grew_is_not_resumed_on_the_finished_set(source, tmp_path, capfd):
    assert train(source, tmp_path / "run", "--steps", 2, "-q") == 0
    generate(recipe.parse(TEXT), tmp_path / "small", Options(workers=0), make=fakes.make)
    capfd.readouterr()
    assert train(tmp_path / "small", tmp_path / "run", "--steps", 2, "-q") == 2
    assert "holds a run on clips that were rendered 'meanwhile', now they are 'before'" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["other"], "give the recipe alone"),
        (["--preset", "bit2bit"], "bit2bit learns from one stored stream"),
    ],
)
def test_what_cannot_be_rendered_meanwhile_is_refused(source, tmp_path, capfd, words, named):
    assert main(["train", str(source), *words, "-o", str(tmp_path / "run"), "--steps", "2"]) == 2
    assert named in capfd.readouterr().err


def test_one_process_trains_while_it_renders(source, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert train(source, tmp_path / "run", "--steps", 2) == 2
    assert "leave torchrun out" in capfd.readouterr().err


def test_the_last_of_several_gpus_renders(monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.delenv("QSIM_THREADS", raising=False)
    for gpus, wanted in ((0, None), (1, None), (4, "3")):
        monkeypatch.setattr(torch.cuda, "device_count", lambda gpus=gpus: gpus)
        found = environment_beside_training()
        assert found.get("CUDA_VISIBLE_DEVICES") == wanted
        assert ("QSIM_THREADS" in found) == (gpus == 0)
