"""Makes networks by name: the presets, the ablations of the paper, the control, and the compared networks."""

from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import nn

from quiver.model.config import Config
from quiver.model.equal_cost import EQUAL_COST
from quiver.model.mergenet import MergeNet, MergeNetConfig
from quiver.model.quiver import QUIVER
from quiver.model.rivals.bit2bit import Bit2Bit, Bit2BitConfig
from quiver.model.rivals.emvd import EMVD, EMVDConfig
from quiver.model.rivals.fastdvdnet import FastDVDnet, FastDVDnetConfig
from quiver.model.rivals.flornn import FloRNN, FloRNNConfig
from quiver.model.rivals.memdeblur import MemDeblur, MemDeblurConfig
from quiver.model.rivals.rvrt import RVRT, RVRTConfig
from quiver.model.rivals.spk2imgnet import Spk2ImgNet, Spk2ImgNetConfig
from quiver.model.rivals.student_teacher import StudentTeacher, StudentTeacherConfig
from quiver.model.unet import UNet, UNetConfig
from quiver.model.without_values import WithoutValues

PRESETS: dict[str, Config] = {
    "quiver": Config(),
    "quiver-s": Config(channels=16),
}

# The controls and the compared networks: mended, with the sensor's noise or factor, and as their ports have them.
OTHERS: dict[str, Any] = {
    "mergenet": MergeNetConfig(),
    "unet": UNetConfig(),
    "fastdvdnet": FastDVDnetConfig(),
    "student-teacher": StudentTeacherConfig(),
    "bit2bit": Bit2BitConfig(),
    "emvd": EMVDConfig(),
    "emvd-as-published": EMVDConfig(as_published=True),
    "flornn": FloRNNConfig(),
    "flornn-as-published": FloRNNConfig(as_published=True),
    "memdeblur": MemDeblurConfig(),
    "memdeblur-as-published": MemDeblurConfig(group_norm=False, as_published=True),
    "rvrt": RVRTConfig(),
    "spk2imgnet": Spk2ImgNetConfig(),
    "spk2imgnet-as-published": Spk2ImgNetConfig(as_published=True),
    **{f"{name}-1m": config for name, config in EQUAL_COST.items()},  # a million multiply-adds per pixel and frame
}

# Each network with its configuration. The name of the class stands in weights files.
NETWORKS: tuple[tuple[type[nn.Module], type], ...] = (
    (QUIVER, Config),
    (MergeNet, MergeNetConfig),
    (UNet, UNetConfig),
    (FastDVDnet, FastDVDnetConfig),
    (StudentTeacher, StudentTeacherConfig),
    (Bit2Bit, Bit2BitConfig),
    (EMVD, EMVDConfig),
    (FloRNN, FloRNNConfig),
    (MemDeblur, MemDeblurConfig),
    (RVRT, RVRTConfig),
    (Spk2ImgNet, Spk2ImgNetConfig),
)

# Rows of the paper's Table 4, without that of the pretrained flow: pre-denoiser, flow, multi-scale outputs.
ABLATIONS: dict[str, tuple[bool, bool, bool]] = {
    "none": (False, False, False),
    "denoiser+flow": (True, True, False),
    "scales": (False, False, True),
    "flow+scales": (False, True, True),
    "denoiser+scales": (True, False, True),
    "all": (True, True, True),
}


def ablated(config: Config, row: str) -> Config:
    """Return the configuration without the parts that a row lacks, at similar capacity; ValueError for other rows.

    The recurrent cell is widened to keep the parameter count: the growth of its blocks is the integer that brings the
    count closest to that of `config`.
    """
    if row not in ABLATIONS:
        raise ValueError(f"no ablation is called {row!r}; known: {', '.join(ABLATIONS)}")
    pre_denoiser, flow, multi_scale = ABLATIONS[row]
    wanted = parameter_count(config)
    smaller = replace(config, pre_denoiser=pre_denoiser, flow=flow, multi_scale=multi_scale)
    growth = config.cell_growth or 2 * config.channels
    while parameter_count(smaller) < wanted:
        smaller, before, growth = replace(smaller, cell_growth=growth + 1), smaller, growth + 1
        if abs(parameter_count(before) - wanted) < abs(parameter_count(smaller) - wanted):
            return before
    return smaller


@cache
def parameter_count(config: Config) -> int:
    """Return the number of parameters, counted without memory for them."""
    with torch.device("meta"), WithoutValues():
        return sum(parameter.numel() for parameter in QUIVER(config).parameters())


def build(name: str) -> nn.Module:
    """Return a network by its name, with random weights; ValueError for other names."""
    known = PRESETS | OTHERS
    if name not in known:
        raise ValueError(f"no network is called {name!r}; known: {', '.join(known)}")
    return made(known[name])


def made(config: Any) -> nn.Module:
    """Return the network of a configuration of any kind, with random weights."""
    return next(network(config) for network, kind in NETWORKS if kind is type(config))
