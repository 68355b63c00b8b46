"""Tests weights files: ours, and files with wrong values of every kind."""

from __future__ import annotations

import itertools
import json
import random
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from golden import TINY
from hostile import MEMORY, VALUES, one_line, patience
from runs import EVERY
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from qsim.process import peak_memory, reset_peak
from quiver.model.config import Config
from quiver.model.presets import PRESETS, build
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import annotate, digest, halved, load, save
from quiver.restoration.restorers import weights_path


def notes(path: Path) -> dict[str, str]:
    with safe_open(path, framework="pt") as file:
        return file.metadata()


SAVED = EVERY | {"ablated": lambda: QUIVER(Config(16, pre_denoiser=False, cell_growth=3))}


@pytest.mark.parametrize("name", SAVED)
def test_saved_networks_come_back_the_same(tmp_path: Path, name):
    network = SAVED[name]()
    path = tmp_path / "w.safetensors"
    save(network, network.config, path, notes={"steps": "12"})
    back = load(path)
    assert type(back) is type(network)
    assert back.config == network.config
    assert notes(path)["steps"] == "12"
    for name, value in network.state_dict().items():
        assert torch.equal(back.state_dict()[name], value), name
    assert list(tmp_path.iterdir()) == [path]


def test_the_same_weights_are_the_same_bytes(tmp_path: Path):
    """The library orders notes by a hash of its own, which differs from call to call."""
    network = UNet(UNetConfig(8))
    about = {f"note {n}": str(n) for n in range(9)}
    contents = []
    for order in (list(about), list(reversed(about))):
        save(network, network.config, tmp_path / "w.safetensors", notes={name: about[name] for name in order})
        contents.append((tmp_path / "w.safetensors").read_bytes())
    assert contents[0] == contents[1]
    assert int.from_bytes(contents[0][:8], "little") % 8 == 0


def test_a_digest_is_that_of_what_decides_results(tmp_path: Path):
    """That of the file changed with every measurement of cells, which are a note in it."""
    path = tmp_path / "w.safetensors"
    tensors = {"a": torch.arange(4.0).reshape(2, 2), "b": torch.ones(()), "c": torch.ones(0)}
    about = {"format": "quiver-1", "network": "UNet", "config": "{}"}
    save_file(tensors, path, about)
    before = digest(path)
    annotate(path, {"domain": "cells"})
    assert notes(path)["domain"] == "cells"
    assert digest(path) == before
    changed = [
        (tensors | {"a": tensors["a"] + 1}, about),
        (tensors | {"a": tensors["a"].flatten()}, about),
        (tensors | {"a": tensors["a"].view(torch.int32)}, about),
        ({"d" if name == "a" else name: value for name, value in tensors.items()}, about),
        *((tensors, about | {key: "other"}) for key in about),
    ]
    found = {before}
    for values, metadata in changed:
        save_file(values, path, metadata)
        found.add(digest(path))
    assert len(found) == len(changed) + 1


