"""Tests the folder of a run: files, lock, a full disk, and states with wrong values of every kind."""

from __future__ import annotations

import errno
import gc
import json
import math
import os
import random
import resource
import signal
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from forks import forked
from hostile import MEMORY, one_line, patience
from runs import settings, small_network
from safetensors import safe_open

from qsim import files
from qsim.process import peak_memory, reset_peak
from quiver.cli.program import main
from quiver.model.unet import UNet, UNetConfig
from quiver.training.loop import train
from quiver.training.optimiser import Optimiser
from quiver.training.run_folder import Run
from quiver.training.schedule import State
from quiver.training.settings import Settings, settled


def test_files_of_a_run(tiny_dataset, tmp_path):
    train(small_network(), settings(tiny_dataset, tmp_path / "r"), progress=False)
    names = {path.name for path in (tmp_path / "r").iterdir()}
    assert {"settings.json", "checkpoint.pt", "best.safetensors", "last.safetensors", "history.json"} <= names
    assert any(name.startswith("events.out.tfevents") for name in names)
    with safe_open(tmp_path / "r/best.safetensors", framework="pt") as file:
        assert json.loads(file.metadata()["settings"])["ppp"] == [3.25]
    history = json.loads((tmp_path / "r/history.json").read_text())["history"]
    assert [entry["step"] for entry in history] == [4, 6]


def test_other_settings_are_refused(tiny_dataset, tmp_path):
    opened(settings(tiny_dataset, tmp_path / "r"))
    opened(settings(tiny_dataset, tmp_path / "r", workers=3))  # does not change the run
    with pytest.raises(FileExistsError, match="holds a run with seed 0, now it is 1"):
        opened(settings(tiny_dataset, tmp_path / "r", seed=1))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").write_text("mine")
    for force in (False, True):
        with pytest.raises(FileExistsError, match=r"is not a training run|only what this program made"):
            opened(settings(tiny_dataset, tmp_path / "other"), force=force)
    assert (tmp_path / "other/file").read_text() == "mine"


def opened(wanted: Settings, *, force: bool = False) -> None:
    with Run(wanted).open(force=force):
        pass


@pytest.mark.parametrize(
    ("name", "began", "now", "says"),
    [
        ("processes", 2, 1, "holds a run whose number of processes is 2, now it is 1"),
        ("computes_in", "bfloat16", "float32", "holds a run that computes in 'bfloat16', now it would compute in"),
        ("clips", "ab", "cd", "holds a run on other clips or codes than are there now"),
        ("validated_frames", 11, 24, "holds a run that was validated on windows of 11 frames, now it is 24"),
    ],
)
def test_other_conditions_are_refused(tmp_path, name, began, now, says):
    def again(value: object, **force: bool) -> None:
        with Run(Settings("d", str(tmp_path / "r"), steps=1), {name: value}).open(**force):
            pass

    again(began)
    again(began)
    with pytest.raises(FileExistsError, match=f"{says}.*; resume it as it began, choose another folder"):
        again(now)
    again(now, force=True)
    again(now)


def test_one_process_at_a_time_trains_in_a_folder(tiny_dataset, tmp_path, capsys):
    """A second command is refused in one line, also with --force; the folder does not change."""
    mine, _ = settled(settings(tiny_dataset, tmp_path / "r"))
    words = ["train", str(tiny_dataset), "-o", mine.out, "--steps", "6", "--crop", "16", "--preset", "unet"]
    with Run(mine).open():
        before = {path.name: path.read_bytes() for path in Path(mine.out).iterdir()}
        for more in ([], ["--force"]):
            assert main([*words, *more]) == 2
            shown = capsys.readouterr()
            assert shown.out == ""
            assert f"{mine.out}: another process trains here; wait for it to end" in shown.err
            assert shown.err.count("\n") == 1
        assert {path.name: path.read_bytes() for path in Path(mine.out).iterdir()} == before
    opened(mine)


def test_a_full_disk_inside_a_checkpoint(tiny_dataset, tmp_path, monkeypatch):
    """The error of the system names the file, and every file of the folder is complete."""
    mine = settings(tiny_dataset, tmp_path / "r", steps=2)
    train(small_network(), mine, progress=False)
    whole = (tmp_path / "r/checkpoint.pt").read_bytes()

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    network = small_network()
    with pytest.raises(OSError, match="No space left") as error:
        Run(mine).save(tmp_path / "r/checkpoint.pt", network, Optimiser(network, "adam", 1e-3, (0.9, 0.99)), State())
    assert error.value.filename == str(tmp_path / "r/checkpoint.pt")
    del error
    gc.collect()  # Python 3.13 frees a buffer before what was lent of it, and warns
    assert (tmp_path / "r/checkpoint.pt").read_bytes() == whole
    assert not list((tmp_path / "r").glob("*.tmp-*"))


def test_a_disk_that_is_full_after_some_bytes_of_a_checkpoint(tmp_path):
    """The write fails halfway, at the system's limit on file sizes; the old file stays."""
    run = Run(Settings("d", str(tmp_path), steps=2))
    network = UNet(UNetConfig(4))
    optimiser = Optimiser(network, "adam", 1e-3, (0.9, 0.99))
    run.save(run.checkpoint, network, optimiser, State())
    whole = run.checkpoint.read_bytes()

    def filled() -> None:
        """In a process of its own, whose limit cannot be raised again."""
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        for share in (0.9, 0.5, 0.1, 0.0):
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(whole)), -1))
            with pytest.raises(OSError) as error:
                run.save(run.checkpoint, network, optimiser, State(step=1))
            assert error.value.filename == str(run.checkpoint)
            assert run.checkpoint.read_bytes() == whole
            assert list(run.folder.iterdir()) == [run.checkpoint]

    assert os.waitstatus_to_exitcode(os.waitpid(forked(filled), 0)[1]) == 0


