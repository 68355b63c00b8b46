"""Weights in and out: our files, those of earlier versions, and everything that must be refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from golden import TINY
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from quiver.model.config import Config
from quiver.model.folded import FoldedQUIVER
from quiver.model.presets import PRESETS
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import EARLIER, RENAMED, RENAMED_PARTS, load, save
from quiver.restoration.restorers import weights_path


def notes(path: Path) -> dict[str, str]:
    with safe_open(path, framework="pt") as file:
        return file.metadata()


@pytest.mark.parametrize(
    "build",
    [
        lambda: QUIVER(Config(16, pre_denoiser=False, cell_growth=3)),
        lambda: FoldedQUIVER(TINY),
        lambda: FoldedQUIVER(replace(TINY, fold=2, estimate_width=4, attention_temperature=8.0, flow=False)),
        lambda: UNet(UNetConfig(4)),
    ],
    ids=["quiver", "small", "folded", "unet"],
)
def test_saved_networks_come_back_the_same(tmp_path: Path, build):
    network = build()
    path = tmp_path / "w.safetensors"
    save(network, network.config, path, notes={"steps": "12"})
    back = load(path)
    assert type(back) is type(network)
    assert back.config == network.config
    assert notes(path)["steps"] == "12"
    for name, value in network.state_dict().items():
        assert torch.equal(back.state_dict()[name], value), name
    assert list(tmp_path.iterdir()) == [path]


def earlier(network: nn.Module, config: dict[str, object], path: Path) -> None:
    """Weights as a program wrote them that had one configuration for QUIVER and FoldedQUIVER."""
    old = {new: name for name, new in RENAMED_PARTS.items()}
    parts = ((name.partition("."), value) for name, value in network.state_dict().items())
    tensors = {old.get(part, part) + dot + rest: value.contiguous() for (part, dot, rest), value in parts}
    kind = "UNet" if isinstance(network, UNet) else "QUIVER"
    save_file(tensors, path, {"format": "quiver-1", "network": kind, "config": json.dumps(config)})


@pytest.mark.parametrize(
    "network",
    [
        QUIVER(Config(16, flow=False, cell_growth=3)),
        FoldedQUIVER(replace(TINY, fold=2, estimate_width=4)),
        UNet(UNetConfig(2)),
    ],
    ids=["quiver", "folded", "unet"],
)
def test_weights_of_earlier_versions_are_read(tmp_path: Path, network):
    """Their configuration named every size of the published design; parts had other names."""
    config = network.config.to_dict()
    if not isinstance(network, UNet):
        old = {new: name for name, new in RENAMED.items()}
        config = EARLIER | {old.get(name, name): value for name, value in config.items()}
    earlier(network, config, tmp_path / "w.safetensors")
    back = load(tmp_path / "w.safetensors")
    assert type(back) is type(network)
    assert back.config == network.config
    for name, value in network.state_dict().items():
        assert torch.equal(back.state_dict()[name], value), name


def test_the_shipped_weights_are_those_of_the_preset():
    assert load(weights_path("nano")).config == PRESETS["nano"]


def test_weights_that_do_not_fit_are_refused(tmp_path: Path):
    network, path = FoldedQUIVER(TINY), tmp_path / "w.safetensors"
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
    with pytest.raises(ValueError, match="QUIVER Config has no field 'channel'"):
        load(path)
    save_file(network.state_dict(), path, metadata | {"network": "GAN"})
    with pytest.raises(ValueError, match="no network is called 'GAN'"):
        load(path)