def test_every_network_is_read_with_equal_values_and_without_slow_imports(tmp_path: Path):
    """A layer made without values imported a package of two seconds for its first random numbers."""
    for name, make in EVERY.items():
        network = make()
        save(network, network.config, tmp_path / f"{name}.safetensors")
        back = load(tmp_path / f"{name}.safetensors").state_dict()
        assert list(back) == list(network.state_dict())
        for key, value in network.state_dict().items():
            assert torch.equal(back[key], value), (name, key)
    code = (
        "import sys; from pathlib import Path; from quiver.model.weights import load\n"
        "before = {*sys.modules}; [load(Path(name)) for name in sys.argv[1:]]\n"
        "print(*({'sympy', 'torch._dynamo'} & ({*sys.modules} - before)))"
    )
    files = [str(tmp_path / f"{name}.safetensors") for name in EVERY]
    done = subprocess.run([sys.executable, "-c", code, *files], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_networks_are_read_where_orthogonal_values_are_made_on_meta_too(tmp_path: Path, monkeypatch):
    """`orthogonal_` of torch 2.9 to 2.11: weights of MemDeblur could not be read."""

    def orthogonal(tensor: torch.Tensor) -> torch.Tensor:
        wide = tensor.shape[0] < tensor[0].numel()
        values = tensor.new_empty(tensor.shape[0], tensor[0].numel()).normal_()
        if wide:
            values.t_()
        values = torch.linalg.qr(values)[0]
        if wide:
            values.t_()
        with torch.no_grad():
            tensor.view_as(values).copy_(values)
        return tensor

    monkeypatch.setattr(nn.init, "orthogonal_", orthogonal)
    network = EVERY["memdeblur"]()
    save(network, network.config, tmp_path / "w.safetensors")
    back = load(tmp_path / "w.safetensors").state_dict()
    assert all(torch.equal(back[name], value) for name, value in network.state_dict().items())


def test_the_shipped_weights_are_those_of_the_preset():
    assert load(weights_path("mergenet")).config == PRESETS["mergenet"]


def test_weights_that_do_not_fit_are_refused(tmp_path: Path):
    network = QUIVER(TINY)
    path = tmp_path / "w.safetensors"
    with pytest.raises(ValueError, match=r"written as \.safetensors, got w\.pth"):
        save(network, TINY, tmp_path / "w.pth")
    save_file({"a": torch.ones(1)}, path)
    with pytest.raises(ValueError, match="not weights of this program"):
        load(path)
    save(network, replace(TINY, channels=4), path)
    with pytest.raises(ValueError, match=r"w.safetensors: weights and configuration do not fit \(.*size mismatch"):
        load(path)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    save_file(network.state_dict(), path, metadata | {"config": '{"channel": 4}'})
    with pytest.raises(ValueError, match="QUIVER: unknown key 'channel'"):
        load(path)
    save_file(network.state_dict(), path, metadata | {"network": "GAN"})
    with pytest.raises(ValueError, match="no network is called 'GAN'"):
        load(path)


# Wrong values of every kind


@pytest.fixture(scope="module")
def tiny() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {name: value.contiguous() for name, value in QUIVER(TINY).state_dict().items()}


def refused_or_loaded(path: Path) -> bool:
    """Return whether the file is refused, and assert bounded time and memory."""
    before = reset_peak()
    started = time.process_time()
    try:
        load(path)
    except Exception as error:
        one_line(error, path)
        refused = True
    else:
        refused = False
    assert time.process_time() - started < patience()
    assert peak_memory() - before < MEMORY
    return refused


SHARE = 5  # quickly one in so many values, others for each key
QUICK_OR_ALL = pytest.mark.parametrize("share", [SHARE, pytest.param(1, marks=pytest.mark.slow)])


@QUICK_OR_ALL
@pytest.mark.parametrize("key", sorted(TINY.to_dict()))
def test_any_value_of_any_key_of_a_configuration(tiny, tmp_path, key, share):
    """A file that is not refused loads with the same configuration."""
    path = tmp_path / "w.safetensors"
    wanted = TINY.to_dict()
    for value in VALUES[sorted(wanted).index(key) % share :: share]:
        config = json.dumps(wanted | {key: value})
        save_file(tiny, path, {"format": "quiver-1", "network": "QUIVER", "config": config})
        if not refused_or_loaded(path):
            assert load(path).config == Config.from_dict(wanted | {key: value})


@QUICK_OR_ALL
@pytest.mark.parametrize("name", [name for name in EVERY if name != "quiver"])
def test_any_value_of_any_key_of_a_configuration_of_any_network(tmp_path, name, share):
    """As for QUIVER above."""
    network = EVERY[name]()
    path = tmp_path / "w.safetensors"
    weights = {key: value.contiguous() for key, value in network.state_dict().items()}
    for key, value in list(itertools.product(network.config.to_dict(), VALUES))[::share]:
        config = network.config.to_dict() | {key: value}
        save_file(
            weights, path, {"format": "quiver-1", "network": type(network).__name__, "config": json.dumps(config)}
        )
        if not refused_or_loaded(path):
            assert load(path).config == type(network.config).from_dict(config), (key, value)


@pytest.mark.parametrize(
    "changes",
    [{"deformable_groups": 0}, {"flow_channels": []}, {"denoiser_growth": 10**9}, {"flow_channels": [10**9]}],
    ids=str,
)
def test_configurations_that_crashed_or_hung(tiny, tmp_path, changes):
    path = tmp_path / "w.safetensors"
    metadata = {"format": "quiver-1", "network": "QUIVER", "config": json.dumps(TINY.to_dict() | changes)}
    save_file(tiny, path, metadata)
    assert refused_or_loaded(path)


@pytest.mark.parametrize(
    ("network", "config"),
    [
        *((kind, text) for kind in ("QUIVER", "UNet") for text in ("", "3", "null", "[]", "[" * 5000, "{", '"x"')),
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
    rng = random.Random(seed)
    path = tmp_path / "w.safetensors"
    for _ in range(25):
        wanted = TINY.to_dict()
        keys = rng.sample(sorted(wanted), rng.randint(1, 4))
        config = json.dumps(wanted | {key: rng.choice(VALUES) for key in keys})
        save_file(tiny, path, {"format": "quiver-1", "network": "QUIVER", "config": config})
        refused_or_loaded(path)


def test_tensors_of_another_kind(tiny, tmp_path):
    path = tmp_path / "w.safetensors"
    notes = {"format": "quiver-1", "network": "QUIVER", "config": json.dumps(TINY.to_dict())}
    name = "cell.image1.weight"
    for value in (tiny[name].double(), tiny[name].long(), tiny[name].flatten(), torch.ones(()), torch.ones(0)):
        save_file(tiny | {name: value.contiguous()}, path, notes)
        assert refused_or_loaded(path)
    save_file({key: value for key, value in tiny.items() if key != name}, path, notes)
    assert refused_or_loaded(path)


def test_a_halved_file_is_read_as_float32(tmp_path):
    network = build("unet-1m")
    path = tmp_path / "small.safetensors"
    save(network, network.config, tmp_path / "full.safetensors", {"step": "3"})
    path.write_bytes(halved(tmp_path / "full.safetensors"))
    assert path.stat().st_size < 0.6 * (tmp_path / "full.safetensors").stat().st_size
    found = load(path).state_dict()
    for name, value in network.state_dict().items():
        expected = value.half().float() if value.dtype == torch.float32 else value
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], expected)
    assert notes(path)["step"] == "3"


def test_files_of_ours_still_load(tmp_path):
    torch.manual_seed(0)
    for network in (QUIVER(TINY), UNet(UNetConfig(2))):
        save(network, network.config, tmp_path / "w.safetensors")
        assert load(tmp_path / "w.safetensors").config == network.config
