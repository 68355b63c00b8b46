"""Records the stages of QUIVER under the names of its golden file, for golden.py."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from golden import CONSTANTS
from torch import Tensor

from quiver.model.published_weights import from_published
from quiver.model.quiver import QUIVER

INPUTS = ("codes",)


def stages(arrays: Mapping[str, np.ndarray], weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """One float64 run of the published network, of the width that the weights have."""
    constants = {name: torch.full((1, 1, 1, 1), value).double() for name, value in CONSTANTS.items()}  # via float32
    return recorded(from_published({**weights, **constants}).double().eval(), arrays["codes"])


def in_time(chunks: Sequence[Tensor], batch: int) -> Tensor:
    """Results [B*t, ...] of consecutive groups of frames, batch-major -> [B, T, ...]."""
    return torch.cat([chunk.view(batch, -1, *chunk.shape[1:]) for chunk in chunks], dim=1)


@torch.no_grad()
def recorded(model: QUIVER, codes: np.ndarray) -> dict[str, Tensor]:
    """One forward pass of codes/7 [B, T, 1, H, W], with what passed between the stages."""
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
    # frame 0 alone and first, then frames 1 .. T-1 in groups
    batch = len(codes)
    t5 = 4
    flow1, flow2, flow4 = (in_time([flows[s] for flows in calls["flow"]], batch).flatten(0, 1) for s in range(3))
    return {
        "denoised": out.denoised,
        "flow1": flow1,
        "flow2": flow2,
        "flow4": flow4,
        "dcn_first": in_time(calls["alignment"][1::6], batch)[:, 0],  # two streams at three scales; denoised first
        "fused1_t5": in_time(calls["fusion"][1:], batch)[:, t5].permute(0, 2, 3, 1),
        "rmdf1_t5": in_time(calls["r1"][1:], batch)[:, t5],
        "rmdf2_t5": in_time(calls["r2"][1:], batch)[:, t5],
        "rmdf4_t5": calls["r4"][5],
        "state_t5": calls["state"][5],
        "tca": calls["tca"][0],
        "out4": out.scale4,
        "out2": out.scale2,
        "out1": out.scale1,
    }
