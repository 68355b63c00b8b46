"""Makes networks with weights by rule, and records the stages of the published one."""

import math
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from quiver.model.config import Config
from quiver.model.folded import FoldedConfig
from quiver.model.presets import assemble
from quiver.model.published_weights import published_name
from quiver.model.quiver import QUIVER

DATA = Path(__file__).parents[1] / "data"
TINY = FoldedConfig(  # the published design with the smallest parts, for fast tests
    channels=2,
    deformable_kernel=3,
    denoiser_growth=2,
    flow_channels=(2,),
    flow_kernel=7,
    flow_levels=4,
    attention_width=4,
    attention_temperature=None,
    fold=1,
    estimate_width=0,
    largest_velocity=0.0,
    lecun=False,
)
SMALL = replace(TINY, channels=4, deformable_groups=2, denoiser_growth=4, denoiser_passes=2, flow_channels=(4, 4),
                flow_kernel=3, cell_blocks=2)  # fmt: skip
FOLDED = replace(SMALL, fold=2, estimate_width=4, largest_velocity=1.0, attention_width=16, attention_temperature=4.0,
                 flow_levels=3)  # fmt: skip
CONSTANTS = {"spynet.mean": 0.449, "spynet.std": 0.226}


def rule(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the values of a weight, a function of its published name and shape."""
    w = np.random.default_rng(zlib.crc32(name.encode())).standard_normal(shape, dtype=np.float32)
    if len(shape) == 1:
        return np.float32(0.05) * w
    return w * np.float32(0.8 / math.sqrt(math.prod(shape[1:])))


def published_state() -> dict[str, Tensor]:
    """Return all 335 entries at width 16, by the table of published names."""
    state: dict[str, Tensor] = {}
    for line in (DATA / "published_state_dict.tsv").read_text().splitlines()[1:]:
        name, size, kind = line.split("\t")
        shape = tuple(int(side) for side in size.split("x"))
        if kind == "buffer":
            state[name] = torch.full(shape, CONSTANTS[name])
        elif kind.startswith("same tensor as "):
            state[name] = state[kind.removeprefix("same tensor as ")]
        else:
            state[name] = torch.from_numpy(rule(name, shape))
    return state


def network(channels: int, dtype: torch.dtype) -> QUIVER:
    """Return the published network of any width with weights by rule."""
    model = QUIVER(Config(channels=channels))
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.from_numpy(rule(published_name(name), tuple(parameter.shape))))
    return model.to(dtype).eval()


def fill_by_rule(model: nn.Module) -> nn.Module:
    """Set weights by rule in any network of ours, so that nothing is near zero, offsets and masks included."""
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.as_tensor(rule(name, tuple(parameter.shape))))
    return model


def draw(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    """Return random codes 0..7, over 7, as the networks take them."""
    return torch.randint(0, 8, shape, generator=torch.Generator().manual_seed(seed)).to(dtype) / 7


def lively(config: Config, dtype: torch.dtype = torch.float64) -> QUIVER:
    """Return a network with weights by rule, so that every stage contributes."""
    network = fill_by_rule(assemble(config)).to(dtype).eval()
    assert isinstance(network, QUIVER)
    return network


@torch.no_grad()
def stages(model: QUIVER, codes: np.ndarray) -> dict[str, Tensor]:
    """Return the results of all stages for codes/7, under the names of the golden file."""
    calls: dict[str, list] = {}
    watched = {
        "flow": model.flow,
        "alignment": model.alignment,
        "fusion": model.fusions[0],
        "r1": model.cell.fuse1,
        "r2": model.cell.down1,
        "r4": model.cell.smooth,
        "state": model.cell.state,
        "tca": model.attention,
    }
    hooks = [
        module.register_forward_hook(lambda _m, _i, out, key=key: calls.setdefault(key, []).append(out))
        for key, module in watched.items()
    ]
    dtype = model.alignment.weight.dtype
    out = model(torch.from_numpy(codes).to(dtype) / 7)
    for hook in hooks:
        hook.remove()
    pairs = codes.shape[1] - 1  # frames 1 .. T-1 run together, batch-major; frame 0 alone and first
    (flow1, flow2, flow4), at5 = calls["flow"][0], slice(4, None, pairs)
    return {
        "denoised": out.denoised,
        "flow1": flow1,
        "flow2": flow2,
        "flow4": flow4,
        "dcn_first": calls["alignment"][1][::pairs],  # the denoised stream comes first
        "fused1_t5": calls["fusion"][1][at5].permute(0, 2, 3, 1),
        "rmdf1_t5": calls["r1"][1][at5],
        "rmdf2_t5": calls["r2"][1][at5],
        "rmdf4_t5": calls["r4"][5],
        "state_t5": calls["state"][5],
        "tca": calls["tca"][0],
        "out4": out.scale4,
        "out2": out.scale2,
        "out1": out.scale1,
    }
