"""Weights files and training states with anything in them: one line, in bounded time and memory."""

from __future__ import annotations

import json
import math
import random
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from qsim.process import peak_memory, reset_peak
from quiver.model.folded import FoldedConfig, FoldedQUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import RENAMED, load, save
from quiver.training.optimiser import Optimiser
from quiver.training.run_folder import Run
from quiver.training.schedule import State
from quiver.training.settings import Settings

TINY = FoldedConfig(
    channels=2,
    denoiser_growth=2,
    flow_channels=(2,),
    attention_width=4,
    attention_temperature=None,
    fold=1,
    estimate_width=2,
    largest_velocity=1.0,
    lecun=False,
)
OLD = {new: old for old, new in RENAMED.items()}
EARLIER_TINY = {OLD.get(name, name): value for name, value in TINY.to_dict().items()}
NUMBERS = (0, -1, 1, 2, 3, 7, 64, 1e300, -1e300, 0.5, 1e-300, 2**31, 2**63, 10**9, 10**400, math.nan, math.inf)
VALUES: tuple[Any, ...] = (
    *NUMBERS,
    *(None, True, False, "", "3", "x" * 5000, [], {}, [2], [0], [10**9], [2] * 1000, [[2]], {"a": 1}, [None], ["2"]),
)
SECONDS, MEMORY = 5.0, 200e6  # of one file of some kB: far more than it needs, far less than an unbounded one takes


def one_line(error: BaseException, path: Path, cure: str = "") -> None:
    """A ValueError in one line of moderate length that names the file and the cure."""
    text = str(error)
    assert cure in text
    assert isinstance(error, ValueError)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert len(text) < 1000 + len(str(path))


@pytest.fixture(scope="module")
def tiny() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {name: value.contiguous() for name, value in FoldedQUIVER(TINY).state_dict().items()}


def refused_or_loaded(path: Path) -> bool:
    """Whether the file is refused; asserts that the answer comes in bounded time and memory."""
    before, started = reset_peak(), time.process_time()
    try:
        load(path)
    except Exception as error:
        one_line(error, path)
        refused = True
    else:
        refused = False
    assert time.process_time() - started < SECONDS
    assert peak_memory() - before < MEMORY
    return refused


@pytest.mark.parametrize("key", sorted(TINY.to_dict()))
def test_any_value_of_any_key_of_a_configuration(tiny, tmp_path, key):
    """What is loaded after all has a configuration that says the same thing."""
    path, wanted = tmp_path / "w.safetensors", TINY.to_dict()
    for value in VALUES:
        config = json.dumps(wanted | {key: value})
        save_file(tiny, path, {"format": "quiver-1", "network": "FoldedQUIVER", "config": config})
        if not refused_or_loaded(path):
            assert load(path).config == FoldedConfig.from_dict(wanted | {key: value})


@pytest.mark.parametrize("key", sorted(EARLIER_TINY))
def test_any_value_of_any_key_of_an_earlier_configuration(tiny, tmp_path, key):
    path = tmp_path / "w.safetensors"
    for value in VALUES:
        config = json.dumps(EARLIER_TINY | {key: value})
        save_file(tiny, path, {"format": "quiver-1", "network": "QUIVER", "config": config})
        if not refused_or_loaded(path):
            assert load(path).config == FoldedConfig.from_dict(TINY.to_dict() | {RENAMED.get(key, key): value})


@pytest.mark.parametrize(
    "changes",
    [{"deformable_groups": 0}, {"flow_channels": []}, {"fold": 1e300}, {"flow_levels": 10**9}, {"cell_blocks": 10**9}],
    ids=str,
)
def test_configurations_that_crashed_or_hung(tiny, tmp_path, changes):
    path = tmp_path / "w.safetensors"
    metadata = {"format": "quiver-1", "network": "QUIVER", "config": json.dumps(EARLIER_TINY | changes)}
    save_file(tiny, path, metadata)
    assert refused_or_loaded(path)


@pytest.mark.parametrize(
    ("network", "config"),
    [
        *(
            (kind, text)
            for kind in ("QUIVER", "FoldedQUIVER", "UNet")
            for text in ("", "3", "null", "[]", "[" * 5000, "{", '"x"')
        ),
        *(("UNet", json.dumps({"width": value})) for value in VALUES if value not in (1, 2, 3, 7, 64, True)),
        ("x" * 5000, "{}"),
        ("", "{}"),
    ],
)
def test_a_configuration_that_is_none(tmp_path, network, config):
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.ones(1)}, path, {"format": "quiver-1", "network": network, "config": config})
    assert refused_or_loaded(path)


