"""Records the stages of MemDeblur under the names of its golden file, for golden.py."""

from collections.abc import Mapping

import numpy as np
import torch
from golden import Recorder, fill_by_rule
from torch import Tensor, nn

from quiver.model.published_weights import load_published
from quiver.model.rivals.memdeblur import MemDeblur, MemDeblurConfig

INPUTS = ("codes",)
MULTIPLE = 4
SCORED = 5  # the frame that the port scores
NAMES = ("quarter", "half", "full")


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One run with the memory of evaluation; one with that of training, if the file has its result."""
    network = built(weights)
    codes = torch.from_numpy(np.asarray(arrays["codes"], np.float64) / 7)
    if "output_full_t5_training_memory" not in arrays:
        return recorded(network, codes)
    remember_as_in_training(network)
    output = network.scales(network.images(codes))[-1]
    return recorded(network.eval(), codes) | {"output_full_t5_training_memory": output[:, SCORED]}


def built(weights: Mapping[str, Tensor]) -> MemDeblur:
    """A float64 network with published weights, of the width that they have."""
    config = MemDeblurConfig(
        width=len(weights["fusion.weight"]),
        forward_blocks=sum(name.startswith("forward_resblocks.") for name in weights) // 4,
        backward_blocks=sum(name.startswith("backward_resblocks.main.2.") for name in weights) // 4,
        group_norm=False,
        as_published=True,
    )
    network = MemDeblur(config).double().eval()
    load_published(network, weights, MemDeblur.unused)
    return network


def remember_as_in_training(network: MemDeblur) -> None:
    """Choose the memory of training; batch normalisation keeps its running statistics."""
    network.train()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def recorded(network: MemDeblur, frames: Tensor) -> dict[str, Tensor]:
    """All stages of a run on frames [B, T, 1, H, W], as far as the clip has their frames."""
    calls = Recorder(
        {
            "down": network.downsampling,
            "key": network.memory.key_proj["key_proj"],
            "read": network.memory.attention,
            "backward": network.backward_resblocks,
            "hidden": network.forward_resblocks["main"],
        }
    )
    outputs = network.scales(network.images(frames))
    count = frames.shape[1]
    result = {
        "down_t0": calls["down"][0],
        "key_t0": calls["key"][0],
        "backward_last": calls["backward"][0],
        "backward_first": calls["backward"][count - 1],
    }
    if count > 1:
        result["backward_read_t0"] = calls["read"][count - 2]
    for scale, name in enumerate(NAMES):
        hidden = calls["hidden"][scale * count : (scale + 1) * count]
        result |= {f"hidden_{name}_t0": hidden[0], f"hidden_{name}_last": hidden[-1]}
        if count > 1:  # per scale frame 0 reads once, the others twice: the backward memory, then the forward one
            reads = calls["read"][count - 1 + scale * (2 * count - 1) :][: 2 * count - 1]
            result[f"read_image_{name}_t1"] = reads[2].chunk(2, dim=1)[1]
            result[f"read_feature_{name}_last"] = reads[-1].chunk(2, dim=1)[0]
    result = {key: value if key.startswith("key") else value[:, ::4] for key, value in result.items()}
    result |= {f"output_{name}": output for name, output in zip(NAMES, outputs, strict=True)}
    if count > SCORED:
        result |= {"key_t5": calls["key"][SCORED], "output_full_t5": outputs[-1][:, SCORED]}
    return result


def small() -> MemDeblur:
    """A lively network of the smallest width."""
    network = fill_by_rule(MemDeblur(MemDeblurConfig(width=8, forward_blocks=1, backward_blocks=1))).double().eval()
    assert isinstance(network, MemDeblur)
    return network