def test_a_damaged_state_is_named(tiny_dataset, tmp_path):
    small = settings(tiny_dataset, tmp_path / "r", steps=2)
    train(small_network(), small, progress=False)
    (tmp_path / "r/checkpoint.pt").write_bytes(b"PK\x03\x04 half a file")
    with pytest.raises(ValueError, match=r"checkpoint\.pt: not a state of this run"):
        train(small_network(), small, progress=False)


def trained(folder: Path) -> tuple[Run, dict[str, Any]]:
    """Return a run after one step, and its state."""
    run = Run(Settings("data", str(folder), steps=3))
    with run.open():
        pass
    model = UNet(UNetConfig(1))
    optimiser = Optimiser(model, "muon", 1e-3, (0.9, 0.99))
    model(torch.rand(1, 11, 1, 8, 8)).sum().backward()
    optimiser.step(1e-3)
    entry = {"step": 1, "elapsed": 1.0, "loss": 0.5, "psnr": 20.0, "psnr_matched": 21.0}
    run.save(run.checkpoint, model, optimiser, State(step=1, elapsed=1.0, best=21.0, history=[entry]))
    return run, torch.load(run.checkpoint, weights_only=True)


def resumed(run: Run) -> State:
    model = UNet(UNetConfig(1))
    optimiser = Optimiser(model, "muon", 1e-3, (0.9, 0.99))
    state = run.load(model, optimiser)
    model(torch.rand(1, 11, 1, 8, 8)).sum().backward()
    optimiser.step(1e-3)  # the loaded state is usable
    return state


@pytest.mark.filterwarnings("ignore:.*which is a no-op")
def test_the_steps_of_adam_stay_on_the_cpu(tmp_path):
    """Of a network on another device, too, as in a fresh run: from a GPU torch would read back every one."""
    run, _ = trained(tmp_path / "r")
    with torch.device("meta"):
        model = UNet(UNetConfig(1))
    optimiser = Optimiser(model, "muon", 1e-3, (0.9, 0.99))
    run.load(model, optimiser)
    values = list(optimiser.parts[0].state.values())
    assert {value["step"].device.type for value in values} == {"cpu"}
    assert {value["exp_avg"].device.type for value in values} == {"meta"}


ODD: tuple[Any, ...] = (
    *(0, -1, 1e300, math.nan, 10**30, None, True, "x" * 5000, [], {}, {1: 2}, [1], torch.ones(3), torch.ones(0)),
    torch.ones(1).expand(10**12),
    torch.ones(2, dtype=torch.int64),
    torch.full((2, 2), math.nan),
    torch.ones(2, 2).to_sparse(),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path of every value in nested dictionaries and lists."""
    found = [path] if path else []
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            found += places(value[key], (*path, key))
    return found


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = replaced(value[path[0]], path[1:], new)
    return copy


@pytest.mark.parametrize("cases", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_any_value_at_any_place_of_a_checkpoint(tmp_path, cases):
    """The file is refused in one line with a remedy, or training can continue from it.

    The stored settings of the optimiser are not read: the run has settings.
    """
    run, content = trained(tmp_path / "r")
    assert asdict(resumed(run)) == content["state"]
    rng = random.Random(cases)
    refusals = 0
    spots = [(), *(spot for spot in places(content) if "param_groups" not in spot)]
    for _ in range(cases):
        torch.save(replaced(content, rng.choice(spots), rng.choice(ODD)), run.checkpoint)
        before = reset_peak()
        started = time.process_time()
        try:
            resumed(run)
        except Exception as error:
            one_line(error, run.checkpoint, "start again with force=True")
            refusals += 1
        assert time.process_time() - started < patience()
        assert peak_memory() - before < MEMORY
    assert refusals > 0.8 * cases  # the others hold a possible number


@pytest.mark.parametrize("content", [{"model": {1: 2}}, {}, [], None, 3, {"state": {}}, {"state": None, "model": {}}])
def test_a_checkpoint_of_something_else(tmp_path, content):
    run, _ = trained(tmp_path / "r")
    torch.save(content, run.checkpoint)
    with pytest.raises(ValueError, match="not a state of this run") as caught:
        resumed(run)
    one_line(caught.value, run.checkpoint)


def test_a_checkpoint_that_unpacks_to_more_than_it_is(tmp_path):
    """Torch does not compress; a compressed part of zeros could fill the memory."""
    import zipfile

    run, _ = trained(tmp_path / "r")
    torch.save({"state": torch.zeros(50_000_000, dtype=torch.uint8)}, tmp_path / "whole.pt")
    with (
        zipfile.ZipFile(tmp_path / "whole.pt") as whole,
        zipfile.ZipFile(run.checkpoint, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in whole.namelist():
            packed.writestr(name, whole.read(name))
    with pytest.raises(ValueError, match=r"parts of \d+ bytes in a file of") as caught:
        resumed(run)
    one_line(caught.value, run.checkpoint)