@pytest.mark.parametrize("seed", range(4))
def test_many_wrong_values_at_once(tiny, tmp_path, seed):
    rng, path = random.Random(seed), tmp_path / "w.safetensors"
    for _ in range(25):
        kind, wanted = rng.choice([("QUIVER", EARLIER_TINY), ("FoldedQUIVER", TINY.to_dict())])
        keys = rng.sample(sorted(wanted), rng.randint(1, 4))
        config = json.dumps(wanted | {key: rng.choice(VALUES) for key in keys})
        save_file(tiny, path, {"format": "quiver-1", "network": kind, "config": config})
        refused_or_loaded(path)


def test_tensors_of_another_kind(tiny, tmp_path):
    path = tmp_path / "w.safetensors"
    notes = {"format": "quiver-1", "network": "FoldedQUIVER", "config": json.dumps(TINY.to_dict())}
    name = "cell.image1.weight"
    for value in (tiny[name].half(), tiny[name].long(), tiny[name].flatten(), torch.ones(()), torch.ones(0)):
        save_file(tiny | {name: value.contiguous()}, path, notes)
        assert refused_or_loaded(path)
    save_file({key: value for key, value in tiny.items() if key != name}, path, notes)
    assert refused_or_loaded(path)


# Checkpoints


def trained(folder: Path) -> tuple[Run, dict[str, Any]]:
    """A run with a state after one step."""
    run = Run(Settings("data", str(folder), steps=3))
    with run.open():
        pass
    model = UNet(UNetConfig(1))
    optimiser = Optimiser(model, "muon", 1e-3, (0.9, 0.99))
    model(torch.rand(1, 11, 1, 8, 8)).scale1.sum().backward()
    optimiser.step(1e-3)
    entry = {"step": 1, "elapsed": 1.0, "loss": 0.5, "psnr": 20.0, "psnr_matched": 21.0}
    run.save(run.checkpoint, model, optimiser, State(step=1, elapsed=1.0, best=21.0, history=[entry]))
    return run, torch.load(run.checkpoint, weights_only=True)


def resumed(run: Run) -> State:
    model = UNet(UNetConfig(1))
    optimiser = Optimiser(model, "muon", 1e-3, (0.9, 0.99))
    state = run.load(model, optimiser, torch.device("cpu"))
    model(torch.rand(1, 11, 1, 8, 8)).scale1.sum().backward()
    optimiser.step(1e-3)  # what was taken in can be worked with
    return state


ODD: tuple[Any, ...] = (
    *(0, -1, 1e300, math.nan, 10**30, None, True, "x" * 5000, [], {}, {1: 2}, [1], torch.ones(3), torch.ones(0)),
    torch.ones(1).expand(10**12),
    torch.ones(2, dtype=torch.int64),
    torch.full((2, 2), math.nan),
    torch.ones(2, 2).to_sparse(),
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where something can be replaced in nested dictionaries and lists."""
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
    """Refused in one line that says what to do, or a state that training can go on from.

    What stands for the optimiser's settings is not read: the run has its own.
    """
    run, content = trained(tmp_path / "r")
    assert asdict(resumed(run)) == content["state"]
    rng, refusals = random.Random(cases), 0
    spots = [(), *(spot for spot in places(content) if "param_groups" not in spot)]
    for _ in range(cases):
        torch.save(replaced(content, rng.choice(spots), rng.choice(ODD)), run.checkpoint)
        before, started = reset_peak(), time.process_time()
        try:
            resumed(run)
        except Exception as error:
            one_line(error, run.checkpoint, "start again with --force")
            refusals += 1
        assert time.process_time() - started < SECONDS
        assert peak_memory() - before < MEMORY
    assert refusals > 0.8 * cases  # the others hold a number that could have been


@pytest.mark.parametrize("content", [{"model": {1: 2}}, {}, [], None, 3, {"state": {}}, {"state": None, "model": {}}])
def test_a_checkpoint_of_something_else(tmp_path, content):
    run, _ = trained(tmp_path / "r")
    torch.save(content, run.checkpoint)
    with pytest.raises(ValueError, match="not a state of this run") as caught:
        resumed(run)
    one_line(caught.value, run.checkpoint)


def test_a_checkpoint_that_unpacks_to_more_than_it_is(tmp_path):
    """Torch stores its parts as they are; a compressed part of zeros could fill the memory."""
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


def test_files_of_ours_still_load(tmp_path):
    torch.manual_seed(0)
    for network in (FoldedQUIVER(TINY), UNet(UNetConfig(2))):
        save(network, network.config, tmp_path / "w.safetensors")
        assert load(tmp_path / "w.safetensors").config == network.config
