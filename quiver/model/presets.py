"""Networks by name: the presets, the ablations of the paper, and the control without motion."""

from dataclasses import replace

import torch
from torch import nn

from quiver.model.config import Config
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet

PRESETS: dict[str, Config] = {
    "quiver": Config(),
    "quiver-s": Config(channels=16),
    # Small in everything, on half of the pixels' side; an hourglass over the window, its frames aligned, learns in
    # minutes, the recurrent part can add to its picture. docs/results/starter.md has what it reaches.
    "nano": Config(
        channels=4,
        deformable_groups=1,
        deformable_kernel=1,  # sampling nine taps was the largest single cost
        denoiser_growth=4,
        denoiser_passes=1,
        flow_channels=(8, 8),
        flow_kernel=3,
        flow_levels=3,
        cell_blocks=1,
        attention_width=32,
        attention_temperature=8.0,
        fold=2,
        baseline=32,
        sweep=7.0,
        lecun=True,
    ),
}

# Rows of the paper's ablation (its Table 4, without the pretrained flow): pre-denoiser, flow, multi-scale outputs.
ABLATIONS: dict[str, tuple[bool, bool, bool]] = {
    "none": (False, False, False),
    "denoiser+flow": (True, True, False),
    "scales": (False, False, True),
    "flow+scales": (False, True, True),
    "denoiser+scales": (True, False, True),
    "all": (True, True, True),
}


def ablated(config: Config, row: str) -> Config:
    """The network without some of its parts, at similar capacity: the recurrent cell grows by what was taken away.

    The growth of the cell's blocks is the whole number that brings the count of parameters closest to that of
    `config`. ValueError for an unknown row.
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


def parameter_count(config: Config) -> int:
    """Number of learnt values, counted without allocating them."""
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in QUIVER(config).parameters())


def build(name: str) -> nn.Module:
    """A network with random weights by preset name, or the control "unet"; ValueError names them."""
    if name == "unet":
        return UNet()
    if name not in PRESETS:
        raise ValueError(f"no network is called {name!r}; known: {', '.join(PRESETS)}, unet")
    return QUIVER(PRESETS[name])
